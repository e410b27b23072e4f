"""A person's skin and bones in torch, poses with gradients, and the space that a body may fill."""

import math
from typing import NamedTuple, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from scipy.ndimage import distance_transform_edt
from torch import Tensor, nn

from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame
from preprocess.body.kinematics import body_from_rest
from preprocess.body.parametric_body import ShapedBody

MAX_VERTICES = 7000
"""Most vertices of the skin; SMPL has 6,890, and a finer body is thinned out to as many."""
CELL_M = 0.04
"""Edge of the cells that a ray is sampled in, metres."""


class PosedBodies(NamedTuple):
    """Bodies in their own body frames, with gradients to their poses where those are optimized.

    Attributes:
        bones: Transforms of the bones, body frame from canonical.
        vertices: Skin, metres; without gradients.
        frames: Training frame that each body belongs to; -1 for a pose that was never seen.
    """

    bones: Float32[Tensor, "bodies 24 4 4"]
    vertices: Float32[Tensor, "bodies vertices 3"]
    frames: Int64[Tensor, "bodies"]


@final
class SkinnedPerson:
    """A person's canonical skin; the canonical pose is the product's (`Rig`).

    Attributes:
        rig: The product's rig of the same person.
        vertices: Canonical skin, metres.
        weights: Skinning weights of the vertices.
    """

    def __init__(self, rig: Rig, shaped: ShapedBody) -> None:
        """Thins the skin out to `MAX_VERTICES`."""
        every = math.ceil(len(shaped.vertices) / MAX_VERTICES)
        weights = shaped.body.weights[::every]
        canonical = body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
        blended = np.einsum("vj,jab->vab", weights, canonical)[:, :3]
        rest = shaped.vertices[::every]
        skin = np.einsum("vab,vb->va", blended[..., :3], rest) + blended[..., 3]
        self.rig = rig
        self.vertices = torch.from_numpy(skin).float()
        self.weights = torch.from_numpy(weights).float()
        self._rest_joints = torch.from_numpy(rig.rest_joints).float()
        self._rest_from_canonical = torch.from_numpy(np.linalg.inv(canonical)).float()

    def bones(
        self, joint_rotations: Float32[Tensor, "bodies 23 3"]
    ) -> Float32[Tensor, "bodies 24 4 4"]:
        """Transforms that skinning blends, body frame from canonical, the root at rest."""
        turns = rotation_matrices(joint_rotations)
        still = torch.eye(3).expand(len(turns), 1, 3, 3)
        turns, joints = torch.cat([still, turns], dim=1), self._rest_joints
        last = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(len(turns), 1, 4)
        chain: list[Tensor] = []
        for joint, parent in enumerate(self.rig.parents):
            offset = joints[joint] - (joints[parent] if parent >= 0 else 0.0)
            offset = offset.expand(len(turns), 3)[..., None]
            local = torch.cat([torch.cat([turns[:, joint], offset], dim=2), last], dim=1)
            chain.append(chain[parent] @ local if parent >= 0 else local)
        posed = torch.stack(chain, dim=1)
        shift = posed[..., :3, 3] - (posed[..., :3, :3] @ joints[..., None])[..., 0]
        posed = torch.cat(
            [torch.cat([posed[..., :3, :3], shift[..., None]], -1), posed[..., 3:, :]], -2
        )
        return posed @ self._rest_from_canonical

    def pose(
        self, joint_rotations: Float32[Tensor, "bodies 23 3"], frames: Int64[Tensor, "bodies"]
    ) -> PosedBodies:
        """Bodies in poses."""
        bones = self.bones(joint_rotations)
        with torch.no_grad():
            vertices = apply_affine(blend(self.weights, bones), self.vertices)
        return PosedBodies(bones, vertices, frames)


def rotation_matrices(vectors: Float32[Tensor, "*batch 3"]) -> Float32[Tensor, "*batch 3 3"]:
    """Rotation matrices of axis-angles, radians (Rodrigues); smooth at zero."""
    squared = (vectors * vectors).sum(dim=-1)[..., None, None] + 1e-12
    angle = squared.sqrt()
    x, y, z = vectors.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    cross = cross.unflatten(-1, (3, 3))
    return (
        torch.eye(3)
        + torch.sin(angle) / angle * cross
        + (1.0 - torch.cos(angle)) / squared * (cross @ cross)
    )


def blend(
    weights: Float32[Tensor, "points 24"], bones: Float32[Tensor, "bodies 24 4 4"]
) -> Float32[Tensor, "bodies points 3 4"]:
    """Linear blend skinning: the affine maps of points with these weights, in each body."""
    return (weights @ bones[:, :, :3].flatten(2)).unflatten(2, (3, 4))


