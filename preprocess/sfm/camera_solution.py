"""A solution: a camera for every frame, the model that each rests on, and its gates.

Structure from motion can fail silently: a mapper also reports success when repeating texture has
led it to a wrong world with every frame in it. Wrong solutions fail one of the gates below, or
contradict the points that are tracked from frame to frame.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from capture.camera import Camera, Transform


@dataclass(frozen=True, eq=False, kw_only=True)
class SparseModel:
    """The result of structure from motion, in a world of unknown unit.

    Attributes:
        frames: Number of the frame that each camera belongs to, ascending.
        center_px: Principal point; the first pixel's centre is at (0.5, 0.5).
        radial_distortion: First coefficient of radial distortion.
        size_px: Width and height of the images.
        observation_camera, observation_point: Rows of each observation's camera and point.
        pixels: Place of each observation in its image.
        only_turns: Whether all cameras are at the origin; then the points are unit directions.
    """

    frames: Int[np.ndarray, "cameras"]
    camera_from_world: Float[np.ndarray, "cameras 4 4"]
    focal_px: float
    center_px: tuple[float, float]
    radial_distortion: float
    size_px: tuple[int, int]
    points: Float[np.ndarray, "points 3"]
    observation_camera: Int[np.ndarray, "observations"]
    observation_point: Int[np.ndarray, "observations"]
    pixels: Float[np.ndarray, "observations 2"]
    only_turns: bool = False

    def camera(self, camera_from_world: Transform) -> Camera:
        """The lens as a camera with a pose."""
        return Camera(
            focal_px=(self.focal_px, self.focal_px),
            center_px=self.center_px,
            size_px=self.size_px,
            camera_from_world=camera_from_world,
            distortion=(self.radial_distortion, 0.0, 0.0, 0.0) if self.radial_distortion else (),
        )

    def camera_centers(self) -> Float[np.ndarray, "cameras 3"]:
        """Positions of the cameras in the world."""
        turned, moved = self.camera_from_world[:, :3, :3], self.camera_from_world[:, :3, 3]
        return -np.einsum("cba,cb->ca", turned, moved)

    def turn_deg(self) -> float:
        """Largest turn from the first camera to another, degrees."""
        turns = Rotation.from_matrix(self.camera_from_world[:, :3, :3])
        return float(np.degrees((turns * turns[0].inv()).magnitude().max()))

    def reprojection_errors_px(self) -> Float[np.ndarray, "observations"]:
        """Distance of each observation from the projection of its point, pixels."""
        off = np.zeros(len(self.pixels))
        for row, transform in enumerate(self.camera_from_world):
            mine = self.observation_camera == row
            if mine.any():
                drawn = self.camera(transform).project(self.points[self.observation_point[mine]])
                off[mine] = np.linalg.norm(drawn - self.pixels[mine], axis=1)
        return off

    def observations_of_camera(self, row: int) -> Int[np.ndarray, "seen"]:
        """The observations of one camera."""
        return np.flatnonzero(self.observation_camera == row)

    def without_cameras(self, doubtful: Bool[np.ndarray, "cameras"]) -> "SparseModel":
        """The model without some of its cameras and their observations."""
        kept = ~doubtful[self.observation_camera]
        row_of = np.cumsum(~doubtful) - 1
        return replace(
            self,
            frames=self.frames[~doubtful],
            camera_from_world=self.camera_from_world[~doubtful],
            observation_camera=row_of[self.observation_camera[kept]],
            observation_point=self.observation_point[kept],
            pixels=self.pixels[kept],
        )


@dataclass(frozen=True, kw_only=True)
class QualityGate:
    """One figure and its bound; `name` is its key in the report.

    `failure_reason` says what it means if it has not passed.
    """

    name: str
    value: float
    bound: float
    passed: bool
    failure_reason: str

    @classmethod
    def at_least(cls, name: str, value: float, bound: float, failure_reason: str) -> "QualityGate":
        """A figure that passes from its bound on."""
        return cls(
            name=name, value=value, bound=bound, passed=bool(value >= bound),
            failure_reason=failure_reason,
        )  # fmt: skip

    def describe_failure(self) -> str:
        """Say why it has not passed, and by which figure."""
        if not np.isfinite(self.value):
            return self.failure_reason
        return f"{self.failure_reason} ({self.value:.2g}, the bound is {self.bound:.2g})"


MISSING, INTERPOLATED, PLACED, KEY = range(4)
"""Status of a frame: no camera, between its neighbors, placed by known points, or a key frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraSolution:
    """Cameras in a world of unknown scale, or the finding that the camera stood still.

    Attributes:
        background_motion: Largest shift of the background, as a fraction of the image's longer
            side; NaN if it was lost.
        gates: The gates that the solution has passed.
        model: The key frames' cameras and the points; None if the camera stood still.
        camera_from_solved: One for every frame of the file.
        frame_status: MISSING, INTERPOLATED, PLACED or KEY for each of them.
        costs: Wall and core seconds, and the peak of memory in MB.
    """

    is_static: bool
    background_motion: float
    gates: tuple[QualityGate, ...]
    model: SparseModel | None
    camera_from_solved: Float[np.ndarray, "frames 4 4"]
    frame_status: Int[np.ndarray, "frames"]
    keyframe_count: int
    costs: dict[str, float] = field(default_factory=dict)

    def lens(self, size_px: tuple[int, int]) -> Camera:
        """The lens, for images of the frames' size."""
        assert self.model is not None
        return self.model.camera(np.eye(4)).resize(size_px)


