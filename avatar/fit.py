"""Poses fitted to held-out frames with the avatar frozen: how much of an error is the pose's."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch

from avatar.cells import WarpCells
from avatar.events import Score
from avatar.hold import HeldOut, score
from avatar.pose_prior import guessed
from avatar.prepare import prepare
from avatar.refine import PoseTable
from avatar.replay import Replay
from avatar.sampling import CanonicalSampler
from avatar.step import cosine, gradients
from avatar.trainer import Trainer, let_follow, rebuild_warp

CORRECTIONS = 32
"""Corrections that each frame's pose gets."""
RAYS_A_CORRECTION = 512


FITTING_SHARE = 0.8
"""Of the time that fitting and scoring take."""


def fitted_scores(
    trainer: Trainer, held: list[HeldOut], *, progress: Callable[[float], None] = lambda _: None
) -> tuple[Score, ...]:
    """Scores of held-out frames after their poses have been fitted to them (see `fitted`)."""
    return tuple(found for _, found in fitted(trainer, held, progress=progress))


def fitted(
    trainer: Trainer, held: list[HeldOut], *, progress: Callable[[float], None] = lambda _: None
) -> Iterator[tuple[HeldOut, Score]]:
    """Held-out frames in poses that have been fitted to them, each with its score.

    The avatar stays as it is: nothing of these frames is learnt but where the body was, from where
    the frames around were found to be. A few
    hundred rays at a time say where to go, so an exact pose comes out a millimetre off; where the
    given pose shows the frame better, it stays.

    Args:
        trainer: Whose avatar; its field's gradients are overwritten.
        held: Frames that were never trained on.
        progress: Gets the share that is done, from 0 to 1.
    """
    if not held:
        return
    avatar, field = trainer.avatar, trainer.avatar.field
    device = field.table.device
    replay = Replay(len(held), device)
    poses = PoseTable(avatar.rig, len(held), device, frozen=True)
    for frame in held:
        prepared = prepare(frame.observation, avatar.rig)
        slot, begin = replay.add(prepared), guessed(prepared.index, trainer.corrections)
        poses.put(slot, prepared.pose, correction=begin)
        if begin.any():
            rebuild_warp(avatar.rig, replay, poses, slot)
    config = dataclasses.replace(
        trainer.config,
        empty_weight=0.0,
        solid_weight=0.0,
        gap_weight=0.0,
        rays=2 * RAYS_A_CORRECTION,
    )
    sampler = CanonicalSampler(field.backend, avatar.occupancy, config)
    generator = torch.Generator(device=device).manual_seed(config.seed)
    steps = math.ceil(CORRECTIONS * len(held) / 2)
    for step in range(steps):
        batch = replay.draw(config.rays, generator)
        gradients(
            field, sampler, replay.cells, batch, config,
            hard_share=1.0, poses=poses, generator=generator,
        )  # fmt: skip
        field.table_grad.zero_()
        for _ in range(2):
            let_follow(avatar.rig, trainer.backend, replay, poses, rate=cosine(step / steps))
        progress(FITTING_SHARE * (step + 1) / steps)
    for slot, frame in enumerate(held):
        pose = poses.pose(slot)
        cells = WarpCells.of(avatar.rig, pose.joint_rotations, device=device)
        moved = HeldOut(observation=replace(frame.observation, pose=pose), cells=cells)
        either = [(one, score(avatar, one)) for one in (frame, moved)]
        progress(FITTING_SHARE + (1.0 - FITTING_SHARE) * (slot + 1) / len(held))
        yield max(either, key=lambda scored: scored[1].psnr)
