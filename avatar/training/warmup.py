"""Compiles the kernels before the clock starts, in a trainer that is thrown away."""

import dataclasses
import time

import numpy as np
from jaxtyping import UInt8

from avatar.pose.pose_optimizer import FIRST_CORRECTION_STEPS
from avatar.render import render
from avatar.rig import Rig
from avatar.training.trainer import Trainer
from avatar.training.training_frame import RayView, TrainingFrame, rebuild_frame
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

WARMUP_IMAGE_PX = 16
"""Width and height of the warm-up's image, pixels."""


def warm_up(trainer: Trainer) -> float:
    """Compiles, or loads from disk, every kernel that training and rendering use.

    Must run on the thread that will train. The trainer itself is not changed.

    Returns:
        How many seconds it took: tens on a machine's first run, about one later.
    """
    began = time.perf_counter()
    rig, device = trainer.avatar.rig, trainer.avatar.field.table.device
    config = dataclasses.replace(trainer.config, rays=64, empty_space_points=16, density_tv_pairs=8)
    stand_in = Trainer(rig, config, device)
    camera = _front_camera(rig)
    stand_in.add_frame(_dummy_frame(rig, camera))
    stand_in.steps = FIRST_CORRECTION_STEPS
    for _ in range(config.occupancy_interval):
        stand_in.step(rate=1.0, hard_surface_share=1.0)
    poses = stand_in.poses  # an exact pose does not move, and nothing would have followed it
    stand_in.backend.update_roots(
        stand_in.replay.correspondences, 0, poses.skinning, poses.bones[0]
    )
    render(stand_in.avatar, BodyPose.rest(), camera)
    return time.perf_counter() - began


def _front_camera(rig: Rig) -> Camera:
    camera_from_world = np.diag([1.0, -1.0, -1.0, 1.0])
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ (rig.rest_joints[0] + [0.0, 0.0, 3.0])
    return Camera(
        focal_px=(WARMUP_IMAGE_PX * 1.5, WARMUP_IMAGE_PX * 1.5),
        center_px=(WARMUP_IMAGE_PX / 2, WARMUP_IMAGE_PX / 2),
        size_px=(WARMUP_IMAGE_PX, WARMUP_IMAGE_PX),
        camera_from_world=camera_from_world,
    )


def _dummy_frame(rig: Rig, camera: Camera) -> TrainingFrame:
    pose = BodyPose.rest()
    width, height = camera.size_px
    near = np.full((height, width), True)
    colors: UInt8[np.ndarray, "pixels 4"] = np.full((near.size, 4), 255, dtype=np.uint8)
    view = RayView(camera=camera, near_person_bits=np.packbits(near))
    return rebuild_frame(0, pose, view, colors, rig)
