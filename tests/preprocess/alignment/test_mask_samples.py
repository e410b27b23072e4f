"""Masks that are sampled: of frames that show the person, whatever the file claims."""

from pathlib import Path

import numpy as np

from capture.camera import Camera
from capture.source import FrameSelection, FrameSource
from preprocess.alignment.silhouette_objective import sample_masks
from preprocess.body.body_surface import SkinPoints
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_sources import MaskSource
from preprocess.tracking.keypoints import KeypointTrack


class MasksOfFive(MaskSource):
    """Masks of a file that breaks off after five frames."""

    def read(self, index, size_px):
        return np.full(size_px[::-1], float(index < 5), np.float32)


def test_sampled_masks_are_of_frames_with_key_points(shaped):
    source = FrameSource(Path("film.mp4"), FrameSelection())
    source.size_px, source.frame_count = (40, 60), 600  # as its header claims
    camera = Camera(
        focal_px=(60.0, 60.0), center_px=(20.0, 30.0), size_px=(40, 60),
        camera_from_world=np.eye(4),
    )  # fmt: skip
    track = KeypointTrack(
        frames=np.arange(5), image_px=np.zeros((5, 33, 2)), world_m=np.zeros((5, 33, 3)),
        visibility=np.ones((5, 33)), presence=np.ones(5), size_px=(40, 60),
    )  # fmt: skip
    sampled = sample_masks(
        source, MasksOfFive(), CameraTrack(cameras=(camera,), source=""), SkinPoints.of(shaped),
        count=60, track=track,
    )  # fmt: skip
    assert [each.index for each in sampled.samples] == [0, 1, 2, 3, 4]
