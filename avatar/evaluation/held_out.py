"""Held-out frames: which they are, and how well they are rendered."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float32

from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.deformation.rig import Rig
from avatar.evaluation.image_metrics import psnr, soft_iou, ssim
from avatar.evaluation.sharpness import BlurCalibration, calibrate_blur, equivalent_blur
from avatar.events import HeldOutScore
from avatar.field.avatar_model import Avatar
from avatar.render import render
from avatar.training.keyframe_selection import INITIAL_KEYFRAMES, KeyframeSelector
from avatar.training.training_frame import TrainingFrame, prepare_frame
from preprocess.observation import Observation
from preprocess.observe import DroppedFrame

Item = TypeVar("Item")

MAX_HELD_OUT = 100
"""Held-out frames that are kept, so that memory stays bounded however long a video lasts."""
MASK_THRESHOLD = 0.5
"""Alpha above which a pixel counts as the person's."""
FRAMES_PER_EVALUATION = 12
"""Held-out frames scored at each mark of the curve; all of them at the end."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutFrame:
    """A frame that is never trained on.

    Attributes:
        observation: Picture, mask, pose and camera.
        cells: Its warp; None to solve it when it is rendered. Most are rendered once, at the end,
            and a warp is as large as its picture.
    """

    observation: Observation
    correspondences: CorrespondenceGrid | None = None

    @cached_property
    def blur_calibration(self) -> BlurCalibration:
        """What blurred copies of the frame score; the frame is rendered again and again."""
        return calibrate_blur(
            ground_truth_on_white(self.observation), self.observation.alpha > MASK_THRESHOLD
        )

    def with_correspondences(self, rig: Rig) -> "HeldOutFrame":
        """The same with its warp, for whoever renders it again and again."""
        return replace(
            self,
            correspondences=CorrespondenceGrid.solve(rig, self.observation.pose.joint_rotations),
        )


class RedundantFrame(NamedTuple):
    """A frame that is not learnt from: it looks like the one before."""

    index: int


StreamItem = TrainingFrame | HeldOutFrame | DroppedFrame | RedundantFrame
"""What becomes of a frame before the trainer sees it."""


def is_held_out(position: int, *, stride: int, total: int | None) -> bool:
    """Whether the frame at a position of the stream is held out: 9, 19, 29, …

    Args:
        position: How many frames came before it.
        every: Every so manieth; 0 for none.
        total: How many frames there will be, if that is known. Of fewer than 20 it is the last
            quarter, at least one.
    """
    if stride == 0:
        return False
    if total is not None and total < 2 * stride:
        return total > 1 and position >= total - max(1, total // 4)
    return position % stride == stride - 1


def prepare_stream(
    observations: Iterator[Observation | DroppedFrame],
    rig: Rig,
    *,
    stride: int,
    total: int | None,
    initial_keyframes: int = INITIAL_KEYFRAMES,
) -> Iterator[StreamItem]:
    """Makes observations ready, for training or for scoring, in the order they come.

    Args:
        observations: Of a stream.
        rig: Whose body.
        every: Every so manieth is held out.
        total: How many there will be, if that is known.
        room: How many are learnt from before any is passed over.

    Yields:
        One item for each observation.
    """
    distinct = KeyframeSelector(rig, initial_keyframes=initial_keyframes)
    for position, observation in enumerate(observations):
        if isinstance(observation, DroppedFrame):
            yield observation
        elif is_held_out(position, stride=stride, total=total):
            yield HeldOutFrame(observation=observation)
        elif distinct.accepts(observation):
            yield prepare_frame(observation, rig)
        else:
            yield RedundantFrame(index=observation.frame.index)


def composite_on_white(
    premultiplied: Float32[np.ndarray, "height width 4"],
) -> Float32[np.ndarray, "height width 3"]:
    """A premultiplied picture composited over white."""
    return premultiplied[..., :3] + (1.0 - premultiplied[..., 3:])


def ground_truth_on_white(observation: Observation) -> Float32[np.ndarray, "height width 3"]:
    """What a rendering on white should show: alpha · image + (1 - alpha) · white."""
    alpha = observation.alpha[..., None]
    return alpha * (observation.frame.rgb.astype(np.float32) / 255.0) + (1.0 - alpha)


def score_frame(avatar: Avatar, frame: HeldOutFrame) -> HeldOutScore:
    """Renders a held-out frame and compares it with the truth."""
    observation = frame.observation
    picture = render(avatar, observation.pose, observation.camera, cells=frame.correspondences)
    return score_rendering(picture, frame)


def score_rendering(
    rendering: Float32[np.ndarray, "height width 4"], frame: HeldOutFrame
) -> HeldOutScore:
    """How close a premultiplied rendering of a frame's pose comes to the frame."""
    observation, truth = frame.observation, ground_truth_on_white(frame.observation)
    image = np.clip(composite_on_white(rendering), 0.0, 1.0)
    psnr_mask = psnr(image, truth, observation.alpha > MASK_THRESHOLD)
    return HeldOutScore(
        frame=observation.frame.index,
        psnr=psnr(image, truth),
        psnr_mask=psnr_mask,
        ssim=ssim(image, truth),
        blur=equivalent_blur(psnr_mask, frame.blur_calibration),
        overlap=soft_iou(rendering[..., 3], observation.alpha),
    )


def add_held_out(
    frames: list[HeldOutFrame], frame: HeldOutFrame, *, max_frames: int = MAX_HELD_OUT
) -> None:
    """Takes a held-out frame in; whenever there are too many, every other one goes.

    What stays is spread evenly over the whole stream: from then on only frames are taken that are
    as far from the last one as the others are from each other.
    """
    places = [kept.observation.frame.index for kept in frames]
    closest = min((b - a for a, b in pairwise(places)), default=0)
    if frames and frame.observation.frame.index - places[-1] < closest:
        return
    frames.append(frame)
    if len(frames) > max_frames:
        del frames[1::2]


def subsample_evenly(frames: list[HeldOutFrame], max_frames: int) -> list[HeldOutFrame]:
    """At most `most` of them, evenly over the stream."""
    if len(frames) <= max_frames:
        return frames
    return [frames[i] for i in np.linspace(0, len(frames) - 1, max_frames).round().astype(int)]


def coarse_to_fine_order(frames: list[Item]) -> list[Item]:
    """The same frames in an order whose every beginning is spread over the stream."""
    order: list[int] = []
    for stride in (8, 4, 2, 1):
        order += [i for i in range(0, len(frames), stride) if i not in order]
    return [frames[i] for i in order]
