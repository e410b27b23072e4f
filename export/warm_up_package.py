"""The smallest package: a browser that has drawn it has compiled what draws an avatar."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from avatar.rig import canonical_rotations
from export.build import build_coarse_graph, describe_tiers, encode_png, serialize_graph
from export.package.manifest import Manifest
from export.package.package_file import AvatarPackage, write_package
from export.package.player_tables import (
    BRICK_NODES,
    QUALITY_TIERS,
    WEIGHT_SCALE,
    BrickTable,
    PlayerTables,
    SkinningGrid,
    SurfelTable,
)
from preprocess.body.kinematics import PARENTS


def write_warm_up_package(path: Path) -> None:
    """Write a package of two surfels, as high as a person, and an empty brick."""
    origin = np.zeros(3, np.float32)
    tables = PlayerTables(
        surfels=SurfelTable(
            low=origin - 1.0, extent_m=2.0, spacing_m=0.01,
            position_codes=np.array([[1 << 15, 0, 1 << 15], [1 << 15, 65535, 1 << 15]], np.uint16),
            normal_codes=np.array([[0, 0, 127]] * 2, np.int8),
            thickness_codes=np.full(2, 40, np.uint8),
        ),
        bricks=BrickTable(
            low=origin, voxel_m=0.01, index=np.ones((1, 1, 1), np.int32),
            voxels=np.zeros((2, *[BRICK_NODES] * 3, 4), np.uint8),
        ),
        skinning=SkinningGrid(
            low=origin - 2.0, step_m=origin + 4.0,
            index=np.arange(1, 9, dtype=np.int32).reshape(2, 2, 2),
            weight_codes=np.eye(24, 1, dtype=np.uint16).repeat(9, axis=1) * WEIGHT_SCALE,
        ),
        pelvis=origin, reach_m=2.0,
    )  # fmt: skip
    manifest = Manifest(
        rest_joints=np.zeros((24, 3)), parents=np.array(PARENTS),
        canonical_rotations=canonical_rotations(), tiers=describe_tiers(tables, QUALITY_TIERS),
        golden=(), metrics={}, sha256={},
    )  # fmt: skip
    package = AvatarPackage(
        manifest=manifest, graphs={}, tables=dict.fromkeys(QUALITY_TIERS, tables), golden=(),
        preview=encode_png(np.zeros((1, 1, 4), np.uint8)),
    )  # fmt: skip
    graphs = {tier: serialize_graph(package, tier) for tier in QUALITY_TIERS}
    write_package(replace(package, graphs=graphs | build_coarse_graph(package)), path)
