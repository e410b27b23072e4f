"""How large the picture is in which a mask is found."""

from typing import final

import numpy as np

from capture.camera import Camera
from preprocess.body import ShapedBody
from preprocess.pose import BodyPose

WORKING_PERSON_PX = 220
"""Masks are found in pictures in which the person is about so large, or smaller."""

UPSAMPLE_BELOW_PX = 150
"""Pictures of smaller persons are enlarged twice: masks then know parts of a pixel."""

DOWNSAMPLE_ABOVE = 1.1
"""A person who is little larger is not worth a smaller picture."""

JOINT_HEIGHT_FRACTION = 0.87
"""Of a standing person's height, how much lies between head joint and toes."""

RESCALE_RATIO = 1.4
"""The scale is chosen anew when the person has become so many times larger or smaller."""


@final
class WorkingResolution:
    """The scale for one person; it seldom changes."""

    def __init__(self, shaped: ShapedBody) -> None:
        """Nobody was seen yet."""
        self._shaped = shaped
        self._tall_px: float | None = None

    def scale_for(self, pose: BodyPose, camera: Camera) -> float:
        """How many times larger than the frame the picture is in which its mask is found."""
        joints = self._shaped.with_pose(pose).joints()
        depth = joints @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        if depth.min() > 0.0:
            tall = float(np.ptp(camera.project(joints), axis=0).max()) / JOINT_HEIGHT_FRACTION
            before = self._tall_px
            if before is None or not 1.0 / RESCALE_RATIO < tall / before < RESCALE_RATIO:
                self._tall_px = tall
        tall = max(self._tall_px or 0.0, 1.0)
        if tall < UPSAMPLE_BELOW_PX:
            return 2.0
        return 1.0 if tall < DOWNSAMPLE_ABOVE * WORKING_PERSON_PX else WORKING_PERSON_PX / tall
