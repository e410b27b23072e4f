"""How a film's pictures differ from those that its masks and poses were made on."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

FULL_WINDOW = (0.0, 0.0, 1.0, 1.0)

RgbImage = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, kw_only=True)
class VideoTransform:
    """The change that turns a film's pictures into those that the masks belong to.

    Attributes:
        quarter_turns: By how many quarter turns the pictures are rotated counter-clockwise, first.
        mirrored: Whether left and right are then exchanged.
        window: Left, top, right and bottom of the film's picture within the mask, as fractions of
            the mask's width and height. A cropped film shows less than 0 to 1, a padded one more.
        first: Frame number that the masks and poses have for the film's frame 0.
        backwards: Whether their numbers go down where the film's go up.
    """

    quarter_turns: int = 0
    mirrored: bool = False
    window: tuple[float, float, float, float] = FULL_WINDOW
    first_frame: int = 0
    backwards: bool = False

    @property
    def reorients(self) -> bool:
        """Whether pictures must be rotated or mirrored."""
        return self.mirrored or self.quarter_turns % 4 != 0

    @property
    def renumbers_frames(self) -> bool:
        """Whether frames belong to masks and poses of other numbers."""
        return self.backwards or self.first_frame != 0

    def mask_frame(self, frame: int) -> int:
        """The number that the masks and poses have for one of the film's frames."""
        return self.first_frame - frame if self.backwards else self.first_frame + frame

    def video_frame(self, number: int) -> int:
        """The film's frame of a number that masks and poses have."""
        return self.first_frame - number if self.backwards else number - self.first_frame

    def reorient(self, picture: np.ndarray) -> np.ndarray:
        """One of the film's pictures, or a map of that size, rotated and mirrored."""
        turned = np.rot90(picture, self.quarter_turns)
        return np.ascontiguousarray(turned[:, ::-1] if self.mirrored else turned)

    def warp_to_mask(
        self, rgb: RgbImage
    ) -> tuple[UInt8[np.ndarray, "rows columns 3"], UInt8[np.ndarray, "rows columns"]]:
        """The picture where the mask has it, and which of the mask's pixels the film shows (1)."""
        upright = self.reorient(rgb)
        height, width = upright.shape[:2]
        shown = np.ones((height, width), dtype=np.uint8)
        if self.window == FULL_WINDOW:
            return upright, shown
        affine = self.mask_from_video((width, height))[:2].astype(np.float32)
        shrinks = affine[0, 0] < 1.0
        if shrinks:  # else a padded film would be sampled, not averaged
            upright = cv2.GaussianBlur(upright, (0, 0), max(0.01, 0.5 / affine[0, 0] - 0.4))
        moved = cv2.warpAffine(upright, affine, (width, height), borderMode=cv2.BORDER_REPLICATE)
        inside = cv2.warpAffine(shown, affine, (width, height), flags=cv2.INTER_NEAREST)
        return np.asarray(moved), np.asarray(inside)

    def mask_from_video(self, size_px: tuple[int, int]) -> Float[np.ndarray, "3 3"]:
        """From pixel indices of the upright film to those of the mask, both of one size."""
        left, top, right, bottom = self.window
        scale = np.array([right - left, bottom - top])
        # Pixel i has its middle at i + 0.5.
        moved = np.array([left, top]) * np.array(size_px) + 0.5 * (scale - 1.0)
        return np.array([[scale[0], 0.0, moved[0]], [0.0, scale[1], moved[1]], [0.0, 0.0, 1.0]])


IDENTITY_TRANSFORM = VideoTransform()
"""Pictures that masks and poses belong to as they are."""
