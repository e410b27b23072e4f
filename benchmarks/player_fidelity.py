"""How near the player's pictures are to the volume renderer's, and how far behind on the truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from avatar.avatar_model import Avatar
from avatar.config import HELD_OUT_STRIDE
from avatar.evaluation.held_out import HeldOutFrame
from avatar.evaluation.image_metrics import composite_on_white, ground_truth_on_white, psnr
from avatar.render import render
from avatar.training.frame_stream import prepare_stream
from benchmarks.measurements import Measurement
from benchmarks.sample_training import novel_observations, open_sample
from capture.camera import Camera
from export.package.player_tables import QUALITY_TIERS
from export.player import Player, premultiply
from preprocess.body.body_pose import BodyPose
from preprocess.capture_session import Capture
from preprocess.observation import Observation

TARGETS = {"hq": (("≥ 40", "≥ 43"), ("< 0.4", "< 0.1")), "lite": (("", ""), ("< 1.2", "< 0.5"))}
"""By tier: "at least" and "moonshot" of the PSNR to the renderer and of the loss."""

RgbPicture = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedView:
    """A pose, seen by a camera: what the studio filmed and what the volume renderer shows.

    Attributes:
        pose, camera: As they are; without lens distortion.
        rendered, truth: On white.
    """

    pose: BodyPose
    camera: Camera
    rendered: RgbPicture
    truth: RgbPicture


def views_of_sample(
    capture: Path, avatar: Avatar, *, frames: int, stride: int
) -> dict[str, list[ComparedView]]:
    """Held-out frames of a video, and poses that were never filmed.

    Args:
        capture: A filmed sample.
        avatar: Learnt from it.
        frames: How many frames were learnt from or held out.
        stride: Use every n-th picture.
    """
    recording = open_sample(capture, frames=slice(0, frames))
    found = {
        "held out": held_out_observations(recording, avatar, frames),
        "novel poses": novel_observations(capture),
    }
    return {name: [filmed_view(s, avatar) for s in seen[::stride]] for name, seen in found.items()}


def held_out_observations(
    recording: Capture, avatar: Avatar, frames: int | None
) -> list[Observation]:
    """Frames that training leaves out."""
    items = prepare_stream(
        recording.observations(), avatar.rig, stride=HELD_OUT_STRIDE, total=frames
    )
    return [item.observation for item in items if isinstance(item, HeldOutFrame)]


def filmed_view(seen: Observation, avatar: Avatar) -> ComparedView:
    """A frame, and what the renderer shows in its place."""
    straight = replace(seen.camera, distortion=())
    return ComparedView(
        pose=seen.pose,
        camera=straight,
        rendered=composite_on_white(render(avatar, seen.pose, straight)),
        truth=ground_truth_on_white(seen),
    )


def fidelity_marks(
    name: str, package: Path, shots: Mapping[str, Sequence[ComparedView]]
) -> Iterator[Measurement]:
    """For each tier and each kind of picture, how near and how far behind."""
    for tier in QUALITY_TIERS:
        player = Player.load(package, tier=tier)
        for kind, some in shots.items():
            drawn = [composite_on_white(premultiply(player.render(s.pose, s.camera))) for s in some]
            yield _renderer_mark(f"{name}, {tier}, {kind}", tier, some, drawn)
            filmed = [(s.rendered, d, s.truth) for s, d in zip(some, drawn, strict=True)]
            yield _truth_mark(f"{name}, {tier}, {kind}", tier, filmed)


def _renderer_mark(
    name: str, tier: str, shots: Sequence[ComparedView], drawn: Sequence[RgbPicture]
) -> Measurement:
    near = [psnr(d, s.rendered) for d, s in zip(drawn, shots, strict=True)]
    least, moonshot = TARGETS[tier][0]
    return Measurement(
        name=f"{name}: PSNR to the volume renderer, dB",
        value=float(np.mean(near)),
        required=least,
        stretch_goal=moonshot,
        context=f"{len(shots)} pictures, {min(near):.1f} to {max(near):.1f}",
    )


def _truth_mark(
    name: str, tier: str, told: Sequence[tuple[RgbPicture, RgbPicture, RgbPicture]]
) -> Measurement:
    of_field = np.mean([psnr(exact, truth) for exact, _, truth in told])
    of_player = np.mean([psnr(drawn, truth) for _, drawn, truth in told])
    least, moonshot = TARGETS[tier][1]
    return Measurement(
        name=f"{name}: loss against the truth, dB",
        value=float(of_field - of_player),
        required=least,
        stretch_goal=moonshot,
        context=f"volume renderer {of_field:.2f}, player {of_player:.2f}",
    )