def apply_affine(
    maps: Float32[Tensor, "*batch 3 4"], points: Float32[Tensor, "*points 3"]
) -> Float32[Tensor, "*batch 3"]:
    """Points under affine maps."""
    return (maps[..., :3] @ points[..., None])[..., 0] + maps[..., 3]


def invert_affine(maps: Float32[Tensor, "*batch 3 4"]) -> Float32[Tensor, "*batch 3 4"]:
    """Inverse affine maps; blended rotations are invertible, but no rotations."""
    inverse = torch.linalg.inv(maps[..., :3])
    return torch.cat([inverse, -inverse @ maps[..., 3:]], dim=-1)


@final
class PoseTable(nn.Module):
    """Poses of the training frames, with corrections that may be optimized.

    Attributes:
        joints: Corrections of the joint rotations, axis-angle, radians.
        root: Corrections of the root in its body frame: axis-angle about the pelvis, then metres.
    """

    def __init__(self, person: SkinnedPerson, frames: list[TrainingFrame]) -> None:
        """Starts from the poses as given."""
        super().__init__()
        given = np.stack([frame.pose.joint_rotations for frame in frames])
        self._person = person
        self._given = torch.from_numpy(given).float()
        self._pelvis = torch.from_numpy(person.rig.rest_joints[0]).float()
        self.joints = nn.Parameter(torch.zeros(len(frames), 23, 3))
        self.root = nn.Parameter(torch.zeros(len(frames), 6))

    def bodies(self, frames: Int64[Tensor, "bodies"]) -> PosedBodies:
        """The bodies of some frames."""
        return self._person.pose(self._given[frames] + self.joints[frames], frames)

    def move_rays(
        self, origins: Float32[Tensor, "rays 3"], directions: Float32[Tensor, "rays 3"],
        frames: Int64[Tensor, "rays"],
    ) -> tuple[Float32[Tensor, "rays 3"], Float32[Tensor, "rays 3"]]:  # fmt: skip
        """Rays of the given roots' body frames, seen from the corrected ones."""
        turn = rotation_matrices(self.root[frames, :3])
        about = (turn @ (origins - self._pelvis)[..., None])[..., 0]
        return about + self._pelvis + self.root[frames, 3:], (turn @ directions[..., None])[..., 0]


class OccupiedCells(NamedTuple):
    """Cells of each body in which there may be density, row by row, one body after the other.

    Attributes:
        low: First corner of each body's grid, metres.
        shape: Number of cells along each axis.
        first: Index of each body's first cell.
        occupied: Whether rays are sampled in a cell.
        cell_m: Edge of a cell, metres.
    """

    low: Float32[Tensor, "bodies 3"]
    shape: Int64[Tensor, "bodies 3"]
    first: Int64[Tensor, "bodies"]
    occupied: Bool[Tensor, "cells"]
    cell_m: float

    @classmethod
    def around(
        cls, vertices: Float32[Tensor, "bodies vertices 3"], reach_m: float
    ) -> "OccupiedCells":
        """All cells whose centers lie within a distance of the vertices, and a little more."""
        low = vertices.amin(dim=1) - reach_m - CELL_M
        shape = ((vertices.amax(dim=1) + reach_m + CELL_M - low) / CELL_M).ceil().long()
        grids = []
        for skin, corner, size in zip(vertices, low, shape, strict=True):
            empty = np.ones(size.tolist(), dtype=bool)
            empty[tuple(((skin - corner) / CELL_M).long().T.numpy())] = False
            away = distance_transform_edt(empty)
            grids.append(
                torch.from_numpy(np.asarray(away) * CELL_M < reach_m + 0.5 * CELL_M).flatten()
            )
        sizes = shape.prod(dim=1)
        return cls(low, shape, sizes.cumsum(dim=0) - sizes, torch.cat(grids), CELL_M)

    def holds(
        self, points: Float32[Tensor, "*batch 3"], bodies: Int64[Tensor, "*batch"]
    ) -> Bool[Tensor, "*batch"]:
        """Whether points of the bodies' frames lie in occupied cells."""
        place = ((points - self.low[bodies]) / self.cell_m).floor().long()
        shape = self.shape[bodies]
        inside = ((place >= 0) & (place < shape)).all(dim=-1)
        place = torch.minimum(place.clamp(min=0), shape - 1)
        flat = (place[..., 0] * shape[..., 1] + place[..., 1]) * shape[..., 2] + place[..., 2]
        return inside & self.occupied[self.first[bodies] + flat]


def random_points(
    candidates: Float[np.ndarray, "points 3"], count: int, jitter_m: float
) -> Float32[Tensor, "count 3"]:
    """Some of the points, each moved by Gaussian noise."""
    chosen = torch.from_numpy(candidates).float()[torch.randint(len(candidates), (count,))]
    return chosen + jitter_m * torch.randn(count, 3)
