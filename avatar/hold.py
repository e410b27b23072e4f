"""Held-out frames: which they are, and how well they are rendered."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, TypeVar

import numpy as np
from jaxtyping import Float32

from avatar.cells import WarpCells
from avatar.events import Score
from avatar.likeness import ROOM, Distinct
from avatar.metrics import overlap, psnr, ssim
from avatar.model import Avatar
from avatar.prepare import PreparedFrame, prepare
from avatar.render import render
from avatar.rig import Rig
from avatar.sharpness import Yardstick, equivalent_blur, yardstick
from preprocess.observation import Observation
from preprocess.observe import Dropped

Item = TypeVar("Item")

MOST_HELD = 100
"""Held-out frames that are kept, so that memory stays bounded however long a video lasts."""
SILHOUETTE = 0.5
"""Alpha above which a pixel counts as the person's."""
SCORED_AT_A_MARK = 12
"""Held-out frames scored at each mark of the curve; all of them at the end."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOut:
    """A frame that is never trained on.

    Attributes:
        observation: Picture, mask, pose and camera.
        cells: Its warp; None to solve it when it is rendered. Most are rendered once, at the end,
            and a warp is as large as its picture.
    """

    observation: Observation
    cells: WarpCells | None = None

    @cached_property
    def yardstick(self) -> Yardstick:
        """What blurred copies of the frame score; the frame is rendered again and again."""
        return yardstick(truth_on_white(self.observation), self.observation.alpha > SILHOUETTE)

    def solved(self, rig: Rig) -> "HeldOut":
        """The same with its warp, for whoever renders it again and again."""
        return replace(self, cells=WarpCells.of(rig, self.observation.pose.joint_rotations))


class PassedOver(NamedTuple):
    """A frame that is not learnt from: it looks like the one before."""

    index: int


Ready = PreparedFrame | HeldOut | Dropped | PassedOver
"""What becomes of a frame before the trainer sees it."""


def is_held_out(position: int, *, every: int, total: int | None) -> bool:
    """Whether the frame at a position of the stream is held out: 9, 19, 29, …

    Args:
        position: How many frames came before it.
        every: Every so manieth; 0 for none.
        total: How many frames there will be, if that is known. Of fewer than 20 it is the last
            quarter, at least one.
    """
    if every == 0:
        return False
    if total is not None and total < 2 * every:
        return total > 1 and position >= total - max(1, total // 4)
    return position % every == every - 1


def prepared(
    observations: Iterator[Observation | Dropped],
    rig: Rig,
    *,
    every: int,
    total: int | None,
    room: int = ROOM,
) -> Iterator[Ready]:
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
    distinct = Distinct(rig, room=room)
    for position, observation in enumerate(observations):
        if isinstance(observation, Dropped):
            yield observation
        elif is_held_out(position, every=every, total=total):
            yield HeldOut(observation=observation)
        elif distinct.takes(observation):
            yield prepare(observation, rig)
        else:
            yield PassedOver(index=observation.frame.index)


def on_white(
    premultiplied: Float32[np.ndarray, "height width 4"],
) -> Float32[np.ndarray, "height width 3"]:
    """A premultiplied picture composited over white."""
    return premultiplied[..., :3] + (1.0 - premultiplied[..., 3:])


def truth_on_white(observation: Observation) -> Float32[np.ndarray, "height width 3"]:
    """What a rendering on white should show: alpha · image + (1 - alpha) · white."""
    alpha = observation.alpha[..., None]
    return alpha * (observation.frame.rgb.astype(np.float32) / 255.0) + (1.0 - alpha)


def score(avatar: Avatar, held: HeldOut) -> Score:
    """Renders a held-out frame and compares it with the truth."""
    observation = held.observation
    picture = render(avatar, observation.pose, observation.camera, cells=held.cells)
    return compared(picture, held)


def compared(picture: Float32[np.ndarray, "height width 4"], held: HeldOut) -> Score:
    """How close a premultiplied rendering of a frame's pose comes to the frame."""
    observation, truth = held.observation, truth_on_white(held.observation)
    image = np.clip(on_white(picture), 0.0, 1.0)
    psnr_mask = psnr(image, truth, observation.alpha > SILHOUETTE)
    return Score(
        frame=observation.frame.index,
        psnr=psnr(image, truth),
        psnr_mask=psnr_mask,
        ssim=ssim(image, truth),
        blur=equivalent_blur(psnr_mask, held.yardstick),
        overlap=overlap(picture[..., 3], observation.alpha),
    )


def keep(held: list[HeldOut], frame: HeldOut, *, most: int = MOST_HELD) -> None:
    """Takes a held-out frame in; whenever there are too many, every other one goes.

    What stays is spread evenly over the whole stream: from then on only frames are taken that are
    as far from the last one as the others are from each other.
    """
    places = [kept.observation.frame.index for kept in held]
    closest = min((b - a for a, b in pairwise(places)), default=0)
    if held and frame.observation.frame.index - places[-1] < closest:
        return
    held.append(frame)
    if len(held) > most:
        del held[1::2]


def spread(held: list[HeldOut], most: int) -> list[HeldOut]:
    """At most `most` of them, evenly over the stream."""
    if len(held) <= most:
        return held
    return [held[i] for i in np.linspace(0, len(held) - 1, most).round().astype(int)]


def interleaved(held: list[Item]) -> list[Item]:
    """The same frames in an order whose every beginning is spread over the stream."""
    order: list[int] = []
    for stride in (8, 4, 2, 1):
        order += [i for i in range(0, len(held), stride) if i not in order]
    return [held[i] for i in order]
