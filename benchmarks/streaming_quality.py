"""A played video from inside: the avatar is copied on the way, and scored when all is over."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame, subsample_evenly
from avatar.rig import Rig
from avatar.training.frame_stream import is_held_out, prepare_stream
from avatar.training.train import train, warm_up
from avatar.training.trainer import Trainer, cosine_decay
from baselines.hardware import Hardware
from benchmarks.measurements import Measurement
from benchmarks.sample_training import load_trainer, open_sample, training_config
from benchmarks.stopwatch import limit_threads
from benchmarks.training_quality import mean_psnr
from capture.inbox import Inbox
from capture.source import PacingClock, RealtimePlayback
from preprocess.capture_session import Capture
from preprocess.observation import DroppedFrame

EARLY_S, EARLY_EVERY_S, LATE_EVERY_S = 8.0, 0.5, 2.5
USABLE_DB = 25.0
SCORED_FRAMES = 8
"""Frames that a copy is scored on."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AvatarCopy:
    """The avatar at some second: all that training changes of it."""

    wall_seconds: float
    frames_seen: int
    tensors: tuple[Tensor, ...]


def trainable_tensors(avatar: Avatar) -> tuple[Tensor, ...]:
    """What training changes, in place."""
    grid = avatar.occupancy.density_grid
    return (*(p.detach() for p in avatar.field.parameters()), grid.density, grid.occupied)


def restore_copy(avatar: Avatar, copy: AvatarCopy) -> None:
    """Makes the avatar what it was."""
    for now, then in zip(trainable_tensors(avatar), copy.tensors, strict=True):
        now.copy_(then)


def train_with_copies(
    trainer: Trainer, recording: Capture
) -> tuple[list[AvatarCopy], list[HeldOutFrame]]:
    """Trains on a playing video; copies often at first, and one after the last step."""
    copies, held, due = list[AvatarCopy](), list[HeldOutFrame](), EARLY_EVERY_S
    every, total = trainer.config.held_out_stride, recording.source.frame_count
    items = prepare_stream(recording.observations(), trainer.avatar.rig, stride=every, total=total)
    inbox = Inbox(items, paced=recording.source.paced)

    def copy() -> None:
        tensors = tuple(part.clone() for part in trainable_tensors(trainer.avatar))
        seen = trainer.frames_seen
        copies.append(
            AvatarCopy(wall_seconds=trainer.wall_seconds, frames_seen=seen, tensors=tensors)
        )

    for _ in train(trainer, inbox, held):
        if trainer.wall_seconds >= due:
            copy()
            due += EARLY_EVERY_S if due < EARLY_S else LATE_EVERY_S
    recording.source.close()
    inbox.close()
    copy()
    return copies, held


def training_frames_at(
    recording: Capture, rig: Rig, wanted: Sequence[int], every: int
) -> list[HeldOutFrame]:
    """Frames of a recording by their place among those that are learnt from."""
    shown, place = [], -1
    for position, seen in enumerate(recording.observations()):
        if is_held_out(position, stride=every, total=recording.source.frame_count):
            continue
        place += 1
        if place > max(wanted):
            break
        if place in wanted and not isinstance(seen, DroppedFrame):
            cells = CorrespondenceGrid.solve(rig, seen.pose.joint_rotations)
            shown.append(HeldOutFrame(observation=seen, correspondences=cells))
    return shown


def measure_streaming_quality(capture: Path) -> Iterator[Measurement]:
    """Streaming beside learning with every frame at hand; old frames; the first picture."""
    recording = open_sample(capture)
    rig = Rig.from_shaped_body(recording.shaped)
    seconds = recording.source.duration_s
    assert seconds is not None
    config = training_config(recording, seconds)
    limit_threads(Hardware.here().cores)
    trainer = Trainer(rig, config)
    warm_up(trainer)
    copies, held = train_with_copies(
        trainer, replace(recording, source=RealtimePlayback(recording.source, PacingClock()))
    )
    streamed = mean_psnr(trainer.avatar, held)
    yield _first_usable(trainer.avatar, recording, rig, copies, config.held_out_stride)
    yield _forgetting(trainer.avatar, recording, rig, copies, config.held_out_stride)
    offline = load_trainer(recording, rig, config)
    train_for_wall_seconds(offline.trainer, trainer.wall_seconds)
    beside = mean_psnr(offline.trainer.avatar, offline.held_out)
    yield Measurement(
        name="held out at the last frame, to learning with every frame at hand, dB",
        value=streamed.psnr - beside.psnr,
        required="-1.0",
        stretch_goal="-0.3",
        context=f"streamed {streamed.psnr:.2f} ({streamed.psnr_mask:.2f} in the mask; "
        f"{trainer.steps:,} steps), at hand {beside.psnr:.2f} ({beside.psnr_mask:.2f}; "
        f"{offline.trainer.steps:,} steps, frames made ready before its "
        f"{trainer.wall_seconds:.0f} s began)",
    )


def train_for_wall_seconds(trainer: Trainer, seconds: float) -> None:
    """Trains for a wall time, seconds, over all of which the learning rate falls."""
    began = time.perf_counter()
    while (share := (time.perf_counter() - began) / seconds) < 1.0:
        trainer.step(rate=cosine_decay(share), hard_surface_share=min(1.0, 4.0 * share))


def _first_usable(
    avatar: Avatar, recording: Capture, rig: Rig, copies: Sequence[AvatarCopy], every: int
) -> Measurement:
    told = list[str]()
    for copy in copies:
        seen = sorted(
            {round(k * (copy.frames_seen - 1) / SCORED_FRAMES) for k in range(SCORED_FRAMES + 1)}
        )
        restore_copy(avatar, copy)
        found = mean_psnr(avatar, training_frames_at(recording, rig, seen, every)).psnr
        told.append(f"{copy.wall_seconds:.1f} s {found:.1f}")
        if found >= USABLE_DB:
            break
        if copy.wall_seconds > EARLY_S:
            break
    return Measurement(
        name=f"first picture of {USABLE_DB:.0f} dB on frames seen, s after the first frame",
        value=copy.wall_seconds if found >= USABLE_DB else None,
        required="≤ 5",
        stretch_goal="≤ 2",
        context=f"looked at every {EARLY_EVERY_S} s: {', '.join(told)}",
    )


def _forgetting(
    avatar: Avatar, recording: Capture, rig: Rig, copies: Sequence[AvatarCopy], every: int
) -> Measurement:
    tenth = max(1, copies[-1].frames_seen // 10)
    places = [round(k * (tenth - 1) / (SCORED_FRAMES - 1)) for k in range(SCORED_FRAMES)]
    frames = subsample_evenly(training_frames_at(recording, rig, places, every), SCORED_FRAMES)
    scores = list[float]()
    late = [copy for copy in copies if copy.frames_seen >= tenth and copy.wall_seconds > 2.0]
    for copy in [*late[:-1:3], late[-1]]:
        restore_copy(avatar, copy)
        scores.append(mean_psnr(avatar, frames).psnr)
    return Measurement(
        name="oldest tenth of the frames: below their best at the end, dB",
        value=max(scores) - scores[-1],
        required="≤ 1",
        stretch_goal="≤ 0.3",
        context=", ".join(f"{value:.1f}" for value in scores),
    )
