"""A subject of a public data set: which frames are trained on, and which are scored."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped

from apps.cli.console import Console
from capture.atomic_files import atomic_folder
from capture.input_error import InputError


@dataclass(frozen=True, kw_only=True)
class SplitFrames:
    """The frames of one split.

    Attributes:
        folder: Capture folder.
        poses: Pose file; None for the one in the folder.
        frames: Frames of the folder, START:STOP:STEP counted from 0.
    """

    folder: Path
    poses: Path | None = None
    frames: str = "::"


@dataclass(frozen=True, kw_only=True)
class DatasetSubject:
    """A subject of a data set, found in a folder.

    Attributes:
        name: Name of its folder.
        open_splits: Returns the training and the test frames. Frames that no capture folder holds
            are written below the given folder first, once.
        size_px: Longer side of the images that are compared; None for the original size.
        paper: Scores in a paper, by metric; empty without any.
    """

    name: str
    open_splits: Callable[[Path, Console], tuple[SplitFrames, SplitFrames]]
    size_px: int | None = None
    paper: dict[str, float] = field(default_factory=dict)


def write_splits(
    folder: Path,
    splits: dict[str, Sequence[int]],
    write_frames: Callable[[Path, Sequence[int]], Iterable[int]],
    console: Console,
) -> tuple[SplitFrames, SplitFrames]:
    """Write the capture folders "train" and "test" of a subject; those that exist stay.

    Args:
        folder: Folder above them.
        splits: Frame numbers of "train" and of "test".
        write_frames: Writes some frames into a folder, with poses and cameras, and yields their
            numbers while it does.
        console: Shows progress.

    Raises:
        InputError: If frames are missing.
    """
    for name, numbers in splits.items():
        if (folder / name).is_dir():  # written whole or not at all
            continue
        with (
            atomic_folder(folder / name) as part,
            console.progress(f"writing {folder / name}", float(len(numbers))) as bar,
        ):
            for made in ("images", "masks"):
                (part / made).mkdir()
            done = 0
            for done, number in enumerate(write_frames(part, numbers), start=1):
                bar.update(float(done), f"frame {number}")
            if done != len(numbers):
                raise InputError(
                    f"Only {done} of {len(numbers)} frames of {folder / name} were found; is the "
                    "video complete?"
                )
    return SplitFrames(folder=folder / "train"), SplitFrames(folder=folder / "test")


def write_image(path: Path, picture: Shaped[np.ndarray, "..."]) -> None:
    """Write a gray or RGB picture of 8 bits as PNG.

    Raises:
        OSError: If it cannot be written.
    """
    if not cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture):
        raise OSError(f"{path} could not be written.")


def require_rows(count: int, numbers: Sequence[int], path: Path, what: str) -> None:
    """Check that a file has a row for each frame.

    Raises:
        InputError: If it has fewer.
    """
    if count <= max(numbers):
        raise InputError(
            f"{path} holds {count} {what}, but the protocol needs that of frame {max(numbers)}; is "
            "it complete?"
        )
