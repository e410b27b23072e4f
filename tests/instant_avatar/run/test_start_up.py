"""What is prepared beside the opening of a capture: torch is loaded, missing kernels compiled."""

import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from export.bake import proxy_surface
from instant_avatar.cli.console import Console
from instant_avatar.run import start_up

RUNS_LONG = "import time; time.sleep(600)"


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
    file = SimpleNamespace(_load_index=lambda: index)
    kernel = SimpleNamespace(_cache=SimpleNamespace(_cache_file=file))
    monkeypatch.setattr(proxy_surface, "visible_depth_steps", kernel)


def test_kernels_that_are_there_start_no_process(started, monkeypatch):
    set_index(monkeypatch, {"signature": "file"})
    with start_up.preparing_to_train(Console()) as wait:
        wait()
    assert not started
    assert "torch" in sys.modules


def test_missing_kernels_are_compiled_by_a_process_that_ends_with_the_block(started, monkeypatch):
    set_index(monkeypatch, {})
    with start_up.preparing_to_train(Console()):
        while not started:
            time.sleep(0.01)
        assert started[0].poll() is None
    assert started[0].poll() is not None


def test_waiting_ends_once_the_kernels_are_compiled(started, monkeypatch):
    set_index(monkeypatch, {})
    monkeypatch.setattr(start_up, "COMPILE", "pass")
    with start_up.preparing_to_train(Console()) as wait:
        wait()
        assert [process.poll() for process in started] == [0]
