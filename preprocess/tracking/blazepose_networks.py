"""BlazePose's networks: one finds the persons in a frame, one a person's key points and mask.

Both (Bazarevsky et al. 2020, arXiv:2006.10204) describe where a person is by a circle that has its
middle between the hips and encloses the whole body. Key points are found in a square around that
circle, a quarter wider, turned so that the person stands upright in it. The detector is a
single-shot one (Liu et al. 2016): for each of 2,254 anchors, evenly spread over the image, it gives
the probability of a person, and that person's middle and size.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
from jaxtyping import Float, Float32, UInt8

from capture.source import RgbImage
from preprocess.tracking.keypoints import KEYPOINT_COUNT, CroppedMask, PersonKeypoints

WEIGHTS = Path(__file__).parent / "weights"
"""Folder of this project's own networks."""
SAME_PERSON_DISTANCE = 0.12
"""Two detections whose middles are nearer than this share of their squares' side are one person."""


class OnnxNetwork:
    """A network that takes one square image, `picture_size` pixels wide and high."""

    def __init__(self, path: Path) -> None:
        """Loads the network; it computes on one thread, which costs least per image."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        (image,) = self._session.get_inputs()
        self._image = image.name
        self._outputs = [output.name for output in self._session.get_outputs()]
        self.picture_size = int(image.shape[1])

    def run(
        self, picture: UInt8[np.ndarray, "size size 3"], low: float, high: float
    ) -> dict[str, Float32[np.ndarray, "..."]]:
        """Run the network on an image scaled to [`low`, `high`]; its outputs by their names."""
        values = picture.astype(np.float32)
        values *= (high - low) / 255
        if low:
            values += low
        outputs = self._session.run(None, {self._image: values[None]})
        return {
            name: np.asarray(output)[0] for name, output in zip(self._outputs, outputs, strict=True)
        }


def sigmoid(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The logistic function."""
    return 1 / (1 + np.exp(-np.clip(values, -50, 50)))


@dataclass(frozen=True, kw_only=True)
class PersonSquare:
    """A turned square in a frame: its middle (`x`, `y`) and `side` in pixels, and its `angle`.

    The first pixel's middle is at (0.5, 0.5). The angle is the turn from upright, radians,
    clockwise as seen in the image.
    """

    x: float
    y: float
    side: float
    angle: float = 0.0

    @classmethod
    def around(
        cls, hips: Float[np.ndarray, "2"], above_head: Float[np.ndarray, "2"]
    ) -> "PersonSquare":
        """The square of a person, by the middle of the hips and the point above the head."""
        x, y = (above_head - hips).tolist()
        return cls(
            x=float(hips[0]),
            y=float(hips[1]),
            side=float(2.5 * np.hypot(x, y)),  # a quarter wider than the circle
            angle=float(np.arctan2(x, -y)),
        )

    @classmethod
    def of_frame(cls, rgb: RgbImage) -> "PersonSquare":
        """The upright square around a whole frame."""
        height, width = rgb.shape[:2]
        return cls(x=width / 2, y=height / 2, side=float(max(width, height)))

    def image_from_crop(self, size: int) -> Float[np.ndarray, "2 3"]:
        """The affine map from pixels of a crop of `size` x `size` pixels to pixels of the frame."""
        turn = self.rotation() * (self.side / size)
        middle = np.array([self.x, self.y])
        return np.column_stack([turn, middle - turn @ np.full(2, size / 2)])

    def rotation(self) -> Float[np.ndarray, "2 2"]:
        """From directions in the square to directions in the frame."""
        cosine, sine = np.cos(self.angle), np.sin(self.angle)
        return np.array([[cosine, -sine], [sine, cosine]])

    def crop(self, rgb: RgbImage, size: int) -> UInt8[np.ndarray, "size size 3"]:
        """Cut the square out of a frame, `size` x `size` pixels; black outside the frame."""
        there = self.image_from_crop(size)
        corners = there @ np.array([[0, size, 0, size], [0, 0, size, size], [1, 1, 1, 1]])
        # Large squares are halved, thirded, … first: a pixel of the crop shall see all it covers.
        block = max(1, int(self.side / size))
        height, width = rgb.shape[:2]
        low = np.clip(corners.min(axis=1) - 2, 0, None).astype(int) // block * block
        high = np.minimum((width, height), np.ceil(corners.max(axis=1) + 2).astype(int))
        blocks = (high - low) // block
        if (blocks <= 0).any():
            return np.zeros((size, size, 3), np.uint8)
        end = low + blocks * block
        part = rgb[low[1] : end[1], low[0] : end[0]]
        if block > 1:
            part = cv2.resize(part, tuple(blocks.tolist()), interpolation=cv2.INTER_AREA)
        there[:, 2] -= low
        there /= block
        there[:, 2] += 0.5 * there[:, :2].sum(axis=1) - 0.5  # to OpenCV's pixels, middles at 0
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(part, there, (size, size), flags=flags)


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonDetection:
    """A person that the detector found: its square, and the probability (`score`) that it is one.

    `box` is the left, upper, right and lower border of head and shoulders, pixels.
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

    def __call__(self, rgb: RgbImage, area: PersonSquare | None = None) -> list[PersonDetection]:
        """Find the persons in an upright area (None: the whole frame), the most certain first."""
        area = area or PersonSquare.of_frame(rgb)
        size = self._network.picture_size
        output = self._network.run(area.crop(rgb, size), -1.0, 1.0)
        scores = sigmoid(output["scores"][:, 0])
        candidates = np.flatnonzero(scores >= 0.5)
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

    def find_all(self, rgb: RgbImage, *, in_parts: bool = False) -> list[PersonDetection]:
        """Find the persons in a frame, small ones as well.

        With `in_parts`, each part of the frame is searched even if a person was found: of two the
        network often sees only one.
        """
        whole = PersonSquare.of_frame(rgb)
        found = self(rgb, whole)
        if in_parts or not found:
            whole = replace(whole, side=float(min(rgb.shape[:2])))
            for part in parts_of_frame(rgb):
                for detection in self(rgb, part):
                    if not any(is_same_person(detection, other) for other in found):
                        found.append(detection)
        # the network was made for persons who fill the image
        return [
            self._look_closer(rgb, each) if each.square.side < 0.6 * whole.side else each
            for each in found
        ]

    def _look_closer(self, rgb: RgbImage, detection: PersonDetection) -> PersonDetection:
        """The same person, found in a smaller area."""
        square = detection.square
        closer = self(rgb, replace(square, angle=0.0))
        return min(
            closer,
            key=lambda each: np.hypot(each.square.x - square.x, each.square.y - square.y),
            default=detection,
        )


def parts_of_frame(rgb: RgbImage) -> list[PersonSquare]:
    """Three squares that cover a frame, as high or as wide as it is."""
    height, width = rgb.shape[:2]
    side = float(min(width, height))
    places = np.linspace(side / 2, max(width, height) - side / 2, 3)
    if width > height:
        return [PersonSquare(x=float(place), y=side / 2, side=side) for place in places]
    return [PersonSquare(x=side / 2, y=float(place), side=side) for place in places]


def anchors(picture_size: int) -> Float[np.ndarray, "anchors 2"]:
    """Places of the anchors, as shares of the image's width and height."""
    grids = []
    for distance, count in ((8, 2), (16, 2), (32, 6)):  # distance in px, and how many at each place
        cells = picture_size // distance
        rows, columns = np.mgrid[:cells, :cells] + 0.5
        grids.append(np.repeat(np.column_stack([columns.ravel(), rows.ravel()]) / cells, count, 0))
    return np.concatenate(grids)


