"""Cameras of the frames between key frames: known points are followed, then the camera is placed.

Points that a key frame sees are followed into its neighbours, always from the key frame's own
picture, so that errors do not add up. Each frame is placed by RANSAC on three points (Ke &
Roumeliotis 2017, AP3P) and refined by least squares. Where the next key frame is reached, its own
camera is known: that tests the solution by something else than the matches it was made from.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from capture.camera import Camera
from capture.source import FrameSource
from preprocess.body.kinematics import rigid_transform
from preprocess.sfm.camera_solution import SparseModel
from preprocess.sfm.point_tracking import track_points
from preprocess.sfm.sfm_keyframes import SfmKeyframe, to_grayscale

MIN_PNP_POINTS = 20
"""Fewest tracked points that a camera is placed by."""

MAX_PNP_POINTS = 600
"""Most points that are tracked from a key frame."""

INLIER_PX = 2.0
"""Largest reprojection error of an inlier, pixels."""

MIN_INLIER_FRACTION = 0.5
"""Fraction of the tracked points that must be inliers."""

MAX_BUFFERED_FRAMES = 256
"""Most frames between two key frames that are kept in memory; the middle of more is skipped."""

Grey = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True, eq=False, kw_only=True)
class ResectionResult:
    """What following points has found.

    Attributes:
        cameras: Camera-from-world by the frame's number; key frames' own are not among them.
        keyframe_errors_px: Median distance of points that were tracked into a key frame from their
            projection by its own camera, pixels; by the key frame's number.
    """

    cameras: dict[int, Float[np.ndarray, "4 4"]]
    keyframe_errors_px: dict[int, float]


def resect_intermediate_frames(
    source: FrameSource, model: SparseModel, keys: list[SfmKeyframe], told: Callable[[float], None]
) -> ResectionResult:
    """Cameras for all frames that have none.

    Args:
        source: The frames.
        model: The key frames' cameras, for pictures of the key frames' size.
        keys: The key frames; those without a camera in the model are placed like any other frame.
        told: Called with how much of the video is done.
    """
    own = {key.index: key for key in keys}
    anchors = [
        _KeyframePoints.of(model, row, own[int(frame)])
        for row, frame in enumerate(model.frames.tolist())
    ]
    placed: dict[int, np.ndarray] = {}
    bridges: dict[int, float] = {}
    total = max(source.frame_count or source.frames_in_file, 1)
    for before, after, stretch in _frames_between_keyframes(source, anchors, model.size_px):
        if stretch:
            told(min(source.selection.position(stretch[-1][0]) / total, 1.0))
        seen = _PointTracks()
        if before is not None:
            ends = stretch if after is None else [*stretch, (after.frame, after.grey)]
            before.follow(ends, seen)
        if before is not None and after is not None:
            bridges[after.frame] = seen.median_error_px(after.frame, after.camera)
        if after is not None:
            after.follow(stretch[::-1], seen)
        for frame, _ in stretch:
            found = resect_camera(*seen.of(frame), (before or after).camera)  # type: ignore[union-attr]
            if found is not None:
                placed[frame] = found
    return ResectionResult(cameras=placed, keyframe_errors_px=bridges)


def resect_camera(
    points: Float[np.ndarray, "points 3"], pixels: Float[np.ndarray, "points 2"], lens: Camera
) -> Float[np.ndarray, "4 4"] | None:
    """The camera that sees known points where they were seen; None if most contradict it.

    Args:
        points: In the world.
        pixels: Where each was seen; some may be wrong.
        lens: With the focal length, and where the camera may be.
    """
    if len(points) < MIN_PNP_POINTS:
        return None
    bend = np.array(lens.distortion or (0.0, 0.0, 0.0, 0.0))
    cv2.setRNGSeed(0)
    ok, turn, shift, kept = cv2.solvePnPRansac(
        points, pixels, lens.intrinsic, bend, iterationsCount=200, reprojectionError=INLIER_PX,
        confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    inliers = np.zeros(0, np.int64) if kept is None else np.asarray(kept)[:, 0].astype(np.int64)
    if not ok or len(inliers) < max(MIN_PNP_POINTS, MIN_INLIER_FRACTION * len(points)):
        return None
    for reach in (INLIER_PX, 0.5 * INLIER_PX, 0.0):  # the last round leaves out what is half right
        turn, shift = cv2.solvePnPRefineLM(
            points[inliers], pixels[inliers], lens.intrinsic, bend, turn, shift
        )
        drawn = np.asarray(cv2.projectPoints(points, turn, shift, lens.intrinsic, bend)[0])
        near = np.flatnonzero(np.linalg.norm(drawn[:, 0] - pixels, axis=1) < reach)
        inliers = near if len(near) >= MIN_PNP_POINTS else inliers
    return rigid_transform(np.asarray(cv2.Rodrigues(turn)[0]), np.asarray(shift)[:, 0])


@dataclass(frozen=True, eq=False, kw_only=True)
class _KeyframePoints:
    """A key frame with its camera and the points it sees."""

    frame: int
    grey: Grey
    camera: Camera
    points: Float[np.ndarray, "points 3"]
    pixels: Float[np.ndarray, "points 2"]

    @classmethod
    def of(cls, model: SparseModel, row: int, key: SfmKeyframe) -> "_KeyframePoints":
        seen = model.observations_of_camera(row)
        lengths = np.bincount(model.observation_point, minlength=len(model.points))
        longest = np.argsort(-lengths[model.observation_point[seen]], kind="stable")[
            :MAX_PNP_POINTS
        ]
        seen = seen[longest]
        return cls(
            frame=key.index,
            grey=key.gray,
            camera=model.camera(model.camera_from_world[row]),
            points=model.points[model.observation_point[seen]],
            pixels=model.pixels[seen],
        )

    def follow(self, pictures: list[tuple[int, Grey]], seen: "_PointTracks") -> None:
        """Follows the points through pictures that come one after the other."""
        guess, alive = self.pixels.copy(), np.ones(len(self.pixels), dtype=bool)
        for frame, grey in pictures:
            rows = np.flatnonzero(alive)
            there, found = track_points(self.grey, grey, self.pixels[rows], guess[rows])
            guess[rows[found]] = there[found]
            alive[rows[~found]] = False
            seen.add(frame, self.points[rows[found]], there[found])


class _PointTracks:
    """Which points were seen where, by the frame's number."""

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
) -> Iterator[tuple[_KeyframePoints | None, _KeyframePoints | None, list[tuple[int, Grey]]]]:
    """The frames between two neighbouring key frames, and before the first and after the last."""
    waiting, stretch = list(anchors), []
    before: _KeyframePoints | None = None
    for frame in source.frames():
        while waiting and frame.index >= waiting[0].frame:
            after = waiting.pop(0)
            yield before, after, stretch
            before, stretch = after, []
        if (before is None or frame.index != before.frame) and "corrupt" not in frame.flags:
            stretch.append((frame.index, to_grayscale(frame, size_px)))
            if len(stretch) > MAX_BUFFERED_FRAMES:
                del stretch[MAX_BUFFERED_FRAMES // 2]
    yield before, None, stretch
    for after in waiting:  # the video ended before they came
        yield before, after, []
        before = after
