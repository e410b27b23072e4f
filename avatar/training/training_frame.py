"""A frame prepared for training: its correspondence grid, and its pixels as body-frame rays."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.deformation.rig import Rig
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.observation import Observation

NEAR_MASK_SHARE = 0.035
"""Distance from the mask within which pixels are near the person, in image heights."""
BOX_MARGIN_SHARE = 0.04
"""Margin of the training pixels around the near ones, in image heights."""


class RayView(NamedTuple):
    """Camera and pixels of a training frame.

    Attributes:
        camera: Camera of the image.
        near_person_bits: Mask of the pixels near the person, row by row, eight to a byte.
    """

    camera: Camera
    near_person_bits: UInt8[np.ndarray, "bytes"]


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingFrame:
    """An observation as the replay buffer takes it.

    Attributes:
        index: Index of the frame in its source.
        pose: Pose of the body.
        correspondences: Correspondence grid of the pose.
        origin: Origin of the rays, body frame, metres.
        directions: Unit directions of the training pixels, those near the person first.
        colors: Premultiplied RGBA of the same pixels.
        near_count: Number of pixels near the person.
        view: View from which the frame can be rebuilt with its colors alone; None if it need not
            be saved.
    """

    index: int
    pose: BodyPose
    correspondences: CorrespondenceGrid
    origin: Float32[np.ndarray, "3"]
    directions: Float32[np.ndarray, "pixels 3"]
    colors: UInt8[np.ndarray, "pixels 4"]
    near_count: int
    view: RayView | None = None


def prepare_frame(observation: Observation, rig: Rig) -> TrainingFrame:
    """Solves the frame's correspondences and selects its training pixels."""
    mask = _near_person_mask(observation.alpha)
    chosen = np.concatenate(_split_pixels(mask))
    sight = RayView(camera=observation.camera, near_person_bits=np.packbits(mask))
    colors = _premultiplied_rgba(observation, chosen)
    return rebuild_frame(observation.frame.index, observation.pose, sight, colors, rig)


def rebuild_frame(
    index: int, pose: BodyPose, view: RayView, colors: UInt8[np.ndarray, "pixels 4"], rig: Rig
) -> TrainingFrame:
    """Makes a frame ready from what is kept of it: finds its rays, and solves its warp."""
    camera = view.camera
    width, height = camera.size_px
    mask = (
        np.unpackbits(view.near_person_bits, count=width * height)
        .reshape(height, width)
        .astype(bool)
    )
    near, far = _split_pixels(mask)
    world_from_body = rig.world_from_body(pose)
    camera_from_body = camera.camera_from_world[:3, :3] @ world_from_body[:3, :3]
    sights = _camera_directions(
        camera.focal_px, camera.center_px, camera.size_px, camera.distortion
    )
    origin = (camera.center_world - world_from_body[:3, 3]) @ world_from_body[:3, :3]
    return TrainingFrame(
        index=index,
        pose=pose,
        correspondences=CorrespondenceGrid.solve(rig, pose.joint_rotations),
        origin=origin.astype(np.float32),
        directions=sights[np.concatenate([near, far])] @ camera_from_body.astype(np.float32),
        colors=colors,
        near_count=len(near),
        view=view,
    )


@lru_cache(maxsize=2)
def _camera_directions(
    focal_px: tuple[float, float],
    center_px: tuple[float, float],
    size_px: tuple[int, int],
    distortion: tuple[float, ...],
) -> Float32[np.ndarray, "pixels 3"]:
    """Unit directions through all pixels in the camera's axes: the same in every frame."""
    camera = Camera(
        focal_px=focal_px, center_px=center_px, size_px=size_px, distortion=distortion,
        camera_from_world=np.eye(4),
    )  # fmt: skip
    return camera.ray_directions(camera.pixel_centers().reshape(-1, 2)).astype(np.float32)


def _premultiplied_rgba(
    observation: Observation, chosen: Int[np.ndarray, "pixels"]
) -> UInt8[np.ndarray, "pixels 4"]:
    """Color times alpha, and alpha, of some pixels, in 8 bits."""
    alpha = observation.alpha.reshape(-1, 1)[chosen]
    premultiplied = np.empty((len(chosen), 4), dtype=np.float32)
    np.multiply(observation.frame.rgb.reshape(-1, 3)[chosen], alpha, out=premultiplied[:, :3])
    np.multiply(alpha, np.float32(255.0), out=premultiplied[:, 3:])
    return np.rint(premultiplied, out=premultiplied).astype(np.uint8)


def _near_person_mask(
    alpha: Float32[np.ndarray, "height width"],
) -> Bool[np.ndarray, "height width"]:
    """The pixels near the person."""
    kernel = np.ones((max(5, int(NEAR_MASK_SHARE * len(alpha)) | 1),) * 2, dtype=np.uint8)
    return cv2.dilate((alpha > 0).astype(np.uint8), kernel) > 0


def _split_pixels(
    near: Bool[np.ndarray, "height width"],
) -> tuple[Int[np.ndarray, "near"], Int[np.ndarray, "far"]]:
    """Flat indices of the pixels near the person, and of the others in a box around them."""
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    margin = int(BOX_MARGIN_SHARE * len(near))
    box = np.zeros_like(near)
    box[
        max(0, rows[0] - margin) : rows[-1] + margin + 1,
        max(0, columns[0] - margin) : columns[-1] + margin + 1,
    ] = True
    return np.flatnonzero(near), np.flatnonzero(box & ~near)
