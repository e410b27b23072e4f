"""What is prepared beside the opening of a capture: torch, missing kernels, the fit to masks."""

import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from avatar.kernels import numba_pose
from avatar.rig import Rig
from capture.hardware import usable_cores
from instant_avatar.cli.console import Console
from instant_avatar.run import start_up
from instant_avatar.run.start_up import fitting_beside
from preprocess.capture_inputs import CaptureInputs
from preprocess.fitting import capture_fitting
from preprocess.fitting.capture_fitting import apply_fit, fit_capture
from preprocess.open_capture import open_capture

PROCESSES = min(2, usable_cores())
"""That compile."""
RUNS_LONG = "import time; time.sleep(600)"
SIZE_PX = 64


@pytest.fixture
def started(monkeypatch):
    """The processes that are started, of a program that runs long."""
    processes, start = [], subprocess.Popen

    def keep(*args, **options):
        processes.append(start(*args, **options))
        return processes[-1]

    monkeypatch.setattr(start_up.subprocess, "Popen", keep)
    monkeypatch.setattr(start_up, "COMPILE", RUNS_LONG)
    return processes


def set_index(monkeypatch, index):
    monkeypatch.setattr(start_up, "is_first_run", lambda: False)
    file = SimpleNamespace(_load_index=lambda: index)
    kernel = SimpleNamespace(_cache=SimpleNamespace(_cache_file=file))
    monkeypatch.setattr(numba_pose, "largest_distance", kernel)


def test_kernels_that_are_there_start_no_process(started, monkeypatch):
    set_index(monkeypatch, {"signature": "file"})
    with start_up.preparing_to_train(Console()) as wait:
        wait()
    assert not started
    assert "torch" in sys.modules


def test_missing_kernels_are_compiled_by_a_process_that_ends_with_the_block(started, monkeypatch):
    set_index(monkeypatch, {})
    with start_up.preparing_to_train(Console()):
        while len(started) < PROCESSES:
            time.sleep(0.01)
        assert [process.poll() for process in started] == [None] * PROCESSES
    assert None not in [process.poll() for process in started]


def test_a_first_run_is_announced_and_compiles_before_numba_is_loaded(
    started, monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(start_up, "KERNELS", tmp_path)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    with start_up.preparing_to_train(Console()):
        assert len(started) == PROCESSES
        assert "first run" in capsys.readouterr().err
    assert None not in [process.poll() for process in started]
    assert len(started) == PROCESSES
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "__pycache__" / "numba_shading.mean_normal-1.nbi").touch()
    assert start_up.is_first_run()  # the one before was interrupted
    (tmp_path / "__pycache__" / f"{start_up.LAST_KERNEL}-1.nbi").touch()
    assert not start_up.is_first_run()


def test_what_only_numba_knows_is_no_first_run(monkeypatch, tmp_path):
    monkeypatch.setattr(start_up, "KERNELS", tmp_path)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not start_up.is_first_run()


def test_waiting_ends_once_the_kernels_are_compiled(started, monkeypatch):
    set_index(monkeypatch, {})
    monkeypatch.setattr(start_up, "COMPILE", "pass")
    with start_up.preparing_to_train(Console()) as wait:
        wait()
        assert [process.poll() for process in started] == [0] * PROCESSES


def open_some(film):
    """A capture that was not fitted."""
    return open_capture(CaptureInputs(video=film, frames=slice(0, 24, 2)), size_px=SIZE_PX)


@pytest.fixture(scope="module")
def fitted(film):
    """A capture and the fit that this process finds."""
    capture = open_some(film)
    return capture, fit_capture(capture)


def assert_same(one, other):
    """Equal but for rounding, which follows the number of threads of a process."""
    for name, value in vars(one).items():
        np.testing.assert_allclose(value, getattr(other, name), rtol=1e-5, atol=1e-5)


def test_another_process_fits_and_remembers_what_this_one_would(film, fitted):
    (here, fit), there = fitted, open_some(film)
    with fitting_beside() as fitting:
        fitting.send(there, None, with_rig=True)
        found = fitting.fit(there)
        sent_rig = fitting.rig()
    assert_same(found, fit)
    assert_same(sent_rig, Rig.from_shaped_body(apply_fit(here, fit).shaped))
    assert not there.masks.needs_all_frames  # it has compared borders, as the other one
    assert there.masks.refine._ratios == here.masks.refine._ratios


@pytest.mark.parametrize("trouble", ["the process fails", "the masks cannot be sent"])
def test_what_another_process_does_not_fit_is_fitted_by_this_one(
    film, started, monkeypatch, trouble
):
    there = open_some(film)
    monkeypatch.setattr(capture_fitting, "fit_capture", lambda capture: (capture, "fitted here"))
    if trouble == "the process fails":
        monkeypatch.setattr(start_up, "FIT", "raise SystemExit(1)")
    else:
        there.masks.plugin = lambda: None  # not to be pickled
    with fitting_beside() as fitting:
        fitting.send(there, None, with_rig=True)
        assert fitting.fit(there) == (there, "fitted here")
        assert fitting.rig() is None
        assert started[0].wait(timeout=60.0) != 0  # also without a capture


def test_the_process_ends_with_the_block(started, monkeypatch):
    monkeypatch.setattr(start_up, "FIT", RUNS_LONG)
    with fitting_beside():
        assert started[0].poll() is None
    assert started[0].poll() is not None
