"""Held-out frames: how well they are rendered, and which of them are kept.

Where whole images would take too long, a frame is scored by a sample of its pixels: stratified
(inside the mask, near it, elsewhere), spread over the rows of each stratum, and always the same for
a frame, so that its scores over time can be compared. Weighted by the strata's areas, it estimates
without bias the errors that `score_frame` measures on all pixels.
"""

import bisect
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.image_metrics import (
    MASK_THRESHOLD,
    BlurCalibration,
    calibrate_blur,
    composite_on_white,
    composite_over,
    equivalent_blur,
    ground_truth_on_white,
    ground_truth_over,
    psnr_of_errors,
    soft_iou,
    ssim,
)
from avatar.events import HeldOutScore
from avatar.render import PosedAvatar, render
from avatar.rig import Rig
from preprocess.body.body_pose import BodyPose
from preprocess.observation import Observation

Item = TypeVar("Item")

FRAMES_PER_EVALUATION = 12
"""Held-out frames scored at each point of the learning curve; the end scores them all."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutFrame:
    """A frame that is never trained on.

    Attributes:
        correspondences: Correspondence grid of the pose; None to solve it at every rendering. A
            grid is as large as its image, and most frames are rendered only once, at the end.
        gain: Factor of each color channel of the rendering, where the exposure has been fitted.
    """

    observation: Observation
    correspondences: CorrespondenceGrid | None = None
    gain: Float32[np.ndarray, "3"] | None = None

    @cached_property
    def blur_calibration(self) -> BlurCalibration:
        """Scores of blurred copies of the frame, computed once."""
        return calibrate_blur(
            ground_truth_on_white(self.observation), self.observation.alpha > MASK_THRESHOLD
        )

    def expose(self, rendering: Float32[np.ndarray, "*shape 4"]) -> Float32[np.ndarray, "*shape 4"]:
        """A premultiplied rendering in the frame's exposure."""
        if self.gain is None:
            return rendering
        return rendering * np.append(self.gain, np.float32(1.0))

    def moved(
        self, pose: BodyPose, correspondences: CorrespondenceGrid, gain: Float32[np.ndarray, "3"]
    ) -> "HeldOutFrame":
        """The frame in another pose and exposure; what was measured of its image is kept."""
        moved = HeldOutFrame(
            observation=replace(self.observation, pose=pose),
            correspondences=correspondences,
            gain=gain,
        )
        if "blur_calibration" in vars(self):
            vars(moved)["blur_calibration"] = self.blur_calibration
        return moved


def score_frame(avatar: Avatar, frame: HeldOutFrame) -> HeldOutScore:
    """Renders a held-out frame and compares it with the ground truth."""
    observation = frame.observation
    picture = render(
        avatar, observation.pose, observation.camera, cells=frame.correspondences, shaded=True
    )
    return score_rendering(picture, frame)


def score_rendering(
    rendering: Float32[np.ndarray, "height width 4"], frame: HeldOutFrame, background: float = 1.0
) -> HeldOutScore:
    """Compares a premultiplied rendering of a frame's pose, in its exposure, with the frame.

    Both are put on a gray background from 0 (black) to 1 (white); blur is measured against the
    frame on white in any case.
    """
    observation, truth = frame.observation, ground_truth_over(frame.observation, background)
    image = np.clip(composite_over(frame.expose(rendering), background), 0.0, 1.0)
    errors = (image.astype(np.float64) - truth) ** 2
    psnr_mask = psnr_of_errors(errors[observation.alpha > MASK_THRESHOLD])
    return HeldOutScore(
        frame=observation.frame.index,
        psnr=psnr_of_errors(errors),
        psnr_mask=psnr_mask,
        ssim=ssim(image, truth),
        blur=equivalent_blur(psnr_mask, frame.blur_calibration),
        overlap=soft_iou(rendering[..., 3], observation.alpha),
    )


def add_held_out(frames: list[HeldOutFrame], frame: HeldOutFrame, *, max_frames: int = 100) -> None:
    """Adds a held-out frame at its place, in place; above `max_frames` every second is dropped.

    The frames that stay are spread evenly over the stream: once half as many are kept, others are
    added only at the distance that these have from each other.
    """
    places = [kept.observation.frame.index for kept in frames]
    closest = min((b - a for a, b in pairwise(places)), default=0)
    number = frame.observation.frame.index
    place = bisect.bisect(places, number)
    beside = places[max(place - 1, 0) : place + 1]
    if 2 * len(frames) >= max_frames and any(abs(number - other) < closest for other in beside):
        return
    frames.insert(place, frame)
    if len(frames) > max_frames:
        del frames[1::2]


