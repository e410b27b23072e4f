"""Masks of a live source: a segmenter still writes them, and frames wait for theirs."""

import re
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float32

from capture.image_folder import list_images
from capture.input_error import InputError
from capture.source import Frame, PacingClock
from preprocess.live.live_poses import MAX_WAIT_S, POLL_INTERVAL_S
from preprocess.masks.mask_files import Masks, read_mask
from preprocess.masks.mask_origin import segmenter_name


def check_mask_folder(named: Path | None) -> None:
    """Refuse what --masks names for a live source, unless it is a folder or a segmenter.

    Raises:
        InputError: If it is neither.
    """
    if named is not None and segmenter_name(named) is None and not named.is_dir():
        raise InputError(
            f"There is no folder of masks {named}. Give --masks: the folder to which "
            "they will be written, or segmenter:blazepose to have them estimated."
        )


class _InvertedMask(InputError):  # noqa: N818 - a finding, not an error
    """A mask that is inverted unlike those before it: waiting does not help."""


@final
class LiveMasks:
    """The masks of a live source: a folder of images, written one after the other.

    A mask belongs to the image of the same name; a camera's frames have no names: there it is the
    last number in the mask's name that counts. Unless it is given, the polarity is that of most
    masks so far, of the first if they are even; masks of the other polarity are refused.
    """

    def __init__(
        self, path: Path, pace: PacingClock, *, invert: bool | None, patience_s: float = MAX_WAIT_S
    ) -> None:
        """Remember the folder; masks are read on demand.

        Args:
            path: The folder.
            pace: Clock of the source; stopping it ends every wait.
            invert: Whether the person is dark; None detects it from the masks.
            patience_s: Time after its capture that a frame waits for its mask, seconds.
        """
        self._path, self._pace, self._invert, self._patience_s = path, pace, invert, patience_s
        self._by_name: dict[str, Path] = {}
        self._by_number: dict[int, Path] = {}
        self._ways: list[bool] = []

    def wait_for_mask(
        self, frame: Frame, size_px: tuple[int, int]
    ) -> Float32[np.ndarray, "height width"]:
        """Wait for the mask of a frame and scale it to an image's size.

        Raises:
            InputError: If it did not come in time, cannot be read, has another aspect ratio, or is
                inverted unlike most.
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
            except InputError as cause:  # the file may be half written
                trouble = cause
            if self._pace.now() >= deadline or self._pace.stopped:
                raise trouble
            self._pace.wait_until(min(deadline, self._pace.now() + POLL_INTERVAL_S))

    def _read(self, path: Path, size_px: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
        stored = read_mask(path)
        if self._invert is not None:
            return Masks(path, 1, lambda row: stored, invert=self._invert).alpha(0, size_px)
        if not stored.any():  # an empty mask has no polarity
            return np.zeros(size_px[::-1], dtype=np.float32)
        before = self._majority_inverted()
        try:
            turned = Masks(path, 1, lambda row: stored, invert=None).inverted
        except InputError:  # full or undecidable; the reading below refuses what is no mask
            if before is None:
                raise
            return Masks(path, 1, lambda row: stored, invert=before).alpha(0, size_px)
        alpha = Masks(path, 1, lambda row: stored, invert=turned).alpha(0, size_px)
        self._ways.append(turned)
        if turned != self._majority_inverted():
            raise _InvertedMask(f"{path.name} is inverted unlike most masks so far")
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
