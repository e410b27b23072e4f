"""Finds the persons in a frame by BlazePose's detector, a single-shot one (Liu et al. 2016).

For each of 2,254 anchors, evenly spread over the picture, the network says how sure it is of a
person there, and where that person's middle and size are.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from preprocess.blazepose.onnx_network import WEIGHTS, OnnxNetwork, sigmoid
from preprocess.blazepose.person_square import PersonSquare

ANCHOR_GRIDS = ((8, 2), (16, 2), (32, 6))
"""Distance of the anchors, pixels, and how many there are at each place."""
MIN_SCORE = 0.5
"""Least probability of a person."""
MAX_OVERLAP = 0.3
"""Largest intersection over union of two persons' boxes."""
SAME_PERSON_DISTANCE = 0.12
"""Two detections whose middles are nearer than this share of their squares' side are one person."""
SMALL_PERSON = 0.6
"""A person whose square is smaller than this share of the searched one is searched again, larger:
the network was made for persons who fill the picture."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonDetection:
    """One person that the detector found.

    Attributes:
        square: Where the whole person is.
        box: Left, upper, right and lower border of the head and shoulders, pixels.
        score: Probability that it is a person.
    """

    square: PersonSquare
    box: Float[np.ndarray, "4"]
    score: float


class BlazePoseDetector:
    """Finds persons in a frame."""

    def __init__(self) -> None:
        """Loads the network."""
        self._network = OnnxNetwork(WEIGHTS / "blazepose_detector.onnx")
        self._anchors = anchors(self._network.picture_size)

    def __call__(
        self, rgb: UInt8[np.ndarray, "height width 3"], area: PersonSquare | None = None
    ) -> list[PersonDetection]:
        """Find the persons, the most certain first.

        Args:
            rgb: The frame.
            area: Upright square in which to look; the whole frame if it is not given.
        """
        area = area or PersonSquare.of_frame(rgb)
        size = self._network.picture_size
        output = self._network.run(area.crop(rgb, size), -1.0, 1.0)
        scores = sigmoid(output["scores"][:, 0])
        candidates = np.flatnonzero(scores >= MIN_SCORE)
        candidates = candidates[np.argsort(-scores[candidates], kind="stable")]
        image_from_crop = area.image_from_crop(size)
        found: list[PersonDetection] = []
        for index in candidates:
            middle, extent, hips, above_head, *_ = (
                output["boxes"][index].reshape(-1, 2).astype(np.float64)
            )
            anchor = self._anchors[index] * size
            corners = [anchor + middle - extent / 2, anchor + middle + extent / 2]
            points = np.array([*corners, anchor + hips, anchor + above_head])
            points = points @ image_from_crop[:, :2].T + image_from_crop[:, 2]
            detection = PersonDetection(
                square=PersonSquare.around(points[2], points[3]),
                box=points[:2].reshape(-1),
                score=float(scores[index]),
            )
            if not any(is_same_person(detection, other) for other in found):
                found.append(detection)
        return found

    def find_all(
        self, rgb: UInt8[np.ndarray, "height width 3"], *, in_parts: bool = False
    ) -> list[PersonDetection]:
        """Find the persons in a frame, small ones as well.

        Args:
            rgb: The frame.
            in_parts: Whether to look into each part of the frame even if a person was found: of
                two the network often sees only one.
        """
        whole = PersonSquare.of_frame(rgb)
        found = self(rgb, whole)
        if in_parts or not found:
            whole = replace(whole, side=float(min(rgb.shape[:2])))
            for part in parts_of_frame(rgb):
                for detection in self(rgb, part):
                    if not any(is_same_person(detection, other) for other in found):
                        found.append(detection)
        return [
            self._look_closer(rgb, each) if each.square.side < SMALL_PERSON * whole.side else each
            for each in found
        ]

    def _look_closer(
        self, rgb: UInt8[np.ndarray, "height width 3"], detection: PersonDetection
    ) -> PersonDetection:
        """The same person, found in a smaller area."""
        square = detection.square
        closer = self(rgb, replace(square, angle=0.0))
        return min(
            closer,
            key=lambda each: np.hypot(each.square.x - square.x, each.square.y - square.y),
            default=detection,
        )


def parts_of_frame(rgb: UInt8[np.ndarray, "height width 3"]) -> list[PersonSquare]:
    """Three squares that cover a frame, as high or as wide as it is."""
    height, width = rgb.shape[:2]
    side = float(min(width, height))
    places = np.linspace(side / 2, max(width, height) - side / 2, 3)
    if width > height:
        return [PersonSquare(x=float(place), y=side / 2, side=side) for place in places]
    return [PersonSquare(x=side / 2, y=float(place), side=side) for place in places]


def anchors(picture_size: int) -> Float[np.ndarray, "anchors 2"]:
    """Places of the anchors, as shares of the picture's width and height."""
    grids = []
    for distance, count in ANCHOR_GRIDS:
        cells = picture_size // distance
        rows, columns = np.mgrid[:cells, :cells] + 0.5
        grids.append(np.repeat(np.column_stack([columns.ravel(), rows.ravel()]) / cells, count, 0))
    return np.concatenate(grids)


def is_same_person(a: PersonDetection, b: PersonDetection) -> bool:
    """Whether two detections are of one person."""
    apart = np.hypot(a.square.x - b.square.x, a.square.y - b.square.y)
    if apart < SAME_PERSON_DISTANCE * min(a.square.side, b.square.side):
        return True
    return overlap(a.box, b.box) > MAX_OVERLAP


def overlap(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"]) -> float:
    """Intersection over union of two boxes."""
    width, height = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    shared = max(0.0, float(width)) * max(0.0, float(height))
    total = sum(float(np.prod(box[2:] - box[:2])) for box in (a, b)) - shared
    return shared / total if total > 0 else 0.0
