"""Fits poses and exposures to held-out frames with the avatar frozen, to separate their errors."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame, PixelSample
from avatar.training.frame_exposure import FrameExposures
from avatar.training.frame_stream import prepare_frame
from avatar.training.pose_correction import interpolate_correction
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.replay_buffer import ReplayBuffer
from avatar.training.trainer import Trainer, correct_poses, cosine_decay, resolve_correspondences
from avatar.training.training_step import compute_gradients

CORRECTIONS_PER_FRAME = 12
"""Corrections of each frame's pose."""
RAYS_PER_CORRECTION = 4096
"""Rays per correction of a pose: few corrections by many rays end nearer than many by few."""
FITTING_SHARE = 0.8
"""Share of fitting in the time that fitting and scoring take, for the progress."""


def fit_test_poses(
    trainer: Trainer,
    frames: list[HeldOutFrame],
    *,
    progress: Callable[[float], None] = lambda _: None,
) -> Iterator[HeldOutFrame]:
    """Held-out frames in poses and exposures fitted to them.

    The avatar is frozen; only poses and exposures are optimized, starting from those of neighboring
    frames. Each correction follows some of the frame's rays, so that even an exact pose moves a
    little; the given pose, or exposure, is kept where it scores higher on a sample of the pixels.
    """
    if not frames:
        return
    avatar = trainer.avatar
    replay, poses = _with_neighboring_corrections(trainer, frames)
    exposures = FrameExposures(len(frames), avatar_frozen=True)
    for slot, index in enumerate(replay.frame_indices):
        exposures.set_frame(slot, index, trainer.exposures.expected_gain(index))
    _fit_frames(trainer, replay, poses, exposures, progress)
    for slot, frame in enumerate(frames):
        pose, gain = poses.pose(slot), exposures.gains[slot].numpy()
        cells = CorrespondenceGrid.solve(avatar.rig, pose.joint_rotations)
        progress(FITTING_SHARE + (1.0 - FITTING_SHARE) * (slot + 1) / len(frames))
        yield _choose(avatar, frame, frame.moved(pose, cells, gain))


def _choose(avatar: Avatar, given: HeldOutFrame, moved: HeldOutFrame) -> HeldOutFrame:
    """The frame as given, in the other's exposure, or moved: where its pixels score best."""
    sample = PixelSample.of(given, density=2)
    colors = sample.render_colors(avatar)
    options = [
        (given, colors),
        (replace(given, gain=moved.gain), colors),
        (moved, replace(sample, frame=moved).render_colors(avatar)),
    ]
    return max(options, key=lambda option: sample.psnr(option[0].expose(option[1])))[0]


def _fit_frames(
    trainer: Trainer,
    replay: ReplayBuffer,
    poses: PoseOptimizer,
    exposures: FrameExposures,
    progress: Callable[[float], None],
) -> None:
    avatar = replace(trainer.avatar, field=trainer.avatar.field.frozen())
    at_once = min(2, len(replay))
    config = dataclasses.replace(
        trainer.config,
        empty_space_weight=0.0,
        interior_weight=0.0,
        head_interior_weight=0.0,
        off_skin_weight=0.0,
        rays=at_once * RAYS_PER_CORRECTION,
    )
    generator = torch.Generator().manual_seed(config.seed)
    steps = math.ceil(CORRECTIONS_PER_FRAME * len(replay) / at_once)
    for step in range(steps):
        if step >= 0.5 * steps:  # so near now that the finer levels point to the right place, too
            poses.min_gradient_cell_m = 0.0
        batch = replay.sample_rays(config.rays, generator)
        result = compute_gradients(
            avatar, replay.correspondences, exposures.neutralize(batch), config,
            hard_surface_share=1.0, poses=poses, generator=generator,
        )  # fmt: skip
        if config.estimate_exposures:
            exposures.observe(batch, result.rendered)
        correct_poses(replay, poses, at_once, rate=cosine_decay(step / steps))
        progress(FITTING_SHARE * (step + 1) / steps)


def _with_neighboring_corrections(
    trainer: Trainer, frames: list[HeldOutFrame]
) -> tuple[ReplayBuffer, PoseOptimizer]:
    """The frames and their poses, slot by slot, corrected like the frames about them."""
    rig, replay = trainer.avatar.rig, ReplayBuffer(len(frames))
    poses = PoseOptimizer(
        rig,
        len(frames),
        poses_may_be_exact=False,
        rays_per_frame=RAYS_PER_CORRECTION,
        prior_precision=0.25,  # the avatar is frozen
        equation_decay=0.0,
    )
    for frame in frames:
        prepared = prepare_frame(frame.observation, rig)
        slot = replay.add(prepared)
        begin = interpolate_correction(prepared.index, trainer.pose_corrections)
        poses.set_pose(slot, prepared.pose, correction=begin)
        if begin.any():
            resolve_correspondences(replay, poses, slot)
    return replay, poses
