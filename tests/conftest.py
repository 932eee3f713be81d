"""What all tests share."""

from __future__ import annotations

from hypothesis import settings

# A deadline measures how busy the machine is; the timeout of pytest ends what hangs.
settings.register_profile("surfacelink", deadline=None)
settings.load_profile("surfacelink")
