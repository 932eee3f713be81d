"""What all tests share."""

from __future__ import annotations

import os

# The workers of pytest-xdist share the cores already: threads of BLAS on top only wait for each other. Set before numpy
# is loaded, and handed on to the processes that tests start.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from hypothesis import settings  # noqa: E402

# A deadline measures how busy the machine is; the timeout of pytest ends what hangs.
settings.register_profile("surfacelink", deadline=None)
settings.load_profile("surfacelink")
