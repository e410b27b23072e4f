"""What all tests share: threads that wait quietly, and shapes that are checked."""

import inspect
import os
import re
import sys

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

UNIX_ONLY = re.compile(
    r"mkfifo|symlink_to|os\.symlink|chmod|start_new_session|killpg|SIGKILL|geteuid|/dev/|/proc"
)
"""What a test calls that Windows has not, or allows to administrators alone."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests on Windows that call what it has not."""
    for item in items if sys.platform == "win32" else ():
        if isinstance(item, pytest.Function) and UNIX_ONLY.search(inspect.getsource(item.function)):
            item.add_marker(pytest.mark.skip(reason="calls what Windows has not"))


def pytest_runtest_setup() -> None:
    """Check the first calls of each function in this test."""
    shape_checks.calls.clear()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
