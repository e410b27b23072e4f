"""Quality gates of a solution, because structure from motion can fail silently.

A mapper also reports success when repeating texture has led it to a wrong world with every frame
in it. Wrong solutions fail one of the gates below, or contradict the other mapper or the points
that are tracked from frame to frame.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from preprocess.sfm.camera_solution import QualityGate, SparseModel

MIN_REGISTERED_FRACTION = 0.9
"""Fraction of the key frames that must have a camera."""

MAX_REPROJECTION_PX = 0.6
"""Largest median reprojection error, pixels."""

MIN_OBSERVATION_RATIO = 0.4
"""Fewest observations of a camera, as a fraction of the median camera's: with fewer it may rest on
a few wrong matches."""

FOCAL_RANGE = (0.5, 2.0)
"""Plausible focal lengths, as fractions of the image's longer side."""

MIN_TRIANGULATION_ANGLE_DEG = 1.0
"""Smallest angle between the views of the median point; below it depth is a guess."""

MIN_SPARSE_POINTS = 60
"""Fewest points of a model."""

JUMP_SIGMAS = 6.0
"""Deviation of a rotation from its neighbors' mean that counts as a jump; standard deviations."""

JUMP_DEG = 1.0
"""Deviation of a rotation from its neighbors' mean that counts as a jump; degrees."""

MAX_MODEL_DISTANCE = 0.01
"""Largest distance between two mappers' cameras, as a fraction of the path's length."""

MAX_MODEL_ROTATION_DEG = 1.0
"""Largest rotation between two mappers' cameras, degrees."""


def find_outlier_cameras(model: SparseModel) -> Bool[np.ndarray, "cameras"]:
    """Cameras that see too few points, or turn unlike their neighbours; better placed otherwise."""
    counts = np.bincount(model.observation_camera, minlength=len(model.frames))
    few = counts < MIN_OBSERVATION_RATIO * np.median(counts)
    return few | _rotation_jumps(model)


def evaluate_gates(model: SparseModel, keys: int) -> list[QualityGate]:
    """Every gate that one model can pass by itself.

    Args:
        model: Without its doubtful cameras.
        keys: How many key frames there were.
    """
    registered = len(model.frames) / keys
    residual = float(np.mean(model.reprojection_errors_px())) if len(model.pixels) else np.inf
    focal = model.focal_px / max(model.size_px)
    angle = _median_angle(model)
    return [
        QualityGate(
            name="registered", value=registered, bound=MIN_REGISTERED_FRACTION,
            passed=registered >= MIN_REGISTERED_FRACTION,
            failure_reason=f"only {len(model.frames)} of {keys} key frames could be placed with "
            "certainty",
        ),
        QualityGate(
            name="points", value=float(len(model.points)), bound=float(MIN_SPARSE_POINTS),
            passed=len(model.points) >= MIN_SPARSE_POINTS,
            failure_reason=f"only {len(model.points)} points of the surroundings were found",
        ),
        QualityGate(
            name="reprojection_px", value=residual, bound=MAX_REPROJECTION_PX,
            passed=residual < MAX_REPROJECTION_PX,
            failure_reason=f"points are seen {residual:.2f} px beside where they should be",
        ),
        QualityGate(
            name="focal", value=focal, bound=FOCAL_RANGE[0],
            passed=FOCAL_RANGE[0] <= focal <= FOCAL_RANGE[1],
            failure_reason=f"the focal length came out as {focal:.2f} times the longer side",
        ),
        QualityGate(
            name="angle_deg", value=angle, bound=MIN_TRIANGULATION_ANGLE_DEG,
            passed=angle >= MIN_TRIANGULATION_ANGLE_DEG,
            failure_reason="the camera hardly changes its place (points are seen under "
            f"{angle:.1f}°)",
        ),
    ]  # fmt: skip


