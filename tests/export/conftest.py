"""A person whose field is a formula: capsules about the bones, striped, soft at the rim."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from avatar.rig import Rig
from preprocess.body import Body
from preprocess.kinematics import body_from_rest

RADII = np.array(
    [12, 8, 8, 12, 6, 6, 13, 5, 5, 13, 5, 5, 7, 7, 7, 10, 6, 6, 5, 5, 4, 4, 4, 4], dtype=np.float32
)


@dataclass(frozen=True, eq=False)
class StandIn:
    rig: Rig
    field_at: Callable
    occupied: np.ndarray


def capsule_field(rig: Rig):
    """Density of a soft union of capsules, thinner than the body, with 8-cm stripes."""
    canonical = body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
    joints = np.einsum("jab,jb->ja", canonical[:, :3, :3], rig.rest_joints) + canonical[:, :3, 3]
    ends = torch.tensor(joints[1:], dtype=torch.float32)
    starts = torch.tensor(joints[rig.parents[1:]], dtype=torch.float32)
    radii = torch.tensor(RADII[1:] * 0.0085)
    bones = ends - starts

    def field_at(points):
        distances = []
        for start, bone, radius in zip(starts, bones, radii, strict=True):
            from_start = points - start
            share = ((from_start @ bone) / (bone @ bone)).clamp(0, 1)
            distances.append((from_start - share[:, None] * bone).norm(dim=1) - radius)
        distance = -torch.logsumexp(-70.0 * torch.stack(distances), dim=0) / 70.0
        density = 500.0 * torch.sigmoid(-distance / 0.003)
        stripe = torch.sigmoid(6.0 * torch.sin(2 * np.pi / 0.08 * points[:, 1]))
        side = torch.sigmoid(points[:, 0] / 0.02)
        rgb = torch.stack([0.15 + 0.7 * stripe, 0.2 + 0.5 * side, 0.8 - 0.6 * stripe], dim=1)
        return rgb, torch.where(density > 0.05, density, 0.0)

    return field_at


@pytest.fixture(scope="session")
def stand_in() -> StandIn:
    rig = Rig.of(Body.load().with_shape())
    field_at = capsule_field(rig)
    size = (rig.box_high - rig.box_low) / rig.distance.shape
    centers = np.stack(
        np.meshgrid(*[np.arange(n) + 0.5 for n in rig.distance.shape], indexing="ij"), -1
    )
    centers = (centers * size + rig.box_low).reshape(-1, 3).astype(np.float32)
    occupied = np.zeros(rig.distance.shape, bool)
    for shift in np.ndindex(3, 3, 3):
        points = torch.from_numpy(centers + ((np.array(shift) - 1) * size / 2).astype(np.float32))
        occupied |= (field_at(points)[1].numpy() > 0.05).reshape(occupied.shape)
    return StandIn(rig, field_at, occupied.astype(np.uint8))
