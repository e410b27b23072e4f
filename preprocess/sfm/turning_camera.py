"""Solve a camera that only turns: one focal length, and a rotation for each key frame.

Seen from one place the surroundings might as well lie at infinity: from key frame a to key frame b
they move by the homography K R_b R_aᵀ K⁻¹ (Hartley & Zisserman 2004, ch. 8.4 and 19.6). Corners of
some key frames, the anchors, are followed into all others that show them; homographies give focal
length and rotations to start with, Gauss-Newton on all corners the rest. The parallax of a camera
that is carried around is left over, and fails the gates.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.spatial.transform import Rotation

from capture.camera import Matrix3
from preprocess.body.kinematics import cross_matrices
from preprocess.sfm.camera_solution import SparseModel
from preprocess.sfm.colmap_mapping import STATED_FOCAL_TOLERANCE, SfmKeyframe
from preprocess.sfm.point_tracking import INLIER_PX, detect_corners, track_points

MAX_STATIC_MOTION = 0.005
"""Largest shift of a static background; a fraction of the image's longer side (5 px of 960)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Track:
    """Corners of the key frame `anchor` in the key frame `view`, pixels from the image's middle."""

    anchor: int
    view: int
    corners: Int[np.ndarray, "points"]
    start: Float[np.ndarray, "points 2"]
    end: Float[np.ndarray, "points 2"]
    homography: Matrix3


