"""What all tests share: threads that wait quietly, and a body to work on."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest
from hypothesis import settings

from preprocess.body.body_file import load_body_model
from preprocess.body.parametric_body import ShapedBody

pytest_plugins = ["tests.avatar_fixtures"]

settings.register_profile("busy", deadline=None)  # a machine may be busy with something else
settings.load_profile("busy")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def shaped() -> ShapedBody:
    return load_body_model().with_shape()
