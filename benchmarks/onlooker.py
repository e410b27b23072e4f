"""A played video from inside: the avatar is copied on the way, and scored when all is over."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from apps.recording.recording import Recording
from avatar.cells import WarpCells
from avatar.hold import HeldOut, is_held_out, prepared, spread
from avatar.model import Avatar
from avatar.rig import Rig
from avatar.step import cosine
from avatar.train import train
from avatar.trainer import Trainer
from avatar.warm import warm_up
from benchmarks.hardware import Hardware
from benchmarks.marks import Mark
from benchmarks.quality import quality
from benchmarks.stage import assembled, opened, recipe
from benchmarks.stopwatch import use_threads
from capture.inbox import Inbox
from preprocess.observe import Dropped

EARLY_S, EARLY_EVERY_S, LATE_EVERY_S = 8.0, 0.5, 2.5
USABLE_DB = 25.0
LOOKED_AT = 8
"""Frames that a copy is scored on."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Copy:
    """The avatar at some second: all that training changes of it."""

    wall_seconds: float
    frames_seen: int
    tensors: tuple[Tensor, ...]


def parts(avatar: Avatar) -> tuple[Tensor, ...]:
    """What training changes, in place."""
    grid = avatar.occupancy.grid
    return (*(p.detach() for p in avatar.field.parameters()), grid.density, grid.occupied)


def shown_again(avatar: Avatar, copy: Copy) -> None:
    """Makes the avatar what it was."""
    for now, then in zip(parts(avatar), copy.tensors, strict=True):
        now.copy_(then)


def copied_on_the_way(trainer: Trainer, recording: Recording) -> tuple[list[Copy], list[HeldOut]]:
    """Trains on a playing video; copies often at first, and one after the last step."""
    copies, held, due = list[Copy](), list[HeldOut](), EARLY_EVERY_S
    every, total = trainer.config.hold_every, recording.source.frame_count
    items = prepared(recording.observations(), trainer.avatar.rig, every=every, total=total)
    inbox = Inbox(items, paced=recording.source.paced)

    def copy() -> None:
        tensors = tuple(part.clone() for part in parts(trainer.avatar))
        seen = trainer.frames_seen
        copies.append(Copy(wall_seconds=trainer.wall_seconds, frames_seen=seen, tensors=tensors))

    for _ in train(trainer, inbox, held):
        if trainer.wall_seconds >= due:
            copy()
            due += EARLY_EVERY_S if due < EARLY_S else LATE_EVERY_S
    recording.source.close()
    inbox.close()
    copy()
    return copies, held


def learnt_from(recording: Recording, rig: Rig, wanted: Sequence[int], every: int) -> list[HeldOut]:
    """Frames of a recording by their place among those that are learnt from."""
    shown, place = [], -1
    for position, seen in enumerate(recording.observations()):
        if is_held_out(position, every=every, total=recording.source.frame_count):
            continue
        place += 1
        if place > max(wanted):
            break
        if place in wanted and not isinstance(seen, Dropped):
            cells = WarpCells.of(rig, seen.pose.joint_rotations)
            shown.append(HeldOut(observation=seen, cells=cells))
    return shown


def onlooker_marks(capture: Path) -> Iterator[Mark]:
    """Streaming beside learning with every frame at hand; old frames; the first picture."""
    recording, device = opened(capture), torch.device("cpu")
    rig = Rig.of(recording.shaped)
    seconds = recording.source.duration_s
    assert seconds is not None
    config = recipe(recording, seconds)
    use_threads(Hardware.here().cores)
    trainer = Trainer(rig, config, device)
    warm_up(trainer)
    copies, held = copied_on_the_way(trainer, recording.played())
    streamed = quality(trainer.avatar, held)
    yield _first_usable(trainer.avatar, recording, rig, copies, config.hold_every)
    yield _oldest(trainer.avatar, recording, rig, copies, config.hold_every)
    offline = assembled(recording, rig, config, device)
    train_for_wall_seconds(offline.trainer, trainer.wall_seconds)
    beside = quality(offline.trainer.avatar, offline.held)
    yield Mark(
        name="held out at the last frame, to learning with every frame at hand, dB",
        value=streamed.psnr - beside.psnr,
        least="-1.0",
        moonshot="-0.3",
        beside=f"streamed {streamed.psnr:.2f} ({streamed.psnr_mask:.2f} in the mask; "
        f"{trainer.steps:,} steps), at hand {beside.psnr:.2f} ({beside.psnr_mask:.2f}; "
        f"{offline.trainer.steps:,} steps, frames made ready before its "
        f"{trainer.wall_seconds:.0f} s began)",
    )


def train_for_wall_seconds(trainer: Trainer, seconds: float) -> None:
    """Trains for so much time, with the rate falling over all of it."""
    began = time.perf_counter()
    while (share := (time.perf_counter() - began) / seconds) < 1.0:
        trainer.step(rate=cosine(share), hard_share=min(1.0, 4.0 * share))


def _first_usable(
    avatar: Avatar, recording: Recording, rig: Rig, copies: Sequence[Copy], every: int
) -> Mark:
    told = list[str]()
    for copy in copies:
        seen = sorted({round(k * (copy.frames_seen - 1) / LOOKED_AT) for k in range(LOOKED_AT + 1)})
        shown_again(avatar, copy)
        found = quality(avatar, learnt_from(recording, rig, seen, every)).psnr
        told.append(f"{copy.wall_seconds:.1f} s {found:.1f}")
        if found >= USABLE_DB:
            break
        if copy.wall_seconds > EARLY_S:
            break
    return Mark(
        name=f"first picture of {USABLE_DB:.0f} dB on frames seen, s after the first frame",
        value=copy.wall_seconds if found >= USABLE_DB else None,
        least="≤ 5",
        moonshot="≤ 2",
        beside=f"looked at every {EARLY_EVERY_S} s: {', '.join(told)}",
    )


def _oldest(
    avatar: Avatar, recording: Recording, rig: Rig, copies: Sequence[Copy], every: int
) -> Mark:
    tenth = max(1, copies[-1].frames_seen // 10)
    places = [round(k * (tenth - 1) / (LOOKED_AT - 1)) for k in range(LOOKED_AT)]
    frames = spread(learnt_from(recording, rig, places, every), LOOKED_AT)
    scores = list[float]()
    late = [copy for copy in copies if copy.frames_seen >= tenth and copy.wall_seconds > 2.0]
    for copy in [*late[:-1:3], late[-1]]:
        shown_again(avatar, copy)
        scores.append(quality(avatar, frames).psnr)
    return Mark(
        name="oldest tenth of the frames: below their best at the end, dB",
        value=max(scores) - scores[-1],
        least="≤ 1",
        moonshot="≤ 0.3",
        beside=", ".join(f"{value:.1f}" for value in scores),
    )
