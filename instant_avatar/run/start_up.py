"""Start-up: what a training needs is prepared on a thread and in two other processes.

Python runs the code of one process on one core at a time. So torch is loaded on a thread, which
waits while files are read; a first run's kernels are compiled in a process of their own; and body
and poses are fitted in another one, which receives the capture, and sends back the fit, what the
masks' refinement has learnt from the frames, and the person's rig.
"""

import gc
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import avatar
from capture.hardware import usable_cores

if TYPE_CHECKING:  # the process that fits needs no console, and scipy only once it has begun
    from avatar.rig import Rig
    from instant_avatar.cli.console import Console
    from preprocess.capture_session import Capture, CaptureFit

COMPILE = (
    "import gc; gc.disable(); from instant_avatar.run.start_up import warm_up; "
    "warm_up(is_second={})"
)
"""Program of the two processes that compile; a seventh of their time would go into garbage."""
KERNELS = Path(avatar.__file__).parent / "kernels"
"""Folder of the kernel that is compiled last."""
LAST_KERNEL = "numba_pose.largest_distance"
"""Module and name of that kernel, the last one of a step that corrects poses."""
FIT = "from instant_avatar.run.start_up import fit_for_parent; fit_for_parent()"
"""Program of the process that fits."""


@contextmanager
def preparing_to_train(console: "Console") -> Iterator[Callable[[], None]]:
    """Load torch and numba and compile kernels beside this block; yield a function that waits.

    numba compiles in one thread, and holds the interpreter: another process compiles while the
    capture is opened, tracked and fitted. It ends with this block.
    """
    from instant_avatar.cli.command_line import without_garbage_collection

    compilers: list[subprocess.Popen[bytes]] = []
    has_ended = threading.Event()

    def compile_beside() -> None:
        nowhere = subprocess.DEVNULL
        for is_second in (False, True)[: usable_cores()]:
            program = COMPILE.format(is_second)
            compilers.append(
                subprocess.Popen(
                    [sys.executable, "-c", program], stdin=nowhere, stdout=nowhere, stderr=nowhere
                )
            )

    def load() -> None:
        with suppress(ImportError), without_garbage_collection():  # imported again, it is named
            import torch  # noqa: F401
            from numba.core.registry import cpu_target

            context: Any = cpu_target.target_context
            context.refresh()
            from avatar.kernels.numba_pose import largest_distance

            cache: Any = getattr(getattr(largest_distance, "_cache", None), "_cache_file", None)
            is_missing = cache is not None and not cache._load_index()
            if is_missing and not compilers and not has_ended.is_set():
                compile_beside()

    if is_first_run():
        console.info(
            "This is the first run: its kernels are compiled beside what follows, in half a "
            "minute; training starts after that, and within seconds in later runs."
        )
        compile_beside()

    def wait() -> None:
        loading.join()
        if compilers:
            with console.status("compiling kernels (slow on the first run only)"):
                for process in compilers:
                    process.wait()

    loading = threading.Thread(target=load, name="loading libraries")
    loading.start()
    try:
        yield wait
    finally:
        has_ended.set()
        for process in compilers:
            process.terminate()
            process.wait()


def is_first_run() -> bool:
    """Whether no kernel was ever compiled here, as far as can be seen before numba is loaded."""
    if "NUMBA_CACHE_DIR" in os.environ or not os.access(KERNELS, os.W_OK):
        return False  # numba knows where they are
    return not any(KERNELS.glob(f"__pycache__/{LAST_KERNEL}-*.nbi"))


def warm_up(*, is_second: bool = False) -> None:
    """Compile all kernels, or load those that are compiled; a second process compiles a half."""
    from avatar.config import TrainConfig
    from avatar.rig import Rig
    from avatar.training import train
    from avatar.training.trainer import Trainer
    from export.bake import proxy_surface
    from preprocess.body.parametric_body import load_body_model

    rig = Rig.from_shaped_body(load_body_model(None).with_shape())
    trainer = Trainer(rig, TrainConfig())
    if is_second:
        train.warm_up_rays(trainer)
        proxy_surface.warm_up()
    else:
        train.warm_up_learning(trainer)
        train.warm_up(trainer)
        proxy_surface.warm_up()


@final
class FitProcess:
    """A process that fits a recording."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        """Wait for nothing yet."""
        self._process = process

    def send(self, capture: "Capture", height_m: float | None, *, with_rig: bool) -> None:
        """Let the process fit a recording, and make the rig of its person `with_rig`.

        `height_m` is the person's height, if the user has stated it. What another process cannot
        open, such as masks by a plugin, is fitted by this one.
        """
        assert self._process.stdin is not None
        with suppress(OSError, pickle.PicklingError, AttributeError, TypeError):  # or it has ended
            self._process.stdin.write(pickle.dumps((capture, height_m, with_rig)))
            self._process.stdin.flush()

    def fit(self, capture: "Capture") -> "CaptureFit | None":
        """Wait for the fit, and let the masks know what those of the other process have learnt."""
        from preprocess.fitting.capture_fitting import fit_capture
        from preprocess.masks.mask_sources import GivenMasks

        received = self._receive()
        if received is None:
            return fit_capture(capture)  # which says what is wrong
        fit, refine = received
        if isinstance(capture.masks, GivenMasks):
            capture.masks.refine = refine
        return fit

    def rig(self) -> "Rig | None":
        """Wait for the rig of the fitted person, if the process was to make it."""
        return self._receive()

    def _receive(self) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(OSError):
            self._process.stdin.close()  # without a capture the process ends
        try:
            return pickle.load(self._process.stdout)
        except (pickle.UnpicklingError, EOFError):  # it has ended
            return None


@contextmanager
def fitting_beside() -> Iterator[FitProcess]:
    """Start another process to fit a recording, which ends with this block at the latest."""
    command, pipe = [sys.executable, "-c", FIT], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL) as process:
        try:
            yield FitProcess(process)
        finally:
            process.terminate()


def fit_for_parent() -> None:
    """Fit the recording that standard input holds; write fit, then rig, to standard output."""
    gc.disable()  # the process is short
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process decides what Ctrl-C ends
    answer = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for whatever libraries print
    from avatar.rig import Rig
    from preprocess.fitting.capture_fitting import apply_fit, fit_capture

    capture, height_m, with_rig = pickle.load(sys.stdin.buffer)
    fit = fit_capture(capture)
    with answer:
        pickle.dump((fit, getattr(capture.masks, "refine", None)), answer)
        answer.flush()
        if with_rig:
            fitted = capture if fit is None else apply_fit(capture, fit, height_m=height_m)
            pickle.dump(Rig.from_shaped_body(fitted.shaped), answer)
