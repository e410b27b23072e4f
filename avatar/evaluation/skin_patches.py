"""The skin in small patches: where each lies and looks, and how a camera sees it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from avatar.rig import PART_OF_JOINT
from preprocess.body.body_surface import (
    vertex_areas,
    vertex_normals,
    visible_from_anywhere,
    visible_points,
)
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import Observation

PART_NAMES = (
    "torso", "left thigh", "right thigh", "left shin", "right shin", "left foot", "right foot",
    "head", "left upper arm", "right upper arm", "left forearm", "right forearm", "left hand",
    "right hand",
)  # fmt: skip
"""The 14 body parts of `avatar.rig.PART_OF_JOINT`; left is the person's left."""
SIDE_NAMES = ("front", "back", "left", "right", "top", "under")
"""Directions of the patches in the T-pose; `under` is the underside."""
ARM_PARTS, FOOT_PARTS = slice(8, 14), (5, 6)
PATCH_M = 0.022
OCCLUSION_TOLERANCE_M = 0.01
MAX_SOLE_NORMAL_Y = -0.5
"""Upward component of a foot's normal below which it is a sole and left out."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinPatches:
    """Pieces of skin of about 2 cm that are visible from around the person.

    Attributes:
        points: Centres in the rest pose (SMPL's T-pose), metres; `normals` point outward.
        areas: In square metres.
        parts, sides: Indices into `PART_NAMES` and `SIDE_NAMES`. Arms and hands have front, back,
            top and under; the others front, back, left and right.
    """

    points: Float32[np.ndarray, "patches 3"]
    normals: Float32[np.ndarray, "patches 3"]
    areas: Float32[np.ndarray, "patches"]
    weights: Float32[np.ndarray, "patches 24"]
    parts: Int[np.ndarray, "patches"]
    sides: Int[np.ndarray, "patches"]

    @classmethod
    def from_shaped_body(cls, shaped: ShapedBody) -> "SkinPatches":
        """The patches of one person: vertices of the same 2-cm voxel, part and side, together.

        The inside of the mouth and the soles, which are never visible, are left out.
        """
        weights = shaped.body.weights
        surface = shaped.vertices, shaped.body.faces
        normals, areas = vertex_normals(*surface), vertex_areas(*surface)
        parts = PART_OF_JOINT[weights.argmax(axis=1)]
        sides = _side_of_vertex(normals, parts)
        voxels = np.floor(shaped.vertices / PATCH_M).astype(np.int64)
        keys = np.column_stack([voxels, parts, sides])
        _, first, patch = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        patch = patch.reshape(-1)

        def mean(values: Float[np.ndarray, "vertices n"]) -> Float32[np.ndarray, "patches n"]:
            total = np.zeros((len(first), values.shape[1]))
            np.add.at(total, patch, values * areas[:, None])
            return (total / size[:, None]).astype(np.float32)

        size = np.bincount(patch, weights=areas)
        normals = mean(normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        points, parts, sides = mean(shaped.vertices), parts[first], sides[first]
        shown = visible_from_anywhere(
            points, normals, cell_m=PATCH_M, tolerance_m=OCCLUSION_TOLERANCE_M, min_cosine=0.3
        ) & ~(np.isin(parts, FOOT_PARTS) & (normals[:, 1] < MAX_SOLE_NORMAL_Y))
        return cls(
            points=points[shown],
            normals=normals[shown],
            areas=size[shown].astype(np.float32),
            weights=mean(weights)[shown],
            parts=parts[shown],
            sides=sides[shown],
        )


def _side_of_vertex(
    normals: Float[np.ndarray, "vertices 3"], parts: Int[np.ndarray, "vertices"]
) -> Int[np.ndarray, "vertices"]:
    """The side of its part that each vertex is on: four around an arm, four around the rest."""
    x, y, z = normals.T
    is_arm = (parts >= ARM_PARTS.start) & (parts < ARM_PARTS.stop)
    across = np.where(is_arm, y, x)
    sideways = np.where(is_arm, np.where(y > 0.0, 4, 5), np.where(x > 0.0, 2, 3))
    return np.where(np.abs(z) >= np.abs(across), np.where(z > 0.0, 0, 1), sideways)


@dataclass(frozen=True, eq=False, kw_only=True)
class PatchView:
    """The patches of a posed body, as a camera sees them.

    `cosines` are those between the normals and the directions to the camera; `unoccluded` patches
    face it with no other before them.
    """

    cosines: Float[np.ndarray, "patches"]
    unoccluded: Bool[np.ndarray, "patches"]
    pixels: Float[np.ndarray, "patches 2"]


def view_patches(
    patches: SkinPatches, shaped: ShapedBody, observation: Observation
) -> PatchView | None:
    """Project the patches in a frame's pose; None if some are behind the camera."""
    camera, body = observation.camera, shaped.with_pose(observation.pose)
    points, normals = pose_patches(patches, body.world_from_rest())
    to_camera = camera.center_world - points
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    cosines = np.einsum("pa,pa->p", to_camera, normals)
    in_camera = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    depths = in_camera[:, 2]
    if depths.min() <= 0.0:
        return None
    plane = in_camera[:, :2] / depths[:, None] * depths.mean()
    free = visible_points(plane, depths, cosines)
    return PatchView(cosines=cosines, unoccluded=free, pixels=camera.project(points))


def pose_patches(
    patches: SkinPatches, world_from_rest: Float[np.ndarray, "24 4 4"]
) -> tuple[Float32[np.ndarray, "patches 3"], Float32[np.ndarray, "patches 3"]]:
    """Centres and unit normals of the patches in the world, by linear blend skinning."""
    joints = world_from_rest[:, :3].reshape(24, 12).astype(np.float32)
    blended = (patches.weights @ joints).reshape(-1, 3, 4)
    points = np.einsum("pab,pb->pa", blended[:, :, :3], patches.points) + blended[:, :, 3]
    normals = np.einsum("pab,pb->pa", blended[:, :, :3], patches.normals)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)
