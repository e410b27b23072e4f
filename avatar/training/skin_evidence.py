"""Evidence of the skin in the frames: how squarely each patch was seen, and from how many sides.

A patch is a seed of the rig, about 2 cm wide. Evidence only grows, costs a millisecond a frame, and
needs no image but the frame's mask.
"""

from dataclasses import replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32

from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame
from preprocess.body.body_surface import visible_points

MIN_PERSON_ALPHA = 127
"""Alpha of 255 above which a pixel shows the person."""
UNSEEN_COSINE, SEEN_COSINE = 0.1, 0.4
"""Cosines between normal and view direction up to which a patch counts as not seen (84°), and from
which it counts as seen (66°)."""
BORDER_PX = 0.5, 3.0
"""Distances from the person's outline up to which a pixel shows the background's color, and from
which the skin's alone: a video has one color for each 2 x 2 pixels, and smears it."""
LIMB_MARGIN_CELLS = 1
"""Cells of 3 cm around a limb in which clothes and errors of the pose may hide what is behind."""
SEEN_FRAME_SHARE = 0.03
"""Share of the frames that must show a patch squarely for it to count as seen in full: in a few
frames a tracker may turn the person round."""
DEPTH_UNKNOWN_SPREAD, DEPTH_KNOWN_SPREAD = 0.3, 0.8
"""Standard deviations of the directions from which a patch was seen, up to which its depth counts
as unknown, and from which as known, radians: about those of a sixth of a turn, and of a whole."""


@final
class SkinEvidence:
    """How each patch of a rig's skin was seen; less near the person's outline (`BORDER_PX`).

    Attributes:
        cosines: Largest cosine at which it was seen, in [0, 1]; 0 if it never was.
        seen_frames: Number of frames that showed it squarely; an oblique view counts less.
        frame_count: Number of all frames.
    """

    cosines: Float32[np.ndarray, "seeds"]
    seen_frames: Float32[np.ndarray, "seeds"]
    frame_count: int

    def __init__(self, rig: Rig) -> None:
        """Starts with every patch unseen."""
        self._rig = rig
        self._weights = rig.weights_at(rig.seeds)
        self.cosines = np.zeros(len(rig.seeds), dtype=np.float32)
        self._direction_sums, self._frames = np.zeros((len(rig.seeds), 3)), np.zeros(len(rig.seeds))
        self.seen_frames, self.frame_count = np.zeros(len(rig.seeds), dtype=np.float32), 0

    def add(self, frame: TrainingFrame) -> None:
        """Takes in what a frame shows: patches that face the camera, unoccluded, in the mask."""
        blends = self._rig.body_from_canonical(frame.pose.joint_rotations)[:, :3].reshape(24, 12)
        blends = (self._weights @ blends.astype(np.float32)).reshape(-1, 3, 4)
        points = np.einsum("pab,pb->pa", blends[..., :3], self._rig.seeds) + blends[..., 3]
        normals = np.einsum("pab,pb->pa", blends[..., :3], self._rig.seed_normals)
        to_camera = frame.origin - points
        cosines = np.einsum("pa,pa->p", to_camera, normals) / np.maximum(
            np.linalg.norm(to_camera, axis=1) * np.linalg.norm(normals, axis=1), 1e-9
        )
        in_camera = -to_camera @ frame.body_from_camera
        depths = in_camera[:, 2]
        if depths.min() <= 0.0:  # a person behind the camera is not in the image either
            return
        plane = in_camera[:, :2] / depths[:, None] * depths.mean()
        shown = visible_points(plane, depths, cosines, margin_cells=LIMB_MARGIN_CELLS)
        within = _pixels_within_border(in_camera, frame)
        shown &= within > 0.0
        cosines = cosines * _smooth_step(within, *BORDER_PX)
        cosines = np.where(shown, cosines, 0.0)
        np.maximum(self.cosines, cosines, out=self.cosines)
        self.seen_frames += _smooth_step(cosines, UNSEEN_COSINE, SEEN_COSINE)
        self.frame_count += 1
        canonical = np.einsum("pab,pa->pb", blends[..., :3], to_camera)
        canonical /= np.maximum(np.linalg.norm(canonical, axis=1, keepdims=True), 1e-9)
        self._direction_sums += shown[:, None] * canonical
        self._frames += shown

    @property
    def seen(self) -> Float32[np.ndarray, "seeds"]:
        """Degree to which each patch was seen, in [0, 1]: smooth steps of its cosine and share."""
        shares = self.seen_frames / max(self.frame_count, 1)
        squarely = _smooth_step(self.cosines, UNSEEN_COSINE, SEEN_COSINE)
        return squarely * _smooth_step(shares, 0.0, SEEN_FRAME_SHARE)

    @property
    def depth_known(self) -> Float32[np.ndarray, "seeds"]:
        """Degree to which each patch was seen from several sides, in [0, 1].

        From one side alone, a surface at any depth shows the same pictures.
        """
        length = np.linalg.norm(self._direction_sums, axis=1) / np.maximum(self._frames, 1.0)
        spread = np.sqrt(np.clip(2.0 - 2.0 * length, 0.0, 2.0)) * (self._frames > 0.0)
        return _smooth_step(spread, DEPTH_UNKNOWN_SPREAD, DEPTH_KNOWN_SPREAD)


def _smooth_step(
    values: Float[np.ndarray, "seeds"] | Float32[np.ndarray, "seeds"], low: float, high: float
) -> Float32[np.ndarray, "seeds"]:
    """0 up to `low`, 1 from `high` on, without a corner."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    return (share * share * (3.0 - 2.0 * share)).astype(np.float32)


def _pixels_within_border(
    in_camera: Float[np.ndarray, "points 3"], frame: TrainingFrame
) -> Float32[np.ndarray, "points"]:
    """Distance of points in camera axes to the person's outline, pixels; 0 beside the person."""
    camera = replace(frame.view.camera, camera_from_world=np.eye(4))
    width, height = camera.size_px
    column, row = np.floor(camera.project(in_camera)).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    near = frame.view.near_person()
    alpha = np.zeros((height, width), dtype=np.uint8)
    alpha[near] = frame.colors[:, 3] > MIN_PERSON_ALPHA
    distances = cv2.distanceTransform(alpha, cv2.DIST_L2, 3)
    return np.where(inside, distances.reshape(-1)[(row * width + column) * inside], 0.0)
