"""What all tests share."""

from __future__ import annotations

import os

# The workers of pytest-xdist share the cores already: threads of BLAS on top only wait for each other. Set before numpy
# is loaded, and handed on to the processes that tests start.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402
import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

from common.surface import FeatureSet, Region  # noqa: E402
from common.wire import encode  # noqa: E402

# A deadline measures how busy the machine is; the timeout of pytest ends what hangs.
settings.register_profile("surfacelink", deadline=None)
settings.load_profile("surfacelink")


@pytest.fixture
def anyio_backend() -> str:
    return "asyncio"


@pytest.fixture(scope="session")
def packets() -> list[bytes]:
    """400 random points as the transmission "hills"."""
    points = np.random.default_rng(2).uniform(-1, 1, (400, 3))
    return encode(FeatureSet(points, Region(-1, 1, -1, 1)), transmission="hills")
