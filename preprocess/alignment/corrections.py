"""A mistake in a capture as the change that undoes it: those with a size, and how it is fitted.

Key points give factors, shifts and windows in closed form.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.camera import Vector3
from preprocess.alignment.capture_geometry import FULL_WINDOW, CaptureGeometry
from preprocess.alignment.keypoint_objective import KeypointObjective

CAUSES = (
    "mask_polarity", "second_person", "world_frame", "opengl_axes", "root_rotation", "frame_offset",
    "frame_rate", "left_right", "root_origin", "focal", "body_scale", "aspect", "video_rotation",
    "video_mirrored", "video_offset", "video_crop",
)  # fmt: skip
"""Names of the mistakes in commands and files; of equal candidates the first cause is named."""
GeometryChange = Callable[[CaptureGeometry], CaptureGeometry]


@dataclass(frozen=True, eq=False, kw_only=True)
class Correction:
    """One mistake, and the change that undoes it.

    Attributes:
        cause: The mistake, one of `CAUSES`.
        description: The mistake for people: ends the sentence "It looks as if …".
        apply: From the geometry as stated to the geometry as it should have been.
        factor: The factor that was fitted (1 of a shift); None of a discrete mistake.
        frame_shift: Number of frames of an offset; None of any other mistake.
    """

    cause: str
    description: str
    apply: GeometryChange
    factor: float | None = None
    frame_shift: int | None = None

    @property
    def is_of_video(self) -> bool:
        """True if the mistake is one of the video alone."""
        return self.cause.startswith("video_")


def undo_pose_delay(frames: int) -> Correction:
    """Poses that come too late (positive) or too early by this many frames."""
    late, other = ("late", "early") if frames > 0 else ("early", "late")
    return Correction(
        cause="frame_offset",
        description=f"the poses come {_frame_count(frames)} too {late} (or the masks too {other})",
        apply=lambda c: replace(c, row_frames=c.row_frames - frames),
        frame_shift=frames,
    )


def undo_video_rotation(quarter_turns: int, *, mirrored: bool = False) -> Correction:
    """A video rotated by counter-clockwise quarter turns, perhaps mirrored, unlike its masks."""

    def apply(geometry: CaptureGeometry) -> CaptureGeometry:
        video = geometry.video_transform
        turns = (video.quarter_turns - quarter_turns) % 4
        return _with_video(geometry, quarter_turns=turns, mirrored=video.mirrored != mirrored)

    degrees = 90 * (quarter_turns % 4)
    if mirrored:
        what = "mirrored" + (f" and rotated by {degrees}°" if degrees else "")
    else:
        direction = {90: " counter-clockwise", 270: " clockwise"}.get(degrees, "")
        what = f"rotated by {min(degrees, 360 - degrees)}°{direction}"
    return Correction(
        cause="video_mirrored" if mirrored else "video_rotation",
        description=f"the video alone is {what}; its masks and poses belong to images that are not",
        apply=apply,
    )


def undo_video_offset(frames: int) -> Correction:
    """A video whose frame 0 has the masks and poses of frame number `frames`."""
    when = "later" if frames > 0 else "earlier"
    question = "; was its beginning cut off?" if frames > 0 else ""
    return Correction(
        cause="video_offset",
        description=f"the video starts {_frame_count(frames)} {when} than its masks and poses"
        f"{question}",
        apply=lambda c: _with_video(c, first_frame=c.video_transform.first_frame + frames),
        frame_shift=frames,
    )


def undo_video_crop(window: tuple[float, float, float, float]) -> Correction:
    """A video that shows only a part of the masks' image, or has borders added around it.

    `window` is left, top, right and bottom of the video's image in the mask's, as fractions.
    """
    left, top, right, bottom = window
    inside = right - left < 1.0 and bottom - top < 1.0
    kind = "was cropped" if inside else "has borders, or was scaled down"
    return Correction(
        cause="video_crop",
        description=f"the video {kind} after its masks and poses were made: it shows {left:.0%} to "
        f"{right:.0%} of their width and {top:.0%} to {bottom:.0%} of their height",
        apply=lambda c: _with_video(c, window=window),
        factor=right - left,
    )


def scale_focal_length(factor: float) -> Correction:
    """Focal lengths that are too short (factor above 1) or too long."""
    wrong = "short" if factor > 1.0 else "long"
    return Correction(
        cause="focal",
        description=f"the focal length is too {wrong}; {factor:.3f} times fits",
        apply=lambda c: _with_intrinsics(c, focal_scale=factor),
        factor=factor,
    )


def stretch_width(factor: float) -> Correction:
    """Images that are stretched in width (factor above 1) or in height, unlike the camera."""
    wrong = "width" if factor > 1.0 else "height"
    return Correction(
        cause="aspect",
        description=f"the images are stretched in {wrong}, {max(factor, 1.0 / factor):.2f} times; "
        "was the video converted to another shape?",
        apply=lambda c: _with_intrinsics(c, focal_scale=np.array([factor, 1.0])),
        factor=factor,
    )


def shift_principal_point(right_px: float, down_px: float) -> Correction:
    """Principal points too far left and up by these pixels (negative: right and down)."""
    sides = {
        f"{abs(right_px):.0f} px too far {'left' if right_px > 0.0 else 'right'}": right_px,
        f"{abs(down_px):.0f} px too far {'up' if down_px > 0.0 else 'down'}": down_px,
    }
    where = " and ".join(side for side, px in sides.items() if abs(px) >= 1.0) or "elsewhere"
    return Correction(
        cause="focal",
        description=f"the principal point is {where}; was the video cropped after its poses or its "
        "camera were made?",
        apply=lambda c: _with_intrinsics(c, shift_px=(right_px, down_px)),
        factor=1.0,
    )


def divide_distances(factor: float, pelvis: Vector3) -> Correction:
    """A person who is too small (factor above 1) or too large for where the poses put them.

    Images show only the ratio of size and distance, and the size is the body's own: distances are
    divided by the factor. With one camera, or cameras in one place, they shrink towards it; else
    the whole world shrinks towards its origin, cameras included.
    """

    def apply(geometry: CaptureGeometry) -> CaptureGeometry:
        centers = geometry.camera_centers()
        is_static = np.ptp(centers, axis=0).max() < 1e-3
        fixed = centers.mean(axis=0) if is_static else np.zeros(3)
        pelves = pelvis + geometry.motion.root_translations
        moved = fixed + (pelves - fixed) / factor
        extrinsics = geometry.extrinsics.copy()
        rotations = extrinsics[:, :3, :3]
        shrunk = fixed + (centers - fixed) / factor
        extrinsics[:, :3, 3] = -np.einsum("cab,cb->ca", rotations, shrunk)
        motion = replace(geometry.motion, root_translations=moved - pelvis)
        return replace(geometry, motion=motion, extrinsics=extrinsics)

    wrong = "small" if factor > 1.0 else "large"
    words = f"the body is too {wrong} for its distance; {factor:.3f} times its size fits"
    return Correction(cause="body_scale", description=words, apply=apply, factor=factor)


def _frame_count(frames: int) -> str:
    return f"{abs(frames)} frame{'s' if abs(frames) > 1 else ''}"


def _with_video(geometry: CaptureGeometry, **changes: Any) -> CaptureGeometry:
    return replace(geometry, video_transform=replace(geometry.video_transform, **changes))


def _with_intrinsics(
    geometry: CaptureGeometry,
    *,
    focal_scale: float | Float[np.ndarray, "2"] = 1.0,
    shift_px: tuple[float, float] = (0.0, 0.0),
) -> CaptureGeometry:
    """The geometry with all focal lengths multiplied and all principal points shifted."""
    intrinsics = geometry.intrinsics.copy()
    intrinsics[:, [0, 1], [0, 1]] *= focal_scale
    intrinsics[:, :2, 2] += np.array(shift_px)
    return replace(geometry, intrinsics=intrinsics)


def fit_to_keypoints(
    geometry: CaptureGeometry, objective: KeypointObjective
) -> Iterator[Correction]:
    """The best focal length, principal point, size, aspect and window, each fitted alone."""
    bodies, found = objective.bodies(geometry), objective.found_px(geometry)
    if found is None:
        return
    from_center = bodies.pixels - bodies.center_px
    wanted = found - bodies.center_px
    only_x = from_center * (1.0, np.nan)
    factors = [(scale_focal_length, from_center, wanted), (stretch_width, only_x, wanted)]
    pelvis = bodies.to_cameras(bodies.pelvis_m)
    rays, limbs = wanted / bodies.focal_px, bodies.in_camera_m - pelvis
    # The ray of a key point at distance k times the pelvis's: x (k P_z + l_z) = k P_x + l_x.
    distance = rays * pelvis[..., 2:] - pelvis[..., :2], limbs[..., :2] - rays * limbs[..., 2:]
    rest = objective.shaped.joints[0]
    factors.append((lambda k: divide_distances(1.0 / k, rest), *distance))
    for make, design, target in factors:
        factor = float(objective.fit(bodies, design[..., None], target)[0])
        if factor > 0.0:
            yield make(factor)
    design = np.broadcast_to(np.eye(2), (*found.shape, 2))
    right, down = objective.fit(bodies, design, found - bodies.pixels).tolist()
    if (np.abs([right, down]) < 0.45 * np.array(geometry.size_px)).all():
        yield shift_principal_point(right, down)
    if geometry.video_transform.window == FULL_WINDOW:
        inside = (found / geometry.size_px)[..., None]
        axes = np.eye(2)
        design = np.concatenate([(1.0 - inside) * axes, inside * axes], axis=-1)
        sides = objective.fit(bodies, design, bodies.pixels / geometry.size_px)
        if (np.abs(np.log(np.maximum(sides[2:] - sides[:2], 1e-9))) < 0.7).all():
            left, top, right, bottom = sides.tolist()
            yield undo_video_crop((left, top, right, bottom))
