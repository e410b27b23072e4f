"""Find the mistakes that, undone, make body, masks and tracked key points agree.

A greedy search applies the best correction again and again while its gain in score is significant.
Key points choose the few candidates whose silhouettes are worth drawing. The usual mistakes are
listed first, each as the change that maps a capture's geometry to what it should have been.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Matrix3, Vector3
from preprocess.alignment.capture_geometry import CaptureGeometry, relative_change
from preprocess.alignment.corrections import (
    CAUSES,
    Correction,
    GeometryChange,
    fit_to_keypoints,
    undo_pose_delay,
    undo_video_offset,
    undo_video_rotation,
)
from preprocess.alignment.keypoint_objective import KeypointObjective
from preprocess.alignment.silhouette_objective import (
    SilhouetteObjective,
    mean_score,
    mean_with_missing,
)
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import JOINT_NAMES, rigid_transform, rotation_matrices
from preprocess.cameras.camera_formats import OPENCV_FROM_OPENGL

MAX_CANDIDATES = 8
"""Best candidates of the coarse scores that are scored in all frames."""
MIN_GAIN = 0.02
"""Gain in score that a discrete correction must bring."""
FRAME_RATES = (24.0, 25.0, 30.0, 50.0, 60.0)
"""Frame rates, Hz, that are mistaken for one another."""
MIRROR_X = np.diag([-1.0, 1.0, 1.0])
"""Reflection that exchanges left and right."""
MIRRORED_JOINTS = [
    JOINT_NAMES.index(
        name.replace("left", "?").replace("right", "left").replace("?", "right")
    ) - 1
    for name in JOINT_NAMES[1:]
]  # fmt: skip
"""Row of each joint's other side among the 23 joint rotations."""
CatalogEntries = Iterator[tuple[str, str, GeometryChange]]
"""Causes, what was wrong, and the changes that undo it."""
Rotation3 = Matrix3


def body_corrections(
    geometry: CaptureGeometry, pelvis: Vector3, frames: int
) -> Iterator[Correction]:
    """Every discrete mistake between body and masks; focal lengths and sizes are fitted instead.

    `pelvis` is its rest position, J0, about which the root rotates.
    """
    for entries in (
        _mask_entries(),
        _camera_entries(geometry),
        _turn_entries(geometry),
        _pose_entries(geometry.motion, pelvis),
        _frame_rate_entries(geometry, frames),
    ):
        for cause, description, apply in entries:
            yield Correction(cause=cause, description=description, apply=apply)
    yield from map(undo_pose_delay, _offsets(frames))
    rows = len(geometry.row_frames)
    consecutive = np.ptp(geometry.row_frames) + 1 == rows
    if rows < frames and consecutive:  # these may be the last frames' poses, or some in between
        yield from (undo_pose_delay(-k) for k in _spaced_offsets(frames - rows))


def video_corrections(frames: int, mask_count: int) -> Iterator[Correction]:
    """Every discrete mistake of a video whose masks and poses agree; crops are fitted instead."""
    yield from (undo_video_rotation(turns) for turns in (1, 2, 3))
    yield from (undo_video_rotation(turns, mirrored=True) for turns in range(4))
    yield from map(undo_video_offset, _offsets(frames))
    yield from map(undo_video_offset, _spaced_offsets(mask_count - frames))


