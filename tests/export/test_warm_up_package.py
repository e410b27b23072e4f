"""The package that a browser draws before there is an avatar."""

import numpy as np

from capture.camera import Camera
from export.package.package_file import COARSE_GRAPH, read_package
from export.package.player_tables import QUALITY_TIERS
from export.player import Player
from export.warm_up_package import write_warm_up_package
from preprocess.body.body_pose import BodyPose


def test_a_package_of_two_points_runs_every_graph_and_is_small(tmp_path):
    path = tmp_path / "avatar.iavatar"
    write_warm_up_package(path)
    assert path.stat().st_size < 200_000
    assert set(read_package(path, tier=None).graphs) == {*QUALITY_TIERS, COARSE_GRAPH}
    camera = Camera(
        focal_px=(64.0, 64.0), center_px=(32.0, 32.0), size_px=(64, 64),
        camera_from_world=np.array(
            [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]], float
        ),
    )  # fmt: skip
    for tier in QUALITY_TIERS:
        drawn = Player.load(path, tier=tier).render(BodyPose.rest(), camera)
        assert drawn.shape == (64, 64, 4)
        assert not drawn[..., 3].any()  # its brick is empty
