"""Fits poses to held-out frames with the avatar frozen, to separate the poses' errors."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch

from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.events import HeldOutScore
from avatar.pose.pose_optimizer import PoseOptimizer
from avatar.pose.temporal_prior import interpolate_correction
from avatar.training.optimizer import cosine_decay
from avatar.training.replay_buffer import ReplayBuffer
from avatar.training.trainer import Trainer, correct_one_pose, resolve_correspondences
from avatar.training.training_frame import prepare_frame
from avatar.training.training_step import OccupancySampler, compute_gradients

CORRECTIONS_PER_FRAME = 32
"""Corrections of each frame's pose."""
RAYS_PER_CORRECTION = 512
"""Rays per correction of a pose."""
FITTING_SHARE = 0.8
"""Share of fitting in the time that fitting and scoring take, for the progress."""


def score_with_fitted_poses(
    trainer: Trainer,
    frames: list[HeldOutFrame],
    *,
    given: Sequence[HeldOutScore] | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[HeldOutScore, ...]:
    """Scores of held-out frames in poses fitted to them (`fit_test_poses`)."""
    fitted = fit_test_poses(trainer, frames, given=given, progress=progress)
    return tuple(score for _, score in fitted)


def fit_test_poses(
    trainer: Trainer,
    frames: list[HeldOutFrame],
    *,
    given: Sequence[HeldOutScore] | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Iterator[tuple[HeldOutFrame, HeldOutScore]]:
    """Held-out frames in poses that have been fitted to them, each with its score.

    The avatar is frozen; only the poses are optimized, starting from the corrections of neighboring
    frames. Each correction uses a few hundred rays, so an exact pose ends about a millimetre off;
    the given pose is kept where it scores higher.

    Args:
        trainer: Trainer of the avatar; the gradients of its field are overwritten.
        frames: Frames that were never trained on.
        given: Their scores in the given poses, if these have been measured already.
        progress: Receives the completed share, from 0 to 1.
    """
    if not frames:
        return
    avatar, field = trainer.avatar, trainer.avatar.field
    device = field.table.device
    replay, poses = _with_neighboring_corrections(trainer, frames)
    config = dataclasses.replace(
        trainer.config,
        empty_space_weight=0.0,
        interior_weight=0.0,
        inner_leg_weight=0.0,
        rays=2 * RAYS_PER_CORRECTION,
    )
    sampler = OccupancySampler(field.backend, avatar.occupancy, config)
    generator = torch.Generator(device=device).manual_seed(config.seed)
    steps = math.ceil(CORRECTIONS_PER_FRAME * len(frames) / 2)
    for step in range(steps):
        batch = replay.sample_rays(config.rays, generator)
        compute_gradients(
            avatar, sampler, replay.correspondences, batch, config,
            hard_surface_share=1.0, poses=poses, generator=generator,
        )  # fmt: skip
        field.table_grad.zero_()
        for _ in range(2):
            rate = cosine_decay(step / steps)
            correct_one_pose(avatar.rig, trainer.backend, replay, poses, rate=rate)
        progress(FITTING_SHARE * (step + 1) / steps)
    for slot, frame in enumerate(frames):
        pose = poses.pose(slot)
        cells = CorrespondenceGrid.solve(avatar.rig, pose.joint_rotations, device=device)
        moved = HeldOutFrame(
            observation=replace(frame.observation, pose=pose), correspondences=cells
        )
        before = score_frame(avatar, frame) if given is None else given[slot]
        either = [(frame, before), (moved, score_frame(avatar, moved))]
        progress(FITTING_SHARE + (1.0 - FITTING_SHARE) * (slot + 1) / len(frames))
        yield max(either, key=lambda scored: scored[1].psnr)


def _with_neighboring_corrections(
    trainer: Trainer, frames: list[HeldOutFrame]
) -> tuple[ReplayBuffer, PoseOptimizer]:
    """The frames and their poses, slot by slot, corrected like the frames about them."""
    rig, device = trainer.avatar.rig, trainer.avatar.field.table.device
    replay = ReplayBuffer(len(frames), device)
    poses = PoseOptimizer(rig, len(frames), device, avatar_frozen=True)
    for frame in frames:
        prepared = prepare_frame(frame.observation, rig)
        slot = replay.add(prepared)
        begin = interpolate_correction(prepared.index, trainer.pose_corrections)
        poses.set_pose(slot, prepared.pose, correction=begin)
        if begin.any():
            resolve_correspondences(rig, replay, poses, slot)
    return replay, poses
