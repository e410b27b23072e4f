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
from capture.source import Source
from preprocess.solve.keyframes import KeyFrame, grey_of
from preprocess.solve.model import Model
from preprocess.solve.tracking import followed

LEAST_POINTS = 20
MOST_POINTS = 600
INLIER_PX = 2.0
LEAST_INLIERS = 0.5
MOST_HELD = 256
"""Frames between two key frames that are kept in memory; of longer stretches the middle is left."""

Grey = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Between:
    """What following points has found.

    Attributes:
        placed: Camera-from-world by the frame's number; key frames' own are not among them.
        bridges: For each key frame that points were followed into from the one before: how far,
            in pixels, they land from where its own camera sees them (median); by its number.
    """

    placed: dict[int, Float[np.ndarray, "4 4"]]
    bridges: dict[int, float]


def place_between(
    source: Source, model: Model, keys: list[KeyFrame], told: Callable[[float], None]
) -> Between:
    """Cameras for all frames that have none.

    Args:
        source: The frames.
        model: The key frames' cameras, for pictures of the key frames' size.
        keys: The key frames; those without a camera in the model are placed like any other frame.
        told: Called with how much of the video is done.
    """
    own = {key.index: key for key in keys}
    anchors = [
        _Anchor.of(model, row, own[int(frame)]) for row, frame in enumerate(model.frames.tolist())
    ]
    placed: dict[int, np.ndarray] = {}
    bridges: dict[int, float] = {}
    total = max(source.frame_count or source.frames_in_file, 1)
    for before, after, stretch in _stretches(source, anchors, model.size_px):
        if stretch:
            told(min(source.selection.position(stretch[-1][0]) / total, 1.0))
        seen = _Sightings()
        if before is not None:
            ends = stretch if after is None else [*stretch, (after.frame, after.grey)]
            before.follow(ends, seen)
        if before is not None and after is not None:
            bridges[after.frame] = seen.miss(after.frame, after.camera)
        if after is not None:
            after.follow(stretch[::-1], seen)
        for frame, _ in stretch:
            found = resected(*seen.of(frame), (before or after).camera)  # type: ignore[union-attr]
            if found is not None:
                placed[frame] = found
    return Between(placed=placed, bridges=bridges)


def resected(
    points: Float[np.ndarray, "points 3"], pixels: Float[np.ndarray, "points 2"], lens: Camera
) -> Float[np.ndarray, "4 4"] | None:
    """The camera that sees known points where they were seen; None if most contradict it.

    Args:
        points: In the world.
        pixels: Where each was seen; some may be wrong.
        lens: With the focal length, and where the camera may be.
    """
    if len(points) < LEAST_POINTS:
        return None
    bend = np.array(lens.distortion or (0.0, 0.0, 0.0, 0.0))
    cv2.setRNGSeed(0)
    ok, turn, shift, kept = cv2.solvePnPRansac(
        points, pixels, lens.intrinsic, bend, iterationsCount=200, reprojectionError=INLIER_PX,
        confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    inliers = np.zeros(0, np.int64) if kept is None else np.asarray(kept)[:, 0].astype(np.int64)
    if not ok or len(inliers) < max(LEAST_POINTS, LEAST_INLIERS * len(points)):
        return None
    for reach in (INLIER_PX, 0.5 * INLIER_PX, 0.0):  # the last round leaves out what is half right
        turn, shift = cv2.solvePnPRefineLM(
            points[inliers], pixels[inliers], lens.intrinsic, bend, turn, shift
        )
        drawn = np.asarray(cv2.projectPoints(points, turn, shift, lens.intrinsic, bend)[0])
        near = np.flatnonzero(np.linalg.norm(drawn[:, 0] - pixels, axis=1) < reach)
        inliers = near if len(near) >= LEAST_POINTS else inliers
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return transform


@dataclass(frozen=True, eq=False, kw_only=True)
class _Anchor:
    """A key frame with its camera and the points it sees."""

    frame: int
    grey: Grey
    camera: Camera
    points: Float[np.ndarray, "points 3"]
    pixels: Float[np.ndarray, "points 2"]

    @classmethod
    def of(cls, model: Model, row: int, key: KeyFrame) -> "_Anchor":
        seen = model.seen_in(row)
        lengths = np.bincount(model.seen_point, minlength=len(model.points))
        longest = np.argsort(-lengths[model.seen_point[seen]], kind="stable")[:MOST_POINTS]
        seen = seen[longest]
        return cls(
            frame=key.index,
            grey=key.grey,
            camera=model.camera(model.camera_from_world[row]),
            points=model.points[model.seen_point[seen]],
            pixels=model.pixels[seen],
        )

    def follow(self, pictures: list[tuple[int, Grey]], seen: "_Sightings") -> None:
        """Follows the points through pictures that come one after the other."""
        guess, alive = self.pixels.copy(), np.ones(len(self.pixels), dtype=bool)
        for frame, grey in pictures:
            rows = np.flatnonzero(alive)
            there, found = followed(self.grey, grey, self.pixels[rows], guess[rows])
            guess[rows[found]] = there[found]
            alive[rows[~found]] = False
            seen.add(frame, self.points[rows[found]], there[found])


class _Sightings:
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

    def miss(self, frame: int, camera: Camera) -> float:
        points, pixels = self.of(frame)
        if len(points) < LEAST_POINTS:
            return float("nan")
        return float(np.median(np.linalg.norm(camera.project(points) - pixels, axis=1)))


def _stretches(
    source: Source, anchors: list[_Anchor], size_px: tuple[int, int]
) -> Iterator[tuple[_Anchor | None, _Anchor | None, list[tuple[int, Grey]]]]:
    """The frames between two neighbouring key frames, and before the first and after the last."""
    waiting, stretch = list(anchors), []
    before: _Anchor | None = None
    for frame in source.frames():
        while waiting and frame.index >= waiting[0].frame:
            after = waiting.pop(0)
            yield before, after, stretch
            before, stretch = after, []
        if (before is None or frame.index != before.frame) and "corrupt" not in frame.flags:
            stretch.append((frame.index, grey_of(frame, size_px)))
            if len(stretch) > MOST_HELD:
                del stretch[MOST_HELD // 2]
    yield before, None, stretch
    for after in waiting:  # the video ended before they came
        yield before, after, []
        before = after