@dataclass(frozen=True, eq=False, kw_only=True)
class _Turns:
    """Rotations camera-from-world of all key frames, and their focal length."""

    rotations: Float[np.ndarray, "keys 3 3"]
    focal_px: float

    def rays(self, pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 3"]:
        """Where pixels (from the image's middle) look in the camera, at depth 1."""
        return np.column_stack([pixels / self.focal_px, np.ones(len(pixels))])


def solve_turning_camera(
    keys: list[SfmKeyframe], stated_focal_px: float | None
) -> SparseModel | None:
    """Solve key frames as those of a camera that only turns; None if they do not hang together.

    The points of the model are directions. A stated focal length is used if it fits.
    """
    tracks = _follow_corners(keys, range(0, len(keys), -(-len(keys) // 12)))
    turns = _initial_turns(tracks, len(keys), max(keys[0].gray.shape))
    if turns is None:
        return None
    turns = _refine(turns, tracks)
    ratio = turns.focal_px / (stated_focal_px or np.inf)
    if abs(ratio - 1.0) < STATED_FOCAL_TOLERANCE:
        stated = _Turns(rotations=turns.rotations, focal_px=turns.focal_px / ratio)
        turns = _refine(stated, tracks, holds_focal=True)
    return _to_model(turns, tracks, keys)


def measure_background_motion(keys: list[SfmKeyframe]) -> float:
    """Largest shift of the background from the first key frame to another.

    The median over its corners, as a fraction of the image's longer side; NaN if it was lost.
    """
    tracks = _follow_corners(keys, range(1))
    if len(tracks) < len(keys) - 1:
        return float("nan")
    moved = (np.median(np.linalg.norm(each.end - each.start, axis=1)) for each in tracks)
    return float(max(moved)) / max(keys[0].gray.shape)


def _follow_corners(keys: list[SfmKeyframe], anchors: range) -> list[_Track]:
    """Follow the background's corners of anchors forwards and backwards until they are lost."""
    tracks, middle = [], 0.5 * np.array(keys[0].gray.shape[::-1])
    for anchor in anchors:
        start = keys[anchor]
        corners = detect_corners(start.gray, ~start.person_mask, 200)
        for views in (range(anchor + 1, len(keys)), range(anchor - 1, -1, -1)):
            rows, last = np.arange(len(corners)), corners
            for view in views:
                last, is_same = track_points(start.gray, keys[view].gray, corners[rows], last)
                column, row = last[is_same].astype(int).T
                is_same[is_same] = ~keys[view].person_mask[row, column]
                rows, last = rows[is_same], last[is_same]
                if len(rows) < 20:
                    break
                begin, end = corners[rows] - middle, last - middle
                plane, is_inlier = cv2.findHomography(begin, end, cv2.RANSAC, INLIER_PX)
                if plane is None or is_inlier.mean() < 0.6:  # parallax leaves fewer
                    break
                near = is_inlier[:, 0] > 0
                rows, last = rows[near], last[near]
                tracks.append(_Track(
                    anchor=anchor, view=view, corners=rows, start=begin[near], end=end[near],
                    homography=plane,
                ))  # fmt: skip
    return tracks


def _initial_turns(tracks: list[_Track], keys: int, longer_px: int) -> _Turns | None:
    """The focal length that makes homographies most like rotations; None if a frame is apart."""
    if not tracks:
        return None
    planes = np.stack([track.homography for track in tracks])
    planes /= np.cbrt(np.linalg.det(planes))[:, None, None]

    def turned(focal_px: float) -> Float[np.ndarray, "tracks 3 3"]:
        scale = np.array([focal_px, focal_px, 1.0])
        return planes * scale / scale[:, None]

    def distance_from_rotations(focal_px: float) -> float:
        gram = np.einsum("nba,nbc->nac", turned(focal_px), turned(focal_px))
        return float(np.linalg.norm(gram - np.eye(3), axis=(1, 2)).sum())

    focal_px = float(min(np.geomspace(0.4, 2.5, 60) * longer_px, key=distance_from_rotations))
    rotations = {0: np.eye(3)}
    for track, matrix in zip(tracks, turned(focal_px), strict=True):
        left, _, right = np.linalg.svd(matrix)
        if track.anchor in rotations:  # in order, so that one anchor leads to the next
            rotations.setdefault(track.view, left @ right @ rotations[track.anchor])
    if len(rotations) < keys:
        return None
    return _Turns(rotations=np.stack([rotations[row] for row in range(keys)]), focal_px=focal_px)


def _refine(turns: _Turns, tracks: list[_Track], *, holds_focal: bool = False) -> _Turns:
    """Gauss-Newton on all tracks, far corners weighing less (Huber 1964); key frame 0 stays."""
    start, end = (np.concatenate([getattr(t, name) for t in tracks]) for name in ("start", "end"))
    anchor, view = (
        np.repeat([getattr(t, name) for t in tracks], [len(t.start) for t in tracks])
        for name in ("anchor", "view")
    )
    keys = len(turns.rotations)
    axes = np.arange(3)
    columns = np.column_stack(
        [3 * view[:, None] + axes, 3 * anchor[:, None] + axes, np.full(len(start), 3 * keys)]
    )
    free = slice(3, 3 * keys + (not holds_focal))
    for _ in range(10):
        relative = turns.rotations[view] @ turns.rotations[anchor].transpose(0, 2, 1)
        rays = turns.rays(start)
        seen_rays = np.einsum("nab,nb->na", relative, rays)
        plane = turns.focal_px * seen_rays[:, :2] / seen_rays[:, 2:]
        off = plane - end
        slope = np.zeros((len(start), 2, 3))  # of the pixel by its ray
        slope[:, 0, 0] = slope[:, 1, 1] = turns.focal_px / seen_rays[:, 2]
        slope[:, :, 2] = -plane / seen_rays[:, 2:]
        ray_slope = slope @ relative
        by_focal = plane - np.einsum("nab,nb->na", ray_slope[:, :, :2], rays[:, :2])
        by_view, by_anchor = -slope @ cross_matrices(seen_rays), ray_slope @ cross_matrices(rays)
        values = np.concatenate([by_view, by_anchor, by_focal[:, :, None]], axis=2)
        rows = np.broadcast_to(np.arange(off.size).reshape(-1, 2, 1), values.shape)
        entry_columns = np.broadcast_to(columns[:, None], values.shape)
        entries = values.ravel(), (rows.ravel(), entry_columns.ravel())
        jacobian = coo_array(entries, shape=(off.size, 3 * keys + 1)).tocsc()[:, free]
        weights = 1.0 / np.maximum(1.0, np.linalg.norm(off, axis=1).repeat(2))
        weighted = jacobian.multiply(weights[:, None]).T
        step = np.zeros(3 * keys + 1)
        step[free] = np.linalg.solve((weighted @ jacobian).toarray(), -(weighted @ off.ravel()))
        by_key = Rotation.from_rotvec(step[:-1].reshape(-1, 3)).as_matrix()
        turns = _Turns(
            rotations=by_key @ turns.rotations, focal_px=turns.focal_px * float(np.exp(step[-1]))
        )
    return turns


def _to_model(turns: _Turns, tracks: list[_Track], keys: list[SfmKeyframe]) -> SparseModel:
    """Rotations as cameras at the origin; each anchor sees its corners just where they are."""
    height, width = keys[0].gray.shape
    middle = 0.5 * np.array([width, height])
    seen: dict[tuple[int, int], np.ndarray] = {}
    for track in tracks:
        seen |= zip(((track.anchor, c) for c in track.corners.tolist()), track.start, strict=True)
    point_of = {corner: row for row, corner in enumerate(seen)}
    anchors = np.array([anchor for anchor, _ in seen])
    rays = turns.rays(np.stack(list(seen.values())))
    points = np.einsum("nba,nb->na", turns.rotations[anchors], rays)
    followed = [[point_of[track.anchor, c] for c in track.corners.tolist()] for track in tracks]
    views = np.repeat([track.view for track in tracks], [len(rows) for rows in followed])
    transforms = np.tile(np.eye(4), (len(keys), 1, 1))
    transforms[:, :3, :3] = turns.rotations
    return SparseModel(
        frames=np.array([key.index for key in keys]),
        camera_from_world=transforms,
        focal_px=turns.focal_px,
        center_px=(0.5 * width, 0.5 * height),
        radial_distortion=0.0,
        size_px=(width, height),
        points=points / np.linalg.norm(points, axis=1, keepdims=True),
        observation_camera=np.concatenate([anchors, views]),
        observation_point=np.concatenate([np.arange(len(points)), *followed]),
        pixels=np.concatenate([np.stack(list(seen.values())), *(t.end for t in tracks)]) + middle,
        only_turns=True,
    )
