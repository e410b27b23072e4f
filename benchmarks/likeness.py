"""How near the player's pictures are to the volume renderer's, and how far behind on the truth."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from apps.recording.recording import Recording
from avatar.config import HOLD_EVERY
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
from preprocess.poses import read_poses

DANCES = 16
ASKED = {"hq": (("≥ 40", "≥ 43"), ("< 0.4", "< 0.1")), "lite": (("", ""), ("< 1.2", "< 0.5"))}
"""By tier: "at least" and "moonshot" of the PSNR to the renderer and of the loss."""

Picture = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """A pose, seen by a camera: what the studio filmed and what the volume renderer shows.

    Attributes:
        pose, camera: As they are; without lens distortion.
        exact, truth: On white. No `truth` where a pose was never filmed.
    """

    pose: BodyPose
    camera: Camera
    exact: Picture
    truth: Picture | None = None


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


def shots_of_person(
    capture: Path, avatar: Avatar, dance: Path, *, size: int
) -> dict[str, list[Shot]]:
    """Held-out frames of a real person, and the same person dancing in the place of each.

    Nobody filmed the dances: they say how near the player is to the volume renderer, no more.

    Args:
        capture: A folder that `ia-ingest` reads.
        avatar: Learnt from it.
        size: Longer side of its pictures, in pixels, as it was learnt from.
        dance: A pose file; of `DANCES` of its poses, evenly spread, the joints are taken.
    """
    recording = opened(capture, size=size)
    held = _held(recording, avatar, recording.source.frame_count)
    motion = read_poses(dance)
    chosen = np.linspace(0, len(motion) - 1, DANCES).round().astype(int)
    dances = []
    for position, row in enumerate(chosen):
        seen = held[position % len(held)]
        pose = replace(seen.pose, joint_rotations=motion[row].joint_rotations)
        dances.append(_unfilmed(pose, seen.camera, avatar))
    return {"held out": [_shot(seen, avatar) for seen in held], "dancing": dances}


def _held(recording: Recording, avatar: Avatar, frames: int | None) -> list[Observation]:
    items = prepared(recording.observations(), avatar.rig, every=HOLD_EVERY, total=frames)
    return [item.observation for item in items if isinstance(item, HeldOut)]


def _shot(seen: Observation, avatar: Avatar) -> Shot:
    return replace(_unfilmed(seen.pose, seen.camera, avatar), truth=truth_on_white(seen))


def _unfilmed(pose: BodyPose, camera: Camera, avatar: Avatar) -> Shot:
    straight = replace(camera, distortion=())
    return Shot(pose=pose, camera=straight, exact=on_white(render(avatar, pose, straight)))


def likeness_marks(name: str, package: Path, shots: Mapping[str, Sequence[Shot]]) -> Iterator[Mark]:
    """For each tier and each kind of picture, how near and how far behind."""
    for tier in TIERS:
        player = Player.load(package, tier=tier)
        for kind, some in shots.items():
            drawn = [on_white(premultiplied(player.render(s.pose, s.camera))) for s in some]
            yield _nearness(f"{name}, {tier}, {kind}", tier, some, drawn)
            filmed = [(s.exact, d, s.truth) for s, d in zip(some, drawn, strict=True)]
            told = [(exact, d, truth) for exact, d, truth in filmed if truth is not None]
            if told:
                yield _loss(f"{name}, {tier}, {kind}", tier, told)


def _nearness(name: str, tier: str, shots: Sequence[Shot], drawn: Sequence[Picture]) -> Mark:
    near = [psnr(d, s.exact) for d, s in zip(drawn, shots, strict=True)]
    least, moonshot = ASKED[tier][0]
    return Mark(
        name=f"{name}: PSNR to the volume renderer, dB",
        value=float(np.mean(near)),
        least=least,
        moonshot=moonshot,
        beside=f"{len(shots)} pictures, {min(near):.1f} to {max(near):.1f}",
    )


def _loss(name: str, tier: str, told: Sequence[tuple[Picture, Picture, Picture]]) -> Mark:
    of_field = np.mean([psnr(exact, truth) for exact, _, truth in told])
    of_player = np.mean([psnr(drawn, truth) for _, drawn, truth in told])
    least, moonshot = ASKED[tier][1]
    return Mark(
        name=f"{name}: loss against the truth, dB",
        value=float(of_field - of_player),
        least=least,
        moonshot=moonshot,
        beside=f"volume renderer {of_field:.2f}, player {of_player:.2f}",
    )
