"""How good an avatar is after so much time, on the studio's sample."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from apps.recording.recording import Recording
from avatar.cells import WarpCells
from avatar.config import TrainConfig
from avatar.hold import HeldOut, prepared, score
from avatar.model import Avatar
from avatar.rig import Rig
from avatar.train import Trainer, train
from avatar.warm import warm_up
from benchmarks.hardware import Hardware
from benchmarks.main_job import observations
from benchmarks.marks import Mark
from benchmarks.stage import assembled, filmed, opened, recipe, train_for_core_seconds
from benchmarks.stopwatch import use_threads
from capture.inbox import Inbox
from preprocess.pose_file import read_motion

WALL_SECONDS = 60.0
NOISE = {"pose_noise_deg": 2.0, "pose_noise_cm": 1.0}


class Quality(NamedTuple):
    """Means over pictures, dB.

    Attributes:
        psnr: On white.
        psnr_mask: Where the person is.
    """

    psnr: float
    psnr_mask: float


def quality(avatar: Avatar, pictures: Sequence[HeldOut]) -> Quality:
    """Of the volume renderer's pictures."""
    scores = [score(avatar, picture) for picture in pictures]
    whole = float(np.mean([s.psnr for s in scores]))
    return Quality(whole, float(np.mean([s.psnr_mask for s in scores])))


def novel_pictures(capture: Path, rig: Rig) -> list[HeldOut]:
    """The poses that were never filmed, and the studio's pictures of them."""
    return [
        HeldOut(observation=seen, cells=WarpCells.of(rig, seen.pose.joint_rotations))
        for seen in observations(capture)
    ]


def truly_posed(capture: Path, held: Sequence[HeldOut], rig: Rig) -> list[HeldOut]:
    """Held-out frames with their true poses."""
    true = read_motion(capture / "truth" / "poses.npz")
    posed = []
    for picture in held:
        pose = true[picture.observation.frame.index]
        seen = dataclasses.replace(picture.observation, pose=pose)
        posed.append(HeldOut(observation=seen, cells=WarpCells.of(rig, pose.joint_rotations)))
    return posed


def learn(
    recording: Recording, rig: Rig, config: TrainConfig, device: torch.device
) -> tuple[Trainer, list[HeldOut]]:
    """Learns while the video is read, on all cores, as ia-ingest does."""
    use_threads(Hardware.here().cores)
    trainer, held = Trainer(rig, config, device), list[HeldOut]()
    warm_up(trainer)
    total = recording.source.frame_count
    inbox = Inbox(prepared(recording.observations(), rig, every=config.hold_every, total=total))
    for _ in train(trainer, inbox, held):
        pass
    inbox.close()
    return trainer, held


def core_second_marks(folder: Path, device: torch.device) -> Iterator[Mark]:
    """128 px, one thread: each time is a run of its own."""
    recording = opened(filmed(folder / "sample128", 128))
    rig = Rig.of(recording.shaped)
    for seconds, least, moonshot in ((5.0, "32", "34"), (10.0, "34", "36"), (60.0, "36", "39")):
        use_threads(1)
        seen = assembled(recording, rig, recipe(recording, seconds), device)
        warm_up(seen.trainer)
        train_for_core_seconds(seen.trainer, seconds)
        held, trainer = quality(seen.trainer.avatar, seen.held), seen.trainer
        yield Mark(
            name=f"128 px, {seconds:.0f} core-seconds: held out, PSNR dB",
            value=held.psnr,
            least=least,
            moonshot=moonshot,
            beside=f"in the mask {held.psnr_mask:.2f}; {trainer.steps:,} steps; poses refined; "
            f"making {len(seen.frames)} frames ready took {seen.ready_seconds:.1f} core-s more",
        )


def wall_marks(
    capture: Path,
    asked: dict[str, tuple[str, str]],
    device: torch.device,
    *,
    seconds: float = WALL_SECONDS,
) -> Iterator[Mark]:
    """After a minute, or longer, on all cores: held-out frames and poses never filmed.

    Args:
        capture: A filmed sample; its first 120 frames are learnt.
        asked: "At least" and "moonshot" for "held out" and for "novel poses".
        device: Where to train.
        seconds: How long, by the wall clock.
    """
    recording = opened(capture, frames=slice(0, 120))
    rig = Rig.of(recording.shaped)
    trainer, held = learn(recording, rig, recipe(recording, seconds), device)
    shown = {"held out": held, "novel poses": novel_pictures(capture, rig)}
    for name, pictures in shown.items():
        found, (least, moonshot) = quality(trainer.avatar, pictures), asked[name]
        yield Mark(
            name=f"{max(recording.source.size_px)} px, {seconds:.0f} s wall: {name}, PSNR dB",
            value=found.psnr,
            least=least,
            moonshot=moonshot,
            beside=f"in the mask {found.psnr_mask:.2f}; {len(pictures)} pictures; "
            f"{trainer.steps:,} steps, CPU {trainer.cpu_seconds:.0f} s "
            f"in {trainer.wall_seconds:.0f} s wall; volume renderer",
        )


def refinement_marks(folder: Path, device: torch.device) -> Iterator[Mark]:
    """What pose refinement gains on noisy poses, scored at the true ones, in the mask."""
    capture = filmed(folder / "noisy256", 256, **NOISE)
    recording = opened(capture)
    rig = Rig.of(recording.shaped)
    found: dict[bool, dict[str, Quality]] = {}
    for refines in (False, True):
        config = recipe(recording, WALL_SECONDS, refine_poses=refines)
        trainer, held = learn(recording, rig, config, device)
        pictures = {
            "held out": truly_posed(capture, held, rig),
            "novel poses": novel_pictures(capture, rig),
        }
        found[refines] = {n: quality(trainer.avatar, p) for n, p in pictures.items()}
    for name in ("held out", "novel poses"):
        off, on = found[False][name], found[True][name]
        yield Mark(
            name=f"256 px, poses off by 2° and 1 cm: refinement gains, {name}, dB in the mask",
            value=on.psnr_mask - off.psnr_mask,
            least="2",
            beside=f"60 s wall each, true poses: {off.psnr_mask:.2f} without, "
            f"{on.psnr_mask:.2f} with; whole picture {off.psnr:.2f} and {on.psnr:.2f}",
        )
