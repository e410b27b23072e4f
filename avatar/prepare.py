"""A frame made ready for training: its warp cells, and its pixels as rays of the body frame."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from avatar.cells import WarpCells
from avatar.rig import Rig
from capture.camera import Camera
from preprocess.observation import Observation
from preprocess.pose import BodyPose

NEAR = 0.035
"""Pixels this close to the mask, as a share of the picture's height, are trained on most."""
FAR = 0.04
"""How far beyond them, as a share of the picture's height, the rest of the pixels reach."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyRays:
    """Rays of one camera in the body frame of one pose.

    Attributes:
        origin: Where all of them start, metres.
        directions: Unit vectors.
    """

    origin: Float32[np.ndarray, "3"]
    directions: Float32[np.ndarray, "rays 3"]

    @classmethod
    def through(
        cls,
        pixels: Float[np.ndarray, "rays 2"],
        camera: Camera,
        world_from_body: Float[np.ndarray, "4 4"],
    ) -> "BodyRays":
        """Rays through points of the picture; the root's motion is taken out of the camera."""
        rotation, translation = world_from_body[:3, :3], world_from_body[:3, 3]
        return cls(
            origin=((camera.center_world - translation) @ rotation).astype(np.float32),
            directions=(camera.directions(pixels) @ rotation).astype(np.float32),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedFrame:
    """What replay keeps of an observation.

    Attributes:
        index: The frame's index in its source.
        pose: The body's pose.
        cells: The frame's warp.
        origin: Where its rays start, body frame, metres.
        directions: Of its trainable pixels, those near the person first.
        colors: Premultiplied RGBA of the same pixels.
        near: How many of them are near the person.
    """

    index: int
    pose: BodyPose
    cells: WarpCells
    origin: Float32[np.ndarray, "3"]
    directions: Float32[np.ndarray, "pixels 3"]
    colors: UInt8[np.ndarray, "pixels 4"]
    near: int


def prepare(observation: Observation, rig: Rig) -> PreparedFrame:
    """Solves the frame's warp and picks the pixels worth training on."""
    near, far = _worthwhile(observation.alpha)
    chosen = np.concatenate([near, far])
    width = observation.camera.size_px[0]
    pixels = np.stack([chosen % width + 0.5, chosen // width + 0.5], axis=1)
    world_from_body = rig.world_from_body(observation.pose)
    rays = BodyRays.through(pixels, observation.camera, world_from_body)
    alpha = observation.alpha.reshape(-1, 1)[chosen]
    color = observation.frame.rgb.reshape(-1, 3)[chosen]
    premultiplied = np.concatenate([color * alpha, alpha * 255.0], axis=1)
    return PreparedFrame(
        index=observation.frame.index,
        pose=observation.pose,
        cells=WarpCells.of(rig, observation.pose.joint_rotations),
        origin=rays.origin,
        directions=rays.directions,
        colors=np.round(premultiplied).astype(np.uint8),
        near=len(near),
    )


def _worthwhile(
    alpha: Float32[np.ndarray, "height width"],
) -> tuple[Int[np.ndarray, "near"], Int[np.ndarray, "far"]]:
    """Flat indices of the pixels near the person, and of the others in a box around them."""
    height = alpha.shape[0]
    kernel = np.ones((max(5, int(NEAR * height) | 1),) * 2, dtype=np.uint8)
    near = cv2.dilate((alpha > 0).astype(np.uint8), kernel) > 0
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    margin = int(FAR * height)
    box = np.zeros_like(near)
    box[
        max(0, rows[0] - margin) : rows[-1] + margin + 1,
        max(0, columns[0] - margin) : columns[-1] + margin + 1,
    ] = True
    return np.flatnonzero(near), np.flatnonzero(box & ~near)
