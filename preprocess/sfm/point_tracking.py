"""Points tracked from image to image: they place the frames between key frames.

The tracker is that of Lucas & Kanade 1981, in pyramids (Bouguet 2000). Points that a key frame sees
are followed into its neighbors, always from the key frame's own image, so that errors do not add
up. Each frame is placed by RANSAC on three points (Ke & Roumeliotis 2017, AP3P) and refined by
least squares. Where the next key frame is reached, its own camera is known: that tests the solution
by something else than the matches it was made from.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from capture.camera import Camera, Transform
from capture.source import FrameSource
from preprocess.body.kinematics import rigid_transform
from preprocess.sfm.camera_solution import SparseModel
from preprocess.sfm.colmap_mapping import SfmKeyframe, to_grayscale

SpacePoints = Float[np.ndarray, "points 3"]
"""Points of the solved world, or directions."""

ImagePoints = Float[np.ndarray, "points 2"]
"""Points of an image, pixels."""

GrayImage = UInt8[np.ndarray, "height width"]


def track_points(
    start: GrayImage, picture: GrayImage, pixels: ImagePoints, guess: ImagePoints | None = None
) -> tuple[ImagePoints, Bool[np.ndarray, "points"]]:
    """Places of an image's points in another one, and which were tracked there and back.

    The first pixel's centre is at (0.5, 0.5). `guess` holds likely places, by default the old ones.
    """
    if not len(pixels):
        return pixels.copy(), np.zeros(0, dtype=bool)
    levels = 4 if guess is None else 3  # of the pyramid
    there, found = _optical_flow(start, picture, pixels, pixels if guess is None else guess, levels)
    back, again = _optical_flow(picture, start, there, pixels, levels)
    height, width = picture.shape
    inside = ((there > 0.0) & (there < (width, height))).all(axis=1)
    same = np.linalg.norm(back - pixels, axis=1) < 0.7  # px, there and back
    return there, found & again & same & inside


def detect_corners(
    picture: GrayImage, free: Bool[np.ndarray, "height width"], most: int
) -> np.ndarray:
    """Points that can be followed, evenly spread (Shi & Tomasi 1994)."""
    spacing = max(4.0, 0.01 * max(picture.shape))
    found = cv2.goodFeaturesToTrack(picture, most, 0.01, spacing, mask=free.astype(np.uint8))
    if found is None:
        return np.zeros((0, 2))
    return found.reshape(-1, 2).astype(np.float64) + 0.5


def _optical_flow(
    start: GrayImage, picture: GrayImage, pixels: ImagePoints, guess: ImagePoints, levels: int
) -> tuple[ImagePoints, Bool[np.ndarray, "points"]]:
    """OpenCV's, whose first pixel's centre is at (0, 0)."""
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        start, picture, (pixels - 0.5).astype(np.float32)[:, None],
        (guess - 0.5).astype(np.float32)[:, None].copy(), winSize=(17, 17), maxLevel=levels,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there[:, 0].astype(np.float64) + 0.5, status[:, 0] > 0


MIN_PNP_POINTS = 20
"""Fewest tracked points that a camera is placed by."""
INLIER_PX = 2.0
"""Largest reprojection error of an inlier, pixels."""
MIN_INLIER_FRACTION = 0.5
"""Fraction of the tracked points that must be inliers."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ResectionResult:
    """Camera-from-world of frames placed by tracked points, and errors, by the frames' numbers.

    Errors are the median distances of points that were tracked into a key frame from their
    projection by its own camera, pixels.
    """

    cameras: dict[int, Transform]
    keyframe_errors_px: dict[int, float]


def resect_intermediate_frames(
    source: FrameSource,
    model: SparseModel,
    keys: list[SfmKeyframe],
    report_progress: Callable[[float], None],
) -> ResectionResult:
    """Place all frames that have no camera.

    `model` is for images of the key frames' size; those of `keys` without a camera in it are placed
    like any other frame. Progress is the fraction of the video that is done.
    """
    own = {key.index: key for key in keys}
    anchors = [
        _KeyframePoints.of(model, row, own[int(frame)])
        for row, frame in enumerate(model.frames.tolist())
    ]
    placed: dict[int, np.ndarray] = {}
    bridges: dict[int, float] = {}
    resect = resect_turn if model.only_turns else resect_camera
    total = max(source.frame_count or source.frames_in_file, 1)
    for before, after, stretch in _frames_between_keyframes(source, anchors, model.size_px):
        if stretch:
            report_progress(min(source.selection.position(stretch[-1][0]) / total, 1.0))
        seen = _PointTracks()
        if before is not None:
            ends = stretch if after is None else [*stretch, (after.frame, after.grey)]
            before.follow(ends, seen)
        if before is not None and after is not None:
            bridges[after.frame] = seen.median_error_px(after.frame, after.camera)
        if after is not None:
            after.follow(stretch[::-1], seen)
        for frame, _ in stretch:
            lens = (before or after).camera  # type: ignore[union-attr]
            found = resect(*seen.of(frame), lens)
            if found is not None:
                placed[frame] = found
    return ResectionResult(cameras=placed, keyframe_errors_px=bridges)