def subsample_evenly(frames: list[HeldOutFrame], max_frames: int) -> list[HeldOutFrame]:
    """At most `max_frames` of the frames, evenly over the stream."""
    if len(frames) <= max_frames:
        return frames
    return [frames[i] for i in np.linspace(0, len(frames) - 1, max_frames).round().astype(int)]


def coarse_to_fine_order(frames: list[Item]) -> list[Item]:
    """The frames in an order in which every prefix is spread over the stream."""
    order: list[int] = []
    for stride in (8, 4, 2, 1):
        order += [i for i in range(0, len(frames), stride) if i not in order]
    return [frames[i] for i in order]


INSIDE_PIXELS = 256
"""Pixels sampled where the mask's alpha is above `MASK_THRESHOLD`."""
BORDER_PIXELS = 160
"""Pixels sampled near the mask, where a misplaced or foggy avatar shows."""
OUTER_PIXELS = 96
"""Pixels sampled in the rest of the image."""
PIXELS_PER_FRAME = INSIDE_PIXELS + BORDER_PIXELS + OUTER_PIXELS
"""Pixels sampled of a frame for the learning curve; all of a smaller stratum."""
BORDER_SHARE = 0.035
"""Distance from the mask up to which a pixel is near it, in image heights."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PixelSample:
    """Pixels of a held-out frame by which it is scored.

    Attributes:
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
        return self.score_colors(self.render_colors(avatar))

    def psnr(self, colors: Float32[np.ndarray, "pixels 4"]) -> float:
        """PSNR alone of colors in the frame's exposure, dB: blur takes as long as rendering."""
        return psnr_of_errors(self._errors(colors), self.areas)

    def render_colors(self, avatar: Avatar) -> Float32[np.ndarray, "pixels 4"]:
        """The avatar's premultiplied colors of the pixels, in the frame's pose."""
        seen = self.frame.observation
        cells = self.correspondences or self.frame.correspondences
        posed = PosedAvatar.of(avatar, seen.pose, seen.camera, cells=cells, shaded=True)
        rows, columns = np.divmod(self.places, seen.camera.size_px[0])
        pixels = np.stack([columns + 0.5, rows + 0.5], axis=-1).astype(np.float64)
        return posed.colors_at(pixels)

    def score_rendering(self, rendering: Float32[np.ndarray, "height width 4"]) -> HeldOutScore:
        """Compares the same pixels of a whole rendering with the frame."""
        return self.score_colors(rendering.reshape(-1, 4)[self.places])

    def score_colors(self, colors: Float32[np.ndarray, "pixels 4"]) -> HeldOutScore:
        """Compares premultiplied colors of the pixels with the frame; SSIM is not measured."""
        errors, inside = self._errors(self.frame.expose(colors)), self._alpha > MASK_THRESHOLD
        psnr_mask = psnr_of_errors(errors[inside], self.areas[inside])
        return HeldOutScore(
            frame=self.frame.observation.frame.index,
            psnr=psnr_of_errors(errors, self.areas),
            psnr_mask=psnr_mask,
            ssim=float("nan"),
            blur=equivalent_blur(psnr_mask, self.frame.blur_calibration),
            overlap=soft_iou(colors[:, 3] * self.areas, self._alpha * self.areas),
        )

    def _errors(self, colors: Float32[np.ndarray, "pixels 4"]) -> Float64[np.ndarray, "pixels"]:
        """Squared errors of exposed colors on white, the mean over channels."""
        image = np.clip(composite_on_white(colors), 0.0, 1.0)
        return ((image.astype(np.float64) - self._truth) ** 2).mean(axis=-1)

    @cached_property
    def _alpha(self) -> Float32[np.ndarray, "pixels"]:
        return self.frame.observation.alpha.reshape(-1)[self.places]

    @cached_property
    def _truth(self) -> Float32[np.ndarray, "pixels 3"]:
        return ground_truth_on_white(self.frame.observation).reshape(-1, 3)[self.places]


def score_fine_sample(avatar: Avatar, frame: HeldOutFrame) -> HeldOutScore:
    """Scores a frame by 4,096 of its pixels: about 0.1 dB off, and SSIM is not measured."""
    return PixelSample.of(frame, density=8).score(avatar)
