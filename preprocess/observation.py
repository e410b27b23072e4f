"""A frame in which the person has been found: picture, mask, pose and camera, all of one size."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.source import Frame
from preprocess.body.body_pose import BodyPose


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """What the trainer learns from.

    Attributes:
        frame: The picture.
        alpha: How far each pixel is person, in [0, 1], never thresholded.
        pose: The body's pose in the camera's world.
        camera: The camera, already of the picture's size.
    """

    frame: Frame
    alpha: Float32[np.ndarray, "height width"]
    pose: BodyPose
    camera: Camera

    def __post_init__(self) -> None:
        """Pictures, masks and cameras of different sizes are our own bug by now."""
        height, width = self.alpha.shape
        assert self.frame.size_px == (width, height) == self.camera.size_px
