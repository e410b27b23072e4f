"""Masks that a segmenter still writes: each is waited for, and belongs to a picture by its name."""

import re
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float32

from capture.frame import Frame
from capture.image_folder import list_images
from capture.input_error import InputError
from capture.live.pacing_clock import PacingClock
from preprocess.live.live_poses import MAX_WAIT_S, POLL_INTERVAL_S
from preprocess.masks.mask_files import Masks, read_mask


class _InvertedMask(InputError):  # noqa: N818 - a finding, not an error
    """A mask that is the other way round than those before it: waiting does not help."""


@final
class LiveMasks:
    """The masks of a live source: a folder of pictures, written one after the other.

    A mask belongs to the picture of the same name; of a camera, whose pictures have none, to the
    one whose number is the last in the mask's name. Which side is the person, if nobody has said
    it, is what most of them show so far, and the first if they are even; the others are refused.
    """

    def __init__(
        self, path: Path, pace: PacingClock, *, invert: bool | None, patience_s: float = MAX_WAIT_S
    ) -> None:
        """Nothing is read yet.

        Args:
            path: The folder.
            pace: Its clock; ending it ends every wait.
            invert: Whether the person is dark; None finds out from the masks.
            patience_s: How long after it was filmed a frame waits for its mask.
        """
        self._path, self._pace, self._invert, self._patience_s = path, pace, invert, patience_s
        self._by_name: dict[str, Path] = {}
        self._by_number: dict[int, Path] = {}
        self._ways: list[bool] = []

    def wait_for_mask(
        self, frame: Frame, size_px: tuple[int, int]
    ) -> Float32[np.ndarray, "height width"]:
        """The mask of a frame, scaled to a picture's size; waits for it.

        Raises:
            InputError: If it did not come in time, cannot be read, is of another shape, or the other
                way round than most.
        """
        deadline = (self._pace.now() if frame.due_s is None else frame.due_s) + self._patience_s
        while True:
            try:
                path = self._find_file(frame)
                if path is not None:
                    return self._read(path, size_px)
                trouble = InputError(f"no mask within {self._patience_s:g} s")
            except _InvertedMask:
                raise
            except InputError as cause:  # perhaps it is half written
                trouble = cause
            if self._pace.now() >= deadline or self._pace.stopped:
                raise trouble
            self._pace.wait_until(min(deadline, self._pace.now() + POLL_INTERVAL_S))

    def _read(self, path: Path, size_px: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
        stored = read_mask(path)
        if self._invert is not None:
            return Masks(path, 1, lambda row: stored, invert=self._invert).alpha(0, size_px)
        if not stored.any():  # it tells nothing of the others either
            return np.zeros(size_px[::-1], dtype=np.float32)
        before = self._majority_inverted()
        try:
            turned = Masks(path, 1, lambda row: stored, invert=None).inverted
        except InputError:  # full, or undecidable, or no mask at all, which is said below
            if before is None:
                raise
            return Masks(path, 1, lambda row: stored, invert=before).alpha(0, size_px)
        alpha = Masks(path, 1, lambda row: stored, invert=turned).alpha(0, size_px)
        self._ways.append(turned)
        if turned != self._majority_inverted():
            raise _InvertedMask(f"{path.name} is the other way round than most masks so far")
        return alpha

    def _majority_inverted(self) -> bool | None:
        """Whether the person is dark in most masks so far; None if there was none."""
        if not self._ways:
            return None
        dark = 2 * sum(self._ways) - len(self._ways)
        return dark > 0 if dark else self._ways[0]

    def _find_file(self, frame: Frame) -> Path | None:
        found = self._known_file(frame)
        if found is None and self._path.is_dir():
            self._by_name, self._by_number = {}, {}
            for path in list_images(self._path):
                self._by_name[path.stem] = path
                numbers = re.findall(r"\d+", path.stem)
                if numbers:
                    self._by_number[int(numbers[-1])] = path
            found = self._known_file(frame)
        return found

    def _known_file(self, frame: Frame) -> Path | None:
        if frame.name is not None:
            return self._by_name.get(frame.name)
        return self._by_number.get(frame.index)