MIN_REGISTERED_FRACTION = 0.9
"""Fraction of the key frames that must have a camera."""
MIN_TURN_DEG = 5.0
"""Smallest turn that tells a focal length."""
FOCAL_RANGE = (0.5, 2.0)
"""Plausible focal lengths, as fractions of the image's longer side."""


def find_outlier_cameras(model: SparseModel) -> Bool[np.ndarray, "cameras"]:
    """Cameras that see too few points, or turn unlike their neighbors; better placed otherwise."""
    counts = np.bincount(model.observation_camera, minlength=len(model.frames))
    # with fewer, a camera may rest on a few wrong matches
    few = counts < 0.4 * np.median(counts)
    return few | _rotation_jumps(model)


def evaluate_gates(model: SparseModel, keys: int) -> list[QualityGate]:
    """Evaluate the gates of a model without its doubtful cameras, made from `keys` key frames."""
    registered = len(model.frames) / keys
    residual = float(np.mean(model.reprojection_errors_px())) if len(model.pixels) else np.inf
    focal = model.focal_px / max(model.size_px)
    # a camera that only turns is turned by a hand, which takes it along by centimetres
    largest = 0.0015 * max(model.size_px) if model.only_turns else 0.6  # px
    if model.only_turns:
        turn = model.turn_deg()
        reason = f"the camera turns by {turn:.1f}° only, which tells no focal length"
        depth = QualityGate.at_least("turn_deg", turn, MIN_TURN_DEG, reason)
    else:
        angle = _median_angle(model)
        reason = f"the camera hardly changes its place (points are seen under {angle:.1f}°)"
        depth = QualityGate.at_least("angle_deg", angle, 1.0, reason)
    return [
        QualityGate.at_least(
            "registered", registered, MIN_REGISTERED_FRACTION,
            f"only {len(model.frames)} of {keys} key frames could be placed with certainty",
        ),
        QualityGate.at_least(
            "points", float(len(model.points)), 60.0,
            f"only {len(model.points)} points of the surroundings were found",
        ),
        QualityGate(
            name="reprojection_px", value=residual, bound=largest, passed=residual < largest,
            failure_reason=f"points are seen {residual:.2f} px beside where they should be",
        ),
        QualityGate(
            name="focal", value=focal, bound=FOCAL_RANGE[int(focal > 1.0)],
            passed=FOCAL_RANGE[0] <= focal <= FOCAL_RANGE[1],
            failure_reason=f"the focal length came out as {focal:.2f} times the longer side",
        ),
        depth,
    ]  # fmt: skip


def _rotation_jumps(model: SparseModel) -> Bool[np.ndarray, "cameras"]:
    """Cameras whose rotation is far off the one between their neighbors."""
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
    bound = max(1.0, 6.0 * 1.4826 * float(np.median(off)))  # degrees, and standard deviations
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
