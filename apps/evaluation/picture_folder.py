"""A folder of pictures that another system rendered of a capture's frames."""

import re
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float32

from apps.evaluation.frame_scoring import BACKGROUNDS, PremultipliedImage
from capture.image_folder import any_has_cutout_alpha, list_images, read_image
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.observation import Observation

MAX_RIM_DIFFERENCE = 0.5
"""Largest difference between the median of a picture's rim and the stated background."""
LISTED_FRAMES = 12
"""Frames without a picture that a message lists."""


@final
class PictureFolder:
    """Pictures by frame: by file name, by the last number in it, or by order.

    Attributes:
        missing: Numbers of frames that were asked for and have no picture.
        order_note: How pictures were matched, if by their order; else None.
    """

    def __init__(self, folder: Path, source: FrameSource, backgrounds: tuple[str, ...]) -> None:
        """List the pictures.

        Args:
            folder: The folder.
            source: Frames that were rendered.
            backgrounds: What is behind the person, names of `BACKGROUNDS`.

        Raises:
            InputError: If there are no pictures, or no alpha channel to change the background.
        """
        if not folder.is_dir():
            raise InputError(f"--pictures is {folder}, which is no folder of pictures.")
        self._folder, self._source, self._backgrounds = folder, source, backgrounds
        self._files = list_images(folder)
        if not self._files:
            raise InputError(f"--pictures {folder} holds no pictures (.png, .jpg, .webp …).")
        self._has_alpha = any_has_cutout_alpha(self._files)
        if not self._has_alpha and len(backgrounds) > 1:
            raise InputError(
                f"The pictures in {folder} have no alpha channel, so their background cannot be "
                f"changed: state the one they have, --background {backgrounds[0]}."
            )
        self._by_stem = {file.stem: file for file in self._files}
        self._by_number = {
            int(numbers[-1]): file
            for file in self._files
            if (numbers := re.findall(r"\d+", file.stem))
        }
        wanted = source.selection
        self._selected = range(
            wanted.start,
            min(source.frames_in_file, wanted.stop or source.frames_in_file),
            wanted.step,
        )
        self._in_order = len(self._files) == len(self._selected) and not all(
            index in self._by_number for index in self._selected
        )
        self.missing = list[int]()
        self.order_note: str | None = None

    def __call__(self, observation: Observation) -> PremultipliedImage | None:
        """Read the picture of a frame, with premultiplied alpha; None if it has none.

        Raises:
            InputError: If it has another size, or another background than stated.
        """
        frame = observation.frame
        file = self._by_stem.get(frame.name or "") or self._by_number.get(frame.index)
        if self._in_order and (frame.name is None or frame.name not in self._by_stem):
            file = self._files[self._source.selection.position(frame.index)]
            self.order_note = (
                f"The pictures in {self._folder} are not numbered like the frames; as there are as "
                "many of both, they are matched in order."
            )
        if file is None:
            self.missing.append(frame.index)
            return None
        rgb, alpha = read_image(file)
        if rgb.shape[:2] != observation.alpha.shape:
            stored, wanted = (f"{w}x{h}" for h, w in (rgb.shape[:2], observation.alpha.shape))
            raise InputError(
                f"{file} has {stored} px, its frame {wanted}. Name the longer side at which frames "
                f"are compared: --size {max(rgb.shape[:2])}."
            )
        picture = rgb.astype(np.float32) / np.float32(255.0)
        if not self._has_alpha:
            self._check_background(picture, file)
            return np.concatenate([picture, np.ones_like(picture[..., :1])], axis=-1)
        if alpha is None:
            raise InputError(f"{file} has no alpha channel, but others in {self._folder} have.")
        opacity = alpha[..., None].astype(np.float32) / np.float32(255.0)
        return np.concatenate([picture * opacity, opacity], axis=-1)

    def describe_missing(self) -> str | None:
        """Name the frames without a picture, in a sentence; None if all have one."""
        if not self.missing:
            return None
        listed = ", ".join(map(str, self.missing[:LISTED_FRAMES]))
        more = len(self.missing) - LISTED_FRAMES
        return (
            f"{self._folder} has no picture of {len(self.missing)} frames, which are not scored: "
            f"{listed}{f' and {more} more' if more > 0 else ''}. Pictures are found by the name of "
            "the frame's file, or by the frame's number in the video, counted from 0."
        )

    def _check_background(self, picture: Float32[np.ndarray, "height width 3"], file: Path) -> None:
        (name,) = self._backgrounds
        rim = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        gray = float(np.median(rim))
        if abs(gray - BACKGROUNDS[name]) > MAX_RIM_DIFFERENCE:
            other = next(each for each in BACKGROUNDS if each != name)
            raise InputError(
                f"{file} is not on {name}: the median of its rim is {255 * gray:.0f} of 255. State "
                f"its background (--background {other})."
            )