def resect_camera(points: SpacePoints, pixels: ImagePoints, lens: Camera) -> Transform | None:
    """The camera that sees known points where they were seen; None if most contradict it.

    Some pixels may be wrong; of `lens` only the intrinsics and the distortion count.
    """
    if len(points) < MIN_PNP_POINTS:
        return None
    distortion = np.array(lens.distortion or (0.0, 0.0, 0.0, 0.0))
    cv2.setRNGSeed(0)
    ok, turn, shift, kept = cv2.solvePnPRansac(
        points, pixels, lens.intrinsic, distortion, iterationsCount=200,
        reprojectionError=INLIER_PX, confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    inliers = np.zeros(0, np.int64) if kept is None else np.asarray(kept)[:, 0].astype(np.int64)
    if not ok or len(inliers) < max(MIN_PNP_POINTS, MIN_INLIER_FRACTION * len(points)):
        return None
    for reach in (INLIER_PX, 0.5 * INLIER_PX, 0.0):  # the last round leaves out what is half right
        turn, shift = cv2.solvePnPRefineLM(
            points[inliers], pixels[inliers], lens.intrinsic, distortion, turn, shift
        )
        drawn = np.asarray(cv2.projectPoints(points, turn, shift, lens.intrinsic, distortion)[0])
        near = np.flatnonzero(np.linalg.norm(drawn[:, 0] - pixels, axis=1) < reach)
        inliers = near if len(near) >= MIN_PNP_POINTS else inliers
    return rigid_transform(np.asarray(cv2.Rodrigues(turn)[0]), np.asarray(shift)[:, 0])


def resect_turn(directions: SpacePoints, pixels: ImagePoints, lens: Camera) -> Transform | None:
    """The camera at the origin that sees known directions where they were seen; else None."""
    if len(directions) < MIN_PNP_POINTS:
        return None
    rays = replace(lens, camera_from_world=np.eye(4)).ray_directions(pixels)
    far = np.ones(len(rays))
    for _ in range(10):
        turn = Rotation.align_vectors(rays, directions, 1.0 / np.maximum(far, 1.0) ** 2)[0]
        far = np.linalg.norm(rays - turn.apply(directions), axis=1) * lens.focal_px[0] / INLIER_PX
    if (far < 1.0).mean() < MIN_INLIER_FRACTION:
        return None
    return rigid_transform(turn.as_matrix(), np.zeros(3))


@dataclass(frozen=True, eq=False, kw_only=True)
class _KeyframePoints:
    """A key frame with its camera and the points it sees."""

    frame: int
    grey: GrayImage
    camera: Camera
    points: SpacePoints
    pixels: ImagePoints

    @classmethod
    def of(cls, model: SparseModel, row: int, key: SfmKeyframe) -> "_KeyframePoints":
        seen = model.observations_of_camera(row)
        lengths = np.bincount(model.observation_point, minlength=len(model.points))
        longest = np.argsort(-lengths[model.observation_point[seen]], kind="stable")[:600]
        seen = seen[longest]
        return cls(
            frame=key.index,
            grey=key.gray,
            camera=model.camera(model.camera_from_world[row]),
            points=model.points[model.observation_point[seen]],
            pixels=model.pixels[seen],
        )

    def follow(self, pictures: list[tuple[int, GrayImage]], seen: "_PointTracks") -> None:
        """Track the points through images that come one after the other."""
        guess, alive = self.pixels.copy(), np.ones(len(self.pixels), dtype=bool)
        for frame, grey in pictures:
            rows = np.flatnonzero(alive)
            there, found = track_points(self.grey, grey, self.pixels[rows], guess[rows])
            guess[rows[found]] = there[found]
            alive[rows[~found]] = False
            seen.add(frame, self.points[rows[found]], there[found])


class _PointTracks:
    """Places of points by the frame's number."""

    def __init__(self) -> None:
        self._seen: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}

    def add(self, frame: int, points: np.ndarray, pixels: np.ndarray) -> None:
        self._seen.setdefault(frame, []).append((points, pixels))

    def of(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        parts = self._seen.get(frame, [])
        if not parts:
            return np.zeros((0, 3)), np.zeros((0, 2))
        return np.concatenate([p for p, _ in parts]), np.concatenate([q for _, q in parts])

    def median_error_px(self, frame: int, camera: Camera) -> float:
        points, pixels = self.of(frame)
        if len(points) < MIN_PNP_POINTS:
            return float("nan")
        return float(np.median(np.linalg.norm(camera.project(points) - pixels, axis=1)))


def _frames_between_keyframes(
    source: FrameSource, anchors: list[_KeyframePoints], size_px: tuple[int, int]
) -> Iterator[tuple[_KeyframePoints | None, _KeyframePoints | None, list[tuple[int, GrayImage]]]]:
    """The frames between two neighboring key frames, and before the first and after the last."""
    waiting, stretch = list(anchors), []
    before: _KeyframePoints | None = None
    for frame in source.frames():
        while waiting and frame.index >= waiting[0].frame:
            after = waiting.pop(0)
            yield before, after, stretch
            before, stretch = after, []
        if (before is None or frame.index != before.frame) and "corrupt" not in frame.flags:
            stretch.append((frame.index, to_grayscale(frame, size_px)))
    yield before, None, stretch
    for after in waiting:  # the video ended before they came
        yield before, after, []
        before = after
