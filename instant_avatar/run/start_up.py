"""Start-up: what a training needs is prepared on a thread and in two other processes.

Python runs the code of one process on one core at a time. So torch is loaded on a thread, which
waits while files are read; a first run's kernels are compiled in a process of their own; and body
and poses are fitted to given masks in another one, which opens the same recording again, and sends
back the fit, the person's rig, and what the masks' refinement has learnt from the frames.
"""

import gc
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import avatar
from capture.hardware import usable_cores
from capture.source import FrameSource
from preprocess.capture_inputs import CaptureInputs, InputKind, find_own_masks
from preprocess.plugins import segmenter_name

if TYPE_CHECKING:  # the process that fits needs no console, and scipy only once it has begun
    from avatar.rig import Rig
    from instant_avatar.cli.console import Console
    from preprocess.capture_session import Capture
    from preprocess.fitting.capture_fit import CaptureFit

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


def can_fit_beside(inputs: CaptureInputs, source: FrameSource) -> bool:
    """Whether a recording can be fitted without this process: its poses and masks are given."""
    if inputs.kind is not InputKind.POSED or inputs.cameras == "solve":
        return False
    if inputs.masks is not None:
        return segmenter_name(inputs.masks) is None
    return source.has_alpha or find_own_masks(inputs.video, inputs.poses) is not None


@final
class FitProcess:
    """A process that fits a recording.

    Attributes:
        rig: The fitted person's, if the process has made it.
    """

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        """Wait for nothing yet."""
        self._process = process
        self.rig: Rig | None = None

    def fit(self, capture: "Capture") -> "CaptureFit | None":
        """Wait for the fit, and let the masks know what those of the other process have learnt."""
        from preprocess.fitting.capture_fitting import fit_capture
        from preprocess.masks.mask_sources import GivenMasks

        assert self._process.stdout is not None
        sent = self._process.stdout.read()
        if self._process.wait() or not isinstance(capture.masks, GivenMasks):
            return fit_capture(capture)  # which says what is wrong
        try:
            fit, capture.masks.refine, self.rig = pickle.loads(sent)
        except (pickle.UnpicklingError, EOFError):  # it was cut off
            return fit_capture(capture)
        return fit


@contextmanager
def fitting_beside(inputs: CaptureInputs, size_px: int) -> Iterator[FitProcess]:
    """Fit a recording in another process, which ends with this block at the latest.

    `size_px` is the longer side of the training images.
    """
    command, pipe = [sys.executable, "-c", FIT], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL) as process:
        try:
            assert process.stdin is not None
            with suppress(OSError), process.stdin as there:  # it may have ended
                there.write(pickle.dumps((inputs, size_px)))
            yield FitProcess(process)
        finally:
            process.terminate()


def fit_for_parent() -> None:
    """Fit the recording that standard input describes; write fit and rig to standard output."""
    gc.disable()  # the process is short
    answer = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for whatever libraries print
    inputs, size_px = pickle.load(sys.stdin.buffer)
    from avatar.rig import Rig
    from preprocess.fitting.capture_fitting import apply_fit, fit_capture
    from preprocess.masks.mask_sources import GivenMasks
    from preprocess.open_capture import open_capture

    capture = open_capture(inputs, size_px=size_px)
    assert isinstance(capture.masks, GivenMasks)
    fit = fit_capture(capture)
    fitted = capture if fit is None else apply_fit(capture, fit, height_m=inputs.height_m)
    found = fit, capture.masks.refine, Rig.from_shaped_body(fitted.shaped)
    with answer:
        answer.write(pickle.dumps(found))