def compare_models(one: SparseModel, other: SparseModel) -> QualityGate:
    """Whether two models are the same but for size and place.

    Their common cameras' centres, aligned by a similarity, in lengths of the camera's path; and the
    largest angle between their rotations.
    """
    common, here, there = np.intersect1d(one.frames, other.frames, return_indices=True)
    words = "the two ways of solving contradict each other"
    if len(common) < 3:
        return QualityGate(
            name="agreement",
            value=np.inf,
            bound=MAX_MODEL_DISTANCE,
            passed=False,
            failure_reason=words,
        )
    a, b = one.camera_centers()[here], other.camera_centers()[there]
    scale, turn, shift = fit_similarity(b, a)
    path = float(np.linalg.norm(np.diff(a, axis=0), axis=1).sum())
    apart = float(np.sqrt(((scale * b @ turn.T + shift - a) ** 2).sum(axis=1).mean()))
    apart = apart / max(path, 1e-12)
    views = one.camera_from_world[here, :3, :3] @ turn
    angles = _rotation_angles_deg(views, other.camera_from_world[there, :3, :3])
    share = len(common) / max(len(one.frames), len(other.frames))
    passed = (
        apart < MAX_MODEL_DISTANCE
        and angles.max() < MAX_MODEL_ROTATION_DEG
        and share >= MIN_REGISTERED_FRACTION
    )
    return QualityGate(
        name="agreement", value=apart, bound=MAX_MODEL_DISTANCE, passed=bool(passed),
        failure_reason=f"{words} by {100.0 * apart:.1f} % of the path and {angles.max():.1f} "
        "degrees",
    )  # fmt: skip


def fit_similarity(
    source: Float[np.ndarray, "points 3"], target: Float[np.ndarray, "points 3"]
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Scale, rotation and shift that carry points nearest to others (Umeyama 1991, eq. 40-42)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    left, stretch, right = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    turn = left @ np.diag(sign) @ right
    scale = float((stretch * sign).sum() / max((a**2).sum(), 1e-300))
    return scale, turn, target.mean(axis=0) - scale * turn @ source.mean(axis=0)


def _rotation_jumps(model: SparseModel) -> Bool[np.ndarray, "cameras"]:
    """Cameras whose rotation is far off what their neighbours' would be in between."""
    count = len(model.frames)
    jumps = np.zeros(count, dtype=bool)
    if count < 5:
        return jumps
    turns = Rotation.from_matrix(model.camera_from_world[:, :3, :3])
    before, after = turns[:-2], turns[2:]
    shares = (model.frames[1:-1] - model.frames[:-2]) / (model.frames[2:] - model.frames[:-2])
    way = (after * before.inv()).as_rotvec()
    between = Rotation.from_rotvec(shares[:, None] * way) * before
    off = np.degrees((turns[1:-1] * between.inv()).magnitude())
    bound = max(JUMP_DEG, JUMP_SIGMAS * 1.4826 * float(np.median(off)))
    for row in np.argsort(-off):  # a camera that is off drags its neighbours' figures along
        if off[row] > bound and not jumps[row : row + 3].any():
            jumps[row + 1] = True
    return jumps


def _median_angle(model: SparseModel) -> float:
    """The median over points of the widest angle under which two cameras see one, in degrees.

    The widest of the first with all others: at least half of the true one.
    """
    if not len(model.pixels):
        return 0.0
    rays = model.points[model.observation_point] - model.camera_centers()[model.observation_camera]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    first = np.full(len(model.points), -1)
    order = np.arange(len(rays))[::-1]
    first[model.observation_point[order]] = order
    cosine = (rays * rays[first[model.observation_point]]).sum(axis=1)
    least = np.ones(len(model.points))
    np.minimum.at(least, model.observation_point, cosine)
    seen = first >= 0
    return float(np.degrees(np.arccos(np.clip(np.median(least[seen]), -1.0, 1.0))))


def _rotation_angles_deg(
    a: Float[np.ndarray, "cameras 3 3"], b: Float[np.ndarray, "cameras 3 3"]
) -> Float[np.ndarray, "cameras"]:
    """Angles between rotations, in degrees."""
    return np.degrees(Rotation.from_matrix(a @ b.transpose(0, 2, 1)).magnitude())
