"""Start-up: libraries are loaded on a thread, and a first run's kernels compiled in a process."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from instant_avatar.cli.command_line import without_garbage_collection
from instant_avatar.cli.console import Console

COMPILE = "from instant_avatar.run.start_up import warm_up; warm_up()"
"""Program of the process that compiles."""


@contextmanager
def preparing_to_train(console: Console) -> Iterator[Callable[[], None]]:
    """Load torch and numba and compile kernels beside this block; yield a function that waits.

    numba compiles in one thread, and holds the interpreter: another process compiles while the
    capture is opened, tracked and fitted. It ends with this block.
    """
    compilers: list[subprocess.Popen[bytes]] = []
    has_ended = threading.Event()

    def load() -> None:
        with suppress(ImportError), without_garbage_collection():  # imported again, it is named
            import torch  # noqa: F401
            from numba.core.registry import cpu_target

            context: Any = cpu_target.target_context
            context.refresh()
            from export.bake.proxy_surface import visible_depth_steps  # compiled after the others

            cache: Any = getattr(getattr(visible_depth_steps, "_cache", None), "_cache_file", None)
            if cache is not None and not cache._load_index() and not has_ended.is_set():
                nowhere = subprocess.DEVNULL
                process = subprocess.Popen(
                    [sys.executable, "-c", COMPILE], stdin=nowhere, stdout=nowhere, stderr=nowhere
                )
                compilers.append(process)

    def wait() -> None:
        loading.join()
        for process in compilers:
            with console.status("compiling kernels (slow on the first run only)"):
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


def warm_up() -> None:
    """Compile all kernels, or load those that are compiled."""
    from avatar.config import TrainConfig
    from avatar.rig import Rig
    from avatar.training import train
    from avatar.training.trainer import Trainer
    from export.bake import proxy_surface
    from preprocess.body.parametric_body import load_body_model

    rig = Rig.from_shaped_body(load_body_model(None).with_shape())
    train.warm_up(Trainer(rig, TrainConfig()))
    proxy_surface.warm_up()
