"""Finds the key points of one person by BlazePose's landmark network."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

from preprocess.blazepose.onnx_network import WEIGHTS, OnnxNetwork, sigmoid
from preprocess.blazepose.person_square import PersonSquare
from preprocess.tracking.keypoints import KEYPOINT_COUNT, CroppedMask, PersonKeypoints

HEATMAP_REACH = 3
"""Cells of a heat map on each side of a key point that make it more exact."""
MIN_HEAT = 0.5
"""Least peak of a heat map that is used."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundLandmarks:
    """What the landmark network finds in one square.

    Attributes:
        keypoints: The person.
        square: Where the person is, as the key points say: the square for the next frame.
    """

    keypoints: PersonKeypoints
    square: PersonSquare


class BlazePoseLandmarks:
    """Finds one person's key points and mask in a square around that person."""

    def __init__(self) -> None:
        """Loads the network."""
        self._network = OnnxNetwork(WEIGHTS / "blazepose_landmarks_full.onnx")

    def __call__(
        self, rgb: UInt8[np.ndarray, "height width 3"], square: PersonSquare
    ) -> FoundLandmarks:
        """Find the person in a square of a frame."""
        size = self._network.picture_size
        output = self._network.run(square.crop(rgb, size), 0.0, 1.0)
        # Of each point x, y, depth, and logits of being visible and of being in the picture. After
        # the 33 key points come the two that give the next square.
        points = output["landmarks"].reshape(-1, 5).astype(np.float64)
        crop_px = refine(points[:, :2], output["heatmaps"], size)
        image_from_crop = square.image_from_crop(size)
        image_px = crop_px @ image_from_crop[:, :2].T + image_from_crop[:, 2]
        world_m = output["world"].reshape(-1, 3)[:KEYPOINT_COUNT].astype(np.float64)
        world_m[:, :2] = world_m[:, :2] @ square.rotation().T
        mask = np.rint(255 * sigmoid(output["mask"][0])).astype(np.uint8)
        keypoints = PersonKeypoints(
            image_px=image_px[:KEYPOINT_COUNT],
            world_m=world_m,
            visibility=sigmoid(points[:KEYPOINT_COUNT, 3]),
            presence=float(output["presence"][0]),
            mask=CroppedMask(values=mask, image_from_crop=image_from_crop),
        )
        hips, above_head = image_px[KEYPOINT_COUNT : KEYPOINT_COUNT + 2]
        return FoundLandmarks(keypoints=keypoints, square=PersonSquare.around(hips, above_head))


def refine(
    crop_px: Float[np.ndarray, "points 2"],
    heatmaps: Float32[np.ndarray, "points rows columns"],
    size: int,
) -> Float[np.ndarray, "points 2"]:
    """Move points to the centroid of their heat maps nearby.

    Args:
        crop_px: Points in the crop, pixels.
        heatmaps: Logits of where each point is.
        size: Width and height of the crop, pixels.
    """
    cells = heatmaps.shape[1]
    cell_px = size / cells
    refined = crop_px.copy()
    middle = np.floor(crop_px / cell_px).astype(int)
    for index, (column, row) in enumerate(middle.tolist()):
        if not (0 <= column < cells and 0 <= row < cells):
            continue
        left, top = max(0, column - HEATMAP_REACH), max(0, row - HEATMAP_REACH)
        heat = sigmoid(
            heatmaps[
                index, top : row + HEATMAP_REACH + 1, left : column + HEATMAP_REACH + 1
            ].astype(np.float64)
        )
        if heat.max() < MIN_HEAT:
            continue
        columns = left + np.arange(heat.shape[1])
        rows = top + np.arange(heat.shape[0])
        centroid = np.array([heat.sum(axis=0) @ columns, heat.sum(axis=1) @ rows])
        refined[index] = centroid / heat.sum() * cell_px
    return refined
