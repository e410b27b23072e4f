"""Quality of an avatar over training time, on the studio's sample."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar.avatar_model import Avatar
from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.rig import Rig
from avatar.training.frame_stream import prepare_stream
from avatar.training.train import Trainer, train, warm_up
from baselines.hardware import Hardware
from benchmarks.measurements import Measurement
from benchmarks.sample_training import (
    film_sample,
    novel_observations,
    open_sample,
    training_config,
)
from benchmarks.stopwatch import limit_threads
from capture.inbox import Inbox
from preprocess.capture_session import Capture
from preprocess.poses.pose_format_registry import read_poses

WALL_SECONDS = 60.0
NOISE = {"pose_noise_deg": 2.0, "pose_noise_cm": 1.0}


class MeanPsnr(NamedTuple):
    """Means over pictures, dB.

    Attributes:
        psnr: On white.
        psnr_mask: Where the person is.
    """

    psnr: float
    psnr_mask: float


def mean_psnr(avatar: Avatar, pictures: Sequence[HeldOutFrame]) -> MeanPsnr:
    """Of the volume renderer's pictures."""
    scores = [score_frame(avatar, picture) for picture in pictures]
    whole = float(np.mean([s.psnr for s in scores]))
    return MeanPsnr(whole, float(np.mean([s.psnr_mask for s in scores])))


def novel_pose_frames(capture: Path, rig: Rig) -> list[HeldOutFrame]:
    """The poses that were never filmed, and the studio's pictures of them."""
    return [
        HeldOutFrame(
            observation=seen,
            correspondences=CorrespondenceGrid.solve(rig, seen.pose.joint_rotations),
        )
        for seen in novel_observations(capture)
    ]


def with_true_poses(capture: Path, held: Sequence[HeldOutFrame], rig: Rig) -> list[HeldOutFrame]:
    """Held-out frames with their true poses."""
    true = read_poses(capture / "truth" / "poses.npz")
    posed = []
    for picture in held:
        pose = true[picture.observation.frame.index]
        seen = dataclasses.replace(picture.observation, pose=pose)
        posed.append(
            HeldOutFrame(
                observation=seen,
                correspondences=CorrespondenceGrid.solve(rig, pose.joint_rotations),
            )
        )
    return posed


def train_online(
    recording: Capture, rig: Rig, config: TrainConfig
) -> tuple[Trainer, list[HeldOutFrame]]:
    """Learns while the video is read, on all cores, as ia-ingest does."""
    limit_threads(Hardware.here().cores)
    trainer, held = Trainer(rig, config), list[HeldOutFrame]()
    warm_up(trainer)
    total = recording.source.frame_count
    inbox = Inbox(
        prepare_stream(recording.observations(), rig, stride=config.held_out_stride, total=total)
    )
    for _ in train(trainer, inbox, held):
        pass
    inbox.close()
    return trainer, held


def measure_by_wall_time(
    capture: Path,
    targets: Mapping[str, tuple[str, str]],
    *,
    seconds: float = WALL_SECONDS,
) -> Iterator[Measurement]:
    """After a minute, or longer, on all cores: held-out frames and poses never filmed.

    Args:
        capture: A filmed sample; its first 120 frames are learnt.
        asked: "At least" and "moonshot" for "held out" and for "novel poses".
        seconds: How long, by the wall clock.
    """
    recording = open_sample(capture, frames=slice(0, 120))
    rig = Rig.from_shaped_body(recording.shaped)
    trainer, held = train_online(recording, rig, training_config(recording, seconds))
    shown = {"held out": held, "novel poses": novel_pose_frames(capture, rig)}
    for name, pictures in shown.items():
        found, (least, moonshot) = mean_psnr(trainer.avatar, pictures), targets[name]
        yield Measurement(
            name=f"{max(recording.source.size_px)} px, {seconds:.0f} s wall: {name}, PSNR dB",
            value=found.psnr,
            required=least,
            stretch_goal=moonshot,
            context=f"in the mask {found.psnr_mask:.2f}; {len(pictures)} pictures; "
            f"{trainer.steps:,} steps, CPU {trainer.cpu_seconds:.0f} s "
            f"in {trainer.wall_seconds:.0f} s wall; volume renderer",
        )


def measure_pose_refinement(folder: Path) -> Iterator[Measurement]:
    """What pose refinement gains on noisy poses, scored at the true ones, in the mask."""
    capture = film_sample(folder / "noisy256", 256, **NOISE)
    recording = open_sample(capture)
    rig = Rig.from_shaped_body(recording.shaped)
    found: dict[bool, dict[str, MeanPsnr]] = {}
    for refines in (False, True):
        config = training_config(recording, WALL_SECONDS, refine_poses=refines)
        trainer, held = train_online(recording, rig, config)
        pictures = {
            "held out": with_true_poses(capture, held, rig),
            "novel poses": novel_pose_frames(capture, rig),
        }
        found[refines] = {n: mean_psnr(trainer.avatar, p) for n, p in pictures.items()}
    for name in ("held out", "novel poses"):
        off, on = found[False][name], found[True][name]
        yield Measurement(
            name=f"256 px, poses off by 2° and 1 cm: refinement gains, {name}, dB in the mask",
            value=on.psnr_mask - off.psnr_mask,
            required="2",
            context=f"60 s wall each, true poses: {off.psnr_mask:.2f} without, "
            f"{on.psnr_mask:.2f} with; whole picture {off.psnr:.2f} and {on.psnr:.2f}",
        )
