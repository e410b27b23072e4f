"""Where a camera that nobody described must have stood, found from masks alone."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from preprocess.doctor.claim import Claim
from preprocess.doctor.cure import Cure, recentred
from preprocess.doctor.evidence import Evidence
from preprocess.silhouette import agreement, silhouette

FRAMES = 6
MOST_CROPPED = 0.45
"""Share of a picture's sides by which its principal point may be off."""
YAWS = 24
UPS = {"y": np.diag([1.0, -1.0, -1.0]), "z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}
"""Level OpenCV cameras in worlds with y or z up."""
BEST = 2
STEPS = 200
FIRST_TURN, FIRST_SHIFT_M = 0.15, 0.15
"""Size of the first steps of the search."""


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scene:
    """Posed bodies in the world, and their masks, for one camera that stands still."""

    claim: Claim
    evidence: Evidence

    @cached_property
    def camera_rows(self) -> list[int]:
        """The camera of each of the bodies."""
        witnesses = self.evidence.witnesses
        return [w.camera_row for w in witnesses if self.claim.row_of(w.index) is not None]

    @cached_property
    def bodies(self) -> list[tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "_ _"]]]:
        found = []
        for witness in self.evidence.witnesses:
            row = self.claim.row_of(witness.index)
            if row is not None:
                points = self.evidence.posed(self.claim.motion, row)
                found.append((points, witness.alpha))
        return found

    def score(self, extrinsic: Float[np.ndarray, "4 4"]) -> float:
        """Mean agreement if the camera stood there."""
        claim = replace(self.claim, extrinsics=extrinsic[None])
        camera = claim.camera(0, self.evidence.size_px)
        return float(np.mean([agreement(silhouette(p, camera), a) for p, a in self.bodies]))

    def placed(self, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
        """The camera of a given direction from which the bodies are where the masks are."""
        extrinsic = np.eye(4)
        extrinsic[:3, :3] = rotation
        extrinsic[:3, 3] = -rotation @ np.mean([p.mean(axis=0) for p, _ in self.bodies], axis=0)
        extrinsic[2, 3] += 4.0
        for _ in range(4):
            camera = replace(self.claim, extrinsics=extrinsic[None]).camera(
                0, self.evidence.size_px
            )
            drawn = np.median([_bounds(camera.project(p[::8])) for p, _ in self.bodies], axis=0)
            wanted = np.median([_box(a) for _, a in self.bodies], axis=0)
            depth = float(np.mean([(p @ rotation[2]).mean() for p, _ in self.bodies]))
            far = (depth + extrinsic[2, 3]) * (drawn[3] - drawn[1]) / (wanted[3] - wanted[1])
            off = 0.5 * (wanted[:2] + wanted[2:] - drawn[:2] - drawn[2:])
            extrinsic[:2, 3] += off * far / np.array(camera.focal_px)
            extrinsic[2, 3] = far - depth
        return extrinsic


def centring(claim: Claim, evidence: Evidence) -> Cure | None:
    """The principal point with which bodies are where the masks are.

    None if no mask has a pose, or they are so far apart that no cropping explains it.
    """
    scene = _Scene(claim=claim, evidence=evidence.some(FRAMES))
    if not scene.bodies:
        return None
    small = np.array(evidence.size_px) / np.array(claim.size_px)
    wanted = np.stack([_box(alpha) for _, alpha in scene.bodies])
    drawn = np.stack(
        [
            _bounds(claim.camera(row, evidence.size_px).project(points[::8]))
            for (points, _), row in zip(scene.bodies, scene.camera_rows, strict=True)
        ]
    )
    away = np.median(wanted - drawn, axis=0)
    right, down = 0.5 * (away[:2] + away[2:]) / small
    near = bool((np.abs([right, down]) < MOST_CROPPED * np.array(claim.size_px)).all())
    return recentred(float(right), float(down)) if near else None


def standing(claim: Claim, evidence: Evidence) -> Cure | None:
    """The camera that fits best, if there is one camera and any masks have poses.

    Level cameras from all sides, in worlds with y or z up; the best are moved and turned freely.
    """
    scene = _Scene(claim=claim, evidence=evidence.some(FRAMES))
    if len(claim.extrinsics) > 1 or not scene.bodies:
        return None
    starts = [
        scene.placed(up @ _turned(up, 2.0 * np.pi * k / YAWS)) for up in UPS.values()
        for k in range(YAWS)
    ]  # fmt: skip
    starts.sort(key=scene.score, reverse=True)
    extrinsic = max((_refined(scene, start) for start in starts[:BEST]), key=scene.score)
    return Cure(
        cause="world_frame",
        words="the poses are in world coordinates and no file gives the camera's position; "
        "one that fits was found from the masks",
        undo=lambda c: replace(c, extrinsics=extrinsic[None]),
    )


def _turned(up: Float[np.ndarray, "3 3"], angle: float) -> Float[np.ndarray, "3 3"]:
    """A turn of the world about the axis that is up in it."""
    return Rotation.from_rotvec(-angle * up[1]).as_matrix()


def _refined(scene: _Scene, start: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Moved and turned about the bodies' middle until masks agree best (Nelder and Mead)."""
    from scipy.optimize import minimize  # 0.1 s that a capture in order does not need

    middle = np.mean([p.mean(axis=0) for p, _ in scene.bodies], axis=0) @ start[:3, :3].T

    def moved(x: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        extrinsic = np.eye(4)
        extrinsic[:3, :3] = turn @ start[:3, :3]
        extrinsic[:3, 3] = start[:3, 3] + middle - turn @ middle + x[3:]
        return extrinsic

    size = np.diag([FIRST_TURN] * 3 + [FIRST_SHIFT_M] * 3)
    found = minimize(
        lambda x: -scene.score(moved(x)), np.zeros(6), method="Nelder-Mead",
        options={"maxfev": STEPS, "initial_simplex": np.vstack([np.zeros(6), size])},
    )  # fmt: skip
    return moved(found.x)


def _bounds(pixels: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "4"]:
    return np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])


def _box(alpha: Float32[np.ndarray, "height width"]) -> Float[np.ndarray, "4"]:
    rows, columns = np.nonzero(alpha > 0.5)
    low, high = (columns.min(), rows.min()), (columns.max() + 1, rows.max() + 1)
    return np.array([*low, *high], dtype=np.float64)