def is_same_person(a: PersonDetection, b: PersonDetection) -> bool:
    """Check whether two detections are of one person: they are near, or their boxes overlap."""
    apart = np.hypot(a.square.x - b.square.x, a.square.y - b.square.y)
    if apart < SAME_PERSON_DISTANCE * min(a.square.side, b.square.side):
        return True
    return overlap(a.box, b.box) > 0.3


def overlap(a: Float[np.ndarray, "4"], b: Float[np.ndarray, "4"]) -> float:
    """Intersection over union of two boxes."""
    width, height = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    shared = max(0.0, float(width)) * max(0.0, float(height))
    total = sum(float(np.prod(box[2:] - box[:2])) for box in (a, b)) - shared
    return shared / total if total > 0 else 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class FoundLandmarks:
    """The person found in a square, and the square that its key points give for the next frame."""

    keypoints: PersonKeypoints
    square: PersonSquare


class BlazePoseLandmarks:
    """Finds one person's key points and mask in a square around that person."""

    def __init__(self) -> None:
        """Loads the network."""
        self._network = OnnxNetwork(WEIGHTS / "blazepose_landmarks_full.onnx")

    def __call__(self, rgb: RgbImage, square: PersonSquare) -> FoundLandmarks:
        """Find the person in a square of a frame."""
        size = self._network.picture_size
        output = self._network.run(square.crop(rgb, size), 0.0, 1.0)
        # Of each point x, y, depth, and logits of being visible and of being in the image. After
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
    """Move points, pixels of the crop, to the centroid of their heat maps (logits) nearby."""
    cells = heatmaps.shape[1]
    cell_px = size / cells
    reach = np.arange(-3, 4)
    middle = np.floor(crop_px / cell_px).astype(int)
    columns, rows = (middle[:, axis, None] + reach for axis in (0, 1))
    points = np.arange(len(middle))[:, None, None]
    near = np.clip(rows, 0, cells - 1)[:, :, None], np.clip(columns, 0, cells - 1)[:, None]
    heat = sigmoid(heatmaps[points, *near].astype(np.float64))
    for axis, places in ((1, columns), (2, rows)):
        heat *= np.expand_dims((places >= 0) & (places < cells), axis)
    use = ((middle >= 0) & (middle < cells)).all(axis=1) & (heat.max(axis=(1, 2)) >= 0.5)
    total = heat.sum(axis=(1, 2))
    refined = crop_px.copy()
    for axis, places in ((0, columns), (1, rows)):
        centroid = (heat.sum(axis=axis + 1) * places).sum(axis=1)
        refined[use, axis] = centroid[use] / total[use] * cell_px
    return refined
