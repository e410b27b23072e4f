"""Compiling before the clock runs: a throw-away step on a throw-away frame."""

import dataclasses
import time

import numpy as np
from jaxtyping import UInt8

from avatar.cells import WarpCells
from avatar.prepare import BodyRays, PreparedFrame
from avatar.refine import BEGUN_AFTER_STEPS
from avatar.render import render
from avatar.rig import Rig
from avatar.trainer import Trainer
from capture.camera import Camera
from preprocess.pose import BodyPose

SIDE_PX = 16


def warm_up(trainer: Trainer) -> float:
    """Compiles, or loads from disk, every kernel that training and rendering use.

    Must run on the thread that will train. The trainer itself is not touched.

    Returns:
        How many seconds it took: tens on a machine's first run, about one later.
    """
    began = time.perf_counter()
    rig, device = trainer.avatar.rig, trainer.avatar.field.table.device
    config = dataclasses.replace(trainer.config, rays=64, empty_points=16, variation_pairs=8)
    stand_in = Trainer(rig, config, device)
    camera = _camera_before(rig)
    stand_in.add(_frame(rig, camera))
    stand_in.steps = BEGUN_AFTER_STEPS
    for _ in range(config.occupancy_every):
        stand_in.step(rate=1.0, hard_share=1.0)
    poses = stand_in.poses  # an exact pose does not move, and nothing would have followed it
    stand_in.backend.follow(stand_in.replay.cells, 0, poses.skin, poses.bones[0])
    render(stand_in.avatar, BodyPose.rest(), camera)
    return time.perf_counter() - began


def _camera_before(rig: Rig) -> Camera:
    camera_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ (rig.rest_joints[0] + [0.0, 0.0, 3.0])
    return Camera(
        focal_px=(SIDE_PX * 1.5, SIDE_PX * 1.5),
        center_px=(SIDE_PX / 2, SIDE_PX / 2),
        size_px=(SIDE_PX, SIDE_PX),
        camera_from_world=camera_from_world,
    )


def _frame(rig: Rig, camera: Camera) -> PreparedFrame:
    pose = BodyPose.rest()
    pixels = camera.pixel_centers().reshape(-1, 2)
    rays = BodyRays.through(pixels, camera, rig.world_from_body(pose))
    colors: UInt8[np.ndarray, "pixels 4"] = np.full((len(pixels), 4), 255, dtype=np.uint8)
    return PreparedFrame(
        index=0,
        pose=pose,
        cells=WarpCells.of(rig, pose.joint_rotations),
        origin=rays.origin,
        directions=rays.directions,
        colors=colors,
        near=len(pixels),
    )
