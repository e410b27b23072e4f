"""What all tests share: threads that wait quietly, and shapes that are checked."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jaxtyping
import numpy as np
import pytest
from hypothesis import settings

from tests import shape_checks

jaxtyping.jaxtyped = shape_checks.check_calls
pytest_plugins = ["tests.avatar_fixtures"]  # imports our packages, so it is imported after that

settings.register_profile("busy", deadline=None)  # a machine may be busy with something else
settings.load_profile("busy")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