def _offsets(frames: int) -> Iterator[int]:
    """Offsets of the coarse grid, late and early."""
    grid = (*range(1, 13), 15, 18, 21, 25, 30, 35, 40, 50, 60)
    yield from (k for near in grid if near < frames // 2 for k in (near, -near))


def _spaced_offsets(largest: int) -> list[int]:
    """At most 24 offsets, evenly spaced from 1 to the largest."""
    if largest <= 0:
        return []
    count = min(largest, 24)
    return sorted({round(offset) for offset in np.linspace(1, largest, count)})


def _mask_entries() -> CatalogEntries:
    """Masks of the background, or of two persons."""
    inverted = "the masks are 1 where the person is not"
    yield "mask_polarity", inverted, lambda c: replace(c, masks_inverted=not c.masks_inverted)
    other = "the masks show another person, too, apart from the one whose poses are given"
    yield "second_person", other, lambda c: replace(c, keeps_person_only=True)


def _camera_entries(geometry: CaptureGeometry) -> CatalogEntries:
    """Extrinsics of another convention; none if all cameras are at the origin."""
    if _cameras_at_origin(geometry):
        return
    for cause, words, change in (
        (
            "world_frame",
            "the poses are in the camera's own frame, and its position is applied twice",
            lambda e: np.broadcast_to(np.eye(4), e.shape),
        ),
        (
            "world_frame",
            "the camera matrices are world-from-camera, not camera-from-world",
            np.linalg.inv,
        ),
        (
            "opengl_axes",
            "the camera matrices are world-from-camera with OpenGL's axes (y up, z back)",
            lambda e: OPENCV_FROM_OPENGL @ np.linalg.inv(e),
        ),
    ):
        yield cause, words, lambda c, change=change: replace(c, extrinsics=change(c.extrinsics))


def _turn_entries(geometry: CaptureGeometry) -> CatalogEntries:
    """Poses turned by quarter turns: images rotated for a tracker, worlds with another axis up."""
    turned = {
        "the camera space of the poses is": _rotate_camera_space,
        "the poses' world is": _rotate_world_space,
        "the roots' rotations and translations are": _rotate_without_pelvis_offset,
        "the roots' rotations, not their translations, are": _rotate_about_pelvis,
        "the body at rest is": _rotate_rest_body,
    }
    for words, change in turned.items():
        if change is _rotate_world_space and _cameras_at_origin(geometry):
            continue  # the same as the camera space
        for axis, degrees in ((axis, degrees) for axis in "xyz" for degrees in (90, 180, 270)):
            known = {
                ("x", 180): " (OpenGL's axes, y up and z back, not OpenCV's)",
                ("x", 90): " (z up, not y)",
                ("x", 270): " (y up, not z)",
            }.get((axis, degrees), "")
            cause = "opengl_axes" if "OpenGL" in known else "root_rotation"
            turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
            description = f"{words} rotated by {360 - degrees}° about {axis}{known}"
            yield cause, description, partial(change, turn=turn)


def _pose_entries(motion: Motion, pelvis: Vector3) -> CatalogEntries:
    """Other units, signs and origins, and left and right exchanged."""

    def about_origin(motion: Motion, sign: float) -> Motion:
        offset = sign * (_root_matrices(motion) @ pelvis - pelvis)
        return replace(motion, root_translations=motion.root_translations + offset)

    def scaled(motion: Motion, factor: float) -> Motion:
        return replace(motion, root_translations=motion.root_translations * factor)

    def swapped(motion: Motion) -> Motion:
        return replace(motion, joint_rotations=motion.joint_rotations[:, MIRRORED_JOINTS])

    for which, signs in {
        "y": (1.0, -1.0, 1.0),
        "z": (1.0, 1.0, -1.0),
        "y and z": (1.0, -1.0, -1.0),
    }.items():
        flipped = partial(_transform_translations, change=np.diag(np.array(signs)))
        yield "opengl_axes", f"the root's translation has the wrong sign of {which}", flipped
    both = "the joints of the left and the right side are exchanged"
    yield "left_right", both, _moves(swapped)
    yield "left_right", "the limbs are mirrored", _moves(_mirror_limbs)
    yield "left_right", "the tracker saw the images mirrored", _mirror_image
    for sign, words in (
        (1.0, "the root turns about the origin (EasyMocap, ZJU), not about the pelvis"),
        (-1.0, "the root's translation was already converted from the origin to the pelvis"),
    ):
        yield "root_origin", words, _moves(partial(about_origin, sign=sign))
    for factor, unit in {0.001: "millimetres", 0.01: "centimetres"}.items():
        words = f"the poses' translations are in {unit}, not in metres"
        yield "body_scale", words, _moves(partial(scaled, factor=factor))


def _frame_rate_entries(geometry: CaptureGeometry, frames: int) -> CatalogEntries:
    """Poses of a copy of the video with another frame rate, or played backwards."""

    def mapped(geometry: CaptureGeometry, factor: float, offset: float) -> CaptureGeometry:
        return replace(geometry, row_frames=offset + factor * geometry.row_frames)

    known = geometry.row_frames[np.isfinite(geometry.row_frames)]
    if len(known) > 1:
        reverse = partial(mapped, factor=-1.0, offset=known.min() + known.max())
        yield "frame_rate", "the video runs backwards against its poses", reverse
    factors = {a / b for a in FRAME_RATES for b in FRAME_RATES if a != b}
    if len(geometry.row_frames) != frames:
        factors.add(frames / len(geometry.row_frames))
    for factor in sorted(factors):
        words = f"the poses were made at {1.0 / factor:.3g} times the video's frame rate"
        yield "frame_rate", words, partial(mapped, factor=factor, offset=0.0)


def _moves(change: Callable[[Motion], Motion]) -> GeometryChange:
    """Lifts a change of the motion to one of the geometry."""
    return lambda c: replace(c, motion=change(c.motion))


def _cameras_at_origin(geometry: CaptureGeometry) -> bool:
    return np.allclose(geometry.extrinsics, np.eye(4), atol=1e-6)


def _rotate_camera_space(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    return replace(geometry, extrinsics=rigid_transform(turn, np.zeros(3)) @ geometry.extrinsics)


def _rotate_world_space(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    return replace(geometry, extrinsics=geometry.extrinsics @ rigid_transform(turn, np.zeros(3)))


def _rotate_rest_body(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    return _with_root_rotations(geometry, _root_matrices(geometry.motion) @ turn)


def _root_matrices(motion: Motion) -> Float[np.ndarray, "poses 3 3"]:
    return rotation_matrices(np.nan_to_num(motion.root_rotations))


def _with_root_rotations(
    geometry: CaptureGeometry, roots: Float[np.ndarray, "poses 3 3"]
) -> CaptureGeometry:
    vectors = Rotation.from_matrix(roots).as_rotvec()
    return replace(geometry, motion=replace(geometry.motion, root_rotations=vectors))


def _camera_rotations(geometry: CaptureGeometry) -> Float[np.ndarray, "poses 3 3"]:
    """Rotation from the world into the camera of each row."""
    return geometry.extrinsics[geometry.camera_rows(), :3, :3]


def _rotate_about_pelvis(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    """The root rotated in the camera's axes about the pelvis, which stays."""
    cameras = _camera_rotations(geometry)
    return _with_root_rotations(
        geometry, np.swapaxes(cameras, 1, 2) @ turn @ cameras @ _root_matrices(geometry.motion)
    )


def _rotate_without_pelvis_offset(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    """Root rotations and translations in another world, as converters write them that forget J0.

    A pose's pelvis is at J0 + translation, so a correct conversion rotates that sum.
    """
    motion = geometry.motion
    moved = replace(motion, root_translations=motion.root_translations @ turn.T)
    return _with_root_rotations(replace(geometry, motion=moved), turn @ _root_matrices(motion))


def _transform_translations(geometry: CaptureGeometry, change: Rotation3) -> CaptureGeometry:
    """The root translations changed in the camera's axes; the rotations stay."""
    rows = geometry.camera_rows()
    rotation, offset = geometry.extrinsics[rows, :3, :3], geometry.extrinsics[rows, :3, 3]
    in_camera = np.einsum("cab,cb->ca", rotation, geometry.motion.root_translations) + offset
    in_world = np.einsum("cba,cb->ca", rotation, in_camera @ change.T - offset)
    return replace(geometry, motion=replace(geometry.motion, root_translations=in_world))


def _mirror_limbs(motion: Motion) -> Motion:
    """Each limb takes the mirrored rotations of the other side."""
    limbs = motion.joint_rotations[:, MIRRORED_JOINTS] * np.array([1.0, -1.0, -1.0])
    return replace(motion, joint_rotations=limbs)


def _mirror_image(geometry: CaptureGeometry) -> CaptureGeometry:
    """The person as a mirror shows them, left and right exchanged in the camera's axes."""
    mirrored = _transform_translations(geometry, MIRROR_X)
    cameras = _camera_rotations(geometry)
    back = np.swapaxes(cameras, 1, 2)
    roots = back @ MIRROR_X @ cameras @ _root_matrices(geometry.motion) @ MIRROR_X
    return _with_root_rotations(replace(mirrored, motion=_mirror_limbs(mirrored.motion)), roots)


@dataclass(frozen=True, eq=False, kw_only=True)
class CaptureObjective:
    """Scores a geometry by masks and key points of a few frames.

    `masks` is None without masks; `keypoints` is None if no person was found in the images.
    """

    masks: SilhouetteObjective | None
    keypoints: KeypointObjective | None

    def frame_scores(self, geometry: CaptureGeometry) -> Float[np.ndarray, "samples"]:
        """IoU of each mask, then score of each image's key points; NaN where there is no pose."""
        parts = [each for each in (self.masks, self.keypoints) if each is not None]
        return np.concatenate([np.zeros(0), *(each.frame_scores(geometry) for each in parts)])

    def coarse_score(self, geometry: CaptureGeometry) -> float:
        """Mean score of the key points; without any, IoU of a few masks."""
        if self.keypoints is not None:
            return mean_with_missing(self.keypoints.frame_scores(geometry))
        if self.masks is None:
            return 0.0
        return mean_with_missing(self.masks.subset(6).frame_scores(geometry))


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionCandidate:
    """A correction and the score it would bring: the mean, and that of each frame."""

    correction: Correction
    mean_score: float
    frame_scores: Float[np.ndarray, "samples"]


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionResult:
    """The mistakes found in a capture, by their gain, and the geometry without them.

    `candidates` are the best of each cause in the first round, best first.
    """

    corrections: tuple[Correction, ...]
    candidates: tuple[CorrectionCandidate, ...]
    corrected: CaptureGeometry


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrectionSearch:
    """The corrections that are tried, and their scores.

    The pelvis is at rest; `mask_count` is 0 if images and masks cannot disagree.
    """

    objective: CaptureObjective
    pelvis: Vector3
    frames: int
    mask_count: int

    def run(self, geometry: CaptureGeometry) -> CorrectionResult:
        """Apply the best correction again and again while that helps significantly."""
        stored = geometry
        scores = self.objective.frame_scores(geometry)
        chosen: list[Correction] = []
        first: tuple[CorrectionCandidate, ...] = ()
        while len(chosen) < 3:
            candidates = self._best_candidates(geometry)
            first = first if chosen else best_per_cause(candidates)
            candidates = [c for c in candidates if is_significant(c, geometry, scores)]
            if not candidates:
                break
            best = max(candidate.mean_score for candidate in candidates)
            # of equal scores, the cause that stands first in `CAUSES` is named
            tied = [each for each in candidates if each.mean_score > best - 0.004]
            winner = min(tied, key=lambda each: CAUSES.index(each.correction.cause))
            chosen.append(winner.correction)
            geometry, scores = winner.correction.apply(geometry), winner.frame_scores
        if mean_score(scores) < 0.5:  # they explain nothing
            chosen, geometry = [], stored
        return CorrectionResult(corrections=tuple(chosen), candidates=first, corrected=geometry)

    def _best_candidates(self, geometry: CaptureGeometry) -> list[CorrectionCandidate]:
        """The best candidates of the coarse scores, and the best of each cause, scored wholly."""
        scored = self._score_coarsely(self._discrete(geometry), geometry)
        for cause, make in (("frame_offset", undo_pose_delay), ("video_offset", undo_video_offset)):
            shifts = [(score, c.frame_shift) for score, c in scored if c.cause == cause]
            center = max(((s, k) for s, k in shifts if k is not None), default=(0.0, 0))[1]
            reach = max(1, abs(center) // 5) if shifts else 0
            near = [make(center + k) for k in range(-reach, reach + 1) if k and center + k]
            scored += self._score_coarsely(near, geometry)
        scored += self._score_coarsely(self._fitted(geometry), geometry)
        scored.sort(key=lambda pair: -pair[0])
        kept = [correction for _, correction in scored[:MAX_CANDIDATES]]
        for _, correction in scored[MAX_CANDIDATES:]:
            if correction.cause not in {each.cause for each in kept}:
                kept.append(correction)
        found = [(each, self.objective.frame_scores(each.apply(geometry))) for each in kept]
        return [
            CorrectionCandidate(correction=each, mean_score=mean_with_missing(s), frame_scores=s)
            for each, s in found
        ]

    def _score_coarsely(
        self, corrections: Iterable[Correction], geometry: CaptureGeometry
    ) -> list[tuple[float, Correction]]:
        return [(self.objective.coarse_score(each.apply(geometry)), each) for each in corrections]

    def _discrete(self, geometry: CaptureGeometry) -> Iterable[Correction]:
        yield from body_corrections(geometry, self.pelvis, self.frames)
        if self.mask_count and self.objective.keypoints is not None:
            yield from video_corrections(self.frames, self.mask_count)

    def _fitted(self, geometry: CaptureGeometry) -> Iterable[Correction]:
        """The best focal length, principal point, size, aspect and window of the video."""
        if self.objective.keypoints is None:  # outlines alone would fit wide clothes
            return ()
        fitted = fit_to_keypoints(geometry, self.objective.keypoints)
        return (c for c in fitted if self.mask_count or c.cause != "video_crop")


def best_per_cause(candidates: Iterable[CorrectionCandidate]) -> tuple[CorrectionCandidate, ...]:
    """The best candidate of each cause, best first."""
    best: dict[str, CorrectionCandidate] = {}
    for each in sorted(candidates, key=lambda each: -each.mean_score):
        best.setdefault(each.correction.cause, each)
    return tuple(best.values())


def is_significant(
    candidate: CorrectionCandidate, geometry: CaptureGeometry, scores: Float[np.ndarray, "samples"]
) -> bool:
    """Check whether a candidate gains enough, frame by frame, over the current scores."""
    gains = candidate.frame_scores - np.nan_to_num(scores)
    had, has = np.isfinite(scores), np.isfinite(candidate.frame_scores)
    if had.sum() - has.sum() > 0.3 * had.sum():
        # It would explain some frames by giving up others: those count as lost.
        gains = np.where(had & ~has, -np.nan_to_num(scores), gains)
    gains = gains[np.isfinite(gains)]
    if 2 * len(gains) < len(scores):
        return False
    correction = candidate.correction
    is_fitted = correction.factor is not None
    least = 0.02 if correction.cause == "video_crop" else 0.06  # relative change
    if is_fitted and relative_change(geometry, correction.apply(geometry)) < least:
        return False
    error = gains.std(ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else 0.0
    needed = 0.04 if is_fitted else MIN_GAIN  # clothes make every body a little larger
    return bool(gains.mean() > max(needed, 3.0 * error))  # standard errors over the frames
