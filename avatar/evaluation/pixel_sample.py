"""Scores of a held-out frame from a sample of its pixels, where all of them would take too long.

The sample is stratified (inside the mask, near it, elsewhere), spread over the rows of each
stratum, and always the same for a frame, so that its scores over time can be compared. Weighted by
the strata's areas, it estimates without bias the errors that `score_frame` measures on all pixels.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float32, Int

from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.deformation.rig import Rig
from avatar.evaluation.held_out import MASK_THRESHOLD, HeldOutFrame
from avatar.evaluation.image_metrics import (
    composite_on_white,
    ground_truth_on_white,
    psnr_of_errors,
    soft_iou,
)
from avatar.evaluation.sharpness import equivalent_blur
from avatar.events import HeldOutScore
from avatar.field.avatar_model import Avatar
from avatar.render import PosedAvatar

INSIDE_PIXELS = 256
"""Pixels sampled where the mask's alpha is above `MASK_THRESHOLD`."""
BORDER_PIXELS = 160
"""Pixels sampled near the mask, where a misplaced or foggy avatar shows."""
OUTER_PIXELS = 96
"""Pixels sampled in the rest of the image."""
PIXELS_PER_FRAME = INSIDE_PIXELS + BORDER_PIXELS + OUTER_PIXELS
"""Pixels sampled of a frame for the learning curve; all of a smaller stratum."""
FINE_DENSITY = 8
"""Density of the samples that final scores come from where whole images would take too long."""
BORDER_SHARE = 0.035
"""Distance from the mask up to which a pixel is near it, in image heights."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PixelSample:
    """Pixels of a held-out frame by which it is scored.

    Attributes:
        frame: The frame.
        places: Flat indices of the pixels.
        areas: Number of the image's pixels that each of them stands for.
        correspondences: Correspondence grid of the pose; None to solve it at every scoring.
    """

    frame: HeldOutFrame
    places: Int[np.ndarray, "pixels"]
    areas: Float32[np.ndarray, "pixels"]
    correspondences: CorrespondenceGrid | None = None

    @classmethod
    def of(cls, frame: HeldOutFrame, *, density: int = 1) -> "PixelSample":
        """Draws `density * PIXELS_PER_FRAME` pixels; the frame's index is the seed."""
        alpha = frame.observation.alpha
        inside = alpha > MASK_THRESHOLD
        kernel = np.ones((2 * round(BORDER_SHARE * len(alpha)) + 1,) * 2, dtype=np.uint8)
        near = cv2.dilate((alpha > 0.0).astype(np.uint8), kernel) > 0
        random = np.random.default_rng(abs(frame.observation.frame.index))
        places, areas = [], []
        for stratum, most in (
            (inside, INSIDE_PIXELS),
            (near & ~inside, BORDER_PIXELS),
            (~near, OUTER_PIXELS),
        ):
            candidates = np.flatnonzero(stratum)
            count = min(density * most, len(candidates))
            each = len(candidates) / max(count, 1)
            places.append(
                candidates[((np.arange(count) + random.random(count)) * each).astype(int)]
            )
            areas.append(np.full(count, each, dtype=np.float32))
        return cls(frame=frame, places=np.concatenate(places), areas=np.concatenate(areas))

    def with_correspondences(self, rig: Rig) -> "PixelSample":
        """The sample with its pose's correspondence grid, for repeated scoring."""
        pose = self.frame.observation.pose
        return replace(self, correspondences=CorrespondenceGrid.solve(rig, pose.joint_rotations))

    def score(self, avatar: Avatar) -> HeldOutScore:
        """Renders the pixels and compares them with the frame."""
        seen = self.frame.observation
        cells = self.correspondences or self.frame.correspondences
        posed = PosedAvatar.of(avatar, seen.pose, seen.camera, cells=cells, shaded=True)
        rows, columns = np.divmod(self.places, seen.camera.size_px[0])
        return self.score_colors(
            posed.colors_at(np.stack([columns + 0.5, rows + 0.5], axis=-1).astype(np.float64))
        )

    def score_rendering(self, rendering: Float32[np.ndarray, "height width 4"]) -> HeldOutScore:
        """Compares the same pixels of a whole rendering with the frame."""
        return self.score_colors(rendering.reshape(-1, 4)[self.places])

    def score_colors(self, colors: Float32[np.ndarray, "pixels 4"]) -> HeldOutScore:
        """Compares premultiplied colors of the pixels with the frame; SSIM is not measured."""
        image = np.clip(composite_on_white(self.frame.expose(colors)), 0.0, 1.0)
        errors = ((image.astype(np.float64) - self._truth) ** 2).mean(axis=-1)
        inside = self._alpha > MASK_THRESHOLD
        psnr_mask = psnr_of_errors(errors[inside], self.areas[inside])
        return HeldOutScore(
            frame=self.frame.observation.frame.index,
            psnr=psnr_of_errors(errors, self.areas),
            psnr_mask=psnr_mask,
            ssim=float("nan"),
            blur=equivalent_blur(psnr_mask, self.frame.blur_calibration),
            overlap=soft_iou(colors[:, 3] * self.areas, self._alpha * self.areas),
        )

    @cached_property
    def _alpha(self) -> Float32[np.ndarray, "pixels"]:
        return self.frame.observation.alpha.reshape(-1)[self.places]

    @cached_property
    def _truth(self) -> Float32[np.ndarray, "pixels 3"]:
        return ground_truth_on_white(self.frame.observation).reshape(-1, 3)[self.places]


def score_fine_sample(avatar: Avatar, frame: HeldOutFrame) -> HeldOutScore:
    """Scores a frame by 4,096 of its pixels: about 0.1 dB off, and SSIM is not measured."""
    return PixelSample.of(frame, density=FINE_DENSITY).score(avatar)
