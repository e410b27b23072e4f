"""How near the player's pictures are to the volume renderer's, and how far behind on the truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from apps.recording import Recording
from avatar.hold import HeldOut, on_white, prepared, truth_on_white
from avatar.metrics import psnr
from avatar.model import Avatar
from avatar.render import render
from benchmarks.main_job import observations
from benchmarks.marks import Mark
from benchmarks.stage import opened
from capture.camera import Camera
from export.player import Player, premultiplied
from export.tiers import TIERS
from preprocess.observation import Observation
from preprocess.pose import BodyPose

HOLD_EVERY = 10
ASKED = {"hq": (("≥ 40", "≥ 43"), ("< 0.4", "< 0.1")), "lite": (("", ""), ("< 1.2", "< 0.5"))}
"""By tier: "at least" and "moonshot" of the PSNR to the renderer and of the loss."""

Picture = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """A pose, seen by a camera: what the studio filmed and what the volume renderer shows.

    Attributes:
        pose, camera: As they are; without lens distortion.
        truth, exact: On white.
    """

    pose: BodyPose
    camera: Camera
    truth: Picture
    exact: Picture


def shots_of(capture: Path, avatar: Avatar, *, frames: int, every: int) -> dict[str, list[Shot]]:
    """Held-out frames of a video, and poses that were never filmed.

    Args:
        capture: A filmed sample.
        avatar: Learnt from it.
        frames: How many frames were learnt from or held out.
        every: Every so manyth picture is looked at.
    """
    recording = opened(capture, frames=slice(0, frames))
    found = {"held out": _held(recording, avatar, frames), "novel poses": observations(capture)}
    return {name: [_shot(s, avatar) for s in seen[::every]] for name, seen in found.items()}


def _held(recording: Recording, avatar: Avatar, frames: int) -> list[Observation]:
    items = prepared(recording.observations(), avatar.rig, every=HOLD_EVERY, total=frames)
    return [item.observation for item in items if isinstance(item, HeldOut)]


def _shot(seen: Observation, avatar: Avatar) -> Shot:
    camera = replace(seen.camera, distortion=())
    return Shot(
        pose=seen.pose,
        camera=camera,
        truth=truth_on_white(seen),
        exact=on_white(render(avatar, seen.pose, camera)),
    )


def likeness_marks(name: str, package: Path, shots: Mapping[str, Sequence[Shot]]) -> Iterator[Mark]:
    """For each tier and each kind of picture, how near and how far behind."""
    for tier in TIERS:
        player = Player.load(package, tier=tier)
        (near, nearest), (lost, least_lost) = ASKED[tier]
        for kind, some in shots.items():
            drawn = [on_white(premultiplied(player.render(s.pose, s.camera))) for s in some]
            to_exact = [psnr(d, s.exact) for d, s in zip(drawn, some, strict=True)]
            of_player = np.mean([psnr(d, s.truth) for d, s in zip(drawn, some, strict=True)])
            of_field = np.mean([psnr(s.exact, s.truth) for s in some])
            yield Mark(
                name=f"{name}, {tier}, {kind}: PSNR to the volume renderer, dB",
                value=float(np.mean(to_exact)),
                least=near,
                moonshot=nearest,
                beside=f"{len(some)} pictures, {min(to_exact):.1f} to {max(to_exact):.1f}",
            )
            yield Mark(
                name=f"{name}, {tier}, {kind}: loss against the truth, dB",
                value=float(of_field - of_player),
                least=lost,
                moonshot=least_lost,
                beside=f"volume renderer {of_field:.2f}, player {of_player:.2f}",
            )
