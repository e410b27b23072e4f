"""Cameras of a capture: InstantAvatar's cameras.npz, other programs' files, or none at all."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from capture.camera import Camera, same_aspect_ratio
from capture.image_folder import refuse_pipe
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.body.body_pose import Motion, RelativeFocalLength
from preprocess.cameras.camera_registry import (
    find_multi_view_cameras,
    read_multi_view_camera,
    read_named_cameras,
)
from preprocess.file_content import read_npz
from preprocess.frame_association import cameras_by_frame, interpolate_missing_cameras

DEFAULT_FOCAL_RATIO = 0.85
"""Focal length of a phone's main camera in video, in units of the picture's longer side."""
ASSUMED_CAMERA_SOURCE = f"{DEFAULT_FOCAL_RATIO} x longer side"
"""Origin of a camera, for the report, if neither a file nor the poses state one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraTrack:
    """The cameras of a capture, already of the frames' size.

    Attributes:
        cameras: One for all frames, or one for each in order.
        source: Where they come from, for the report.
        note: What was changed to make them fit, if anything.
        frames_without_camera: Numbers of frames that have no camera and cannot be used.
    """

    cameras: tuple[Camera, ...]
    source: str
    note: str | None = None
    frames_without_camera: frozenset[int] = frozenset()

    @property
    def is_moving(self) -> bool:
        """Whether each frame has a camera of its own."""
        return len(self.cameras) > 1

    def __getitem__(self, frame_index: int) -> Camera:
        """The camera of one frame."""
        return self.cameras[frame_index if self.is_moving else 0]

    def scale_focal(self, factor: float) -> "CameraTrack":
        """The cameras with focal lengths times a factor."""
        scaled = tuple(camera.scale_focal(factor) for camera in self.cameras)
        return replace(self, cameras=scaled)


def resolve_camera_path(path: Path) -> Path:
    """The cameras.npz of a capture folder, where the folder was named; else what was named."""
    own = path / "cameras.npz"
    return own if own.is_file() else path


def read_cameras(
    path: Path, size_px: tuple[int, int], source: FrameSource | None = None
) -> CameraTrack:
    """Reads cameras: an .npz of ours, or what COLMAP, nerfstudio, Record3D or Polycam wrote.

    The .npz holds intrinsic (3, 3), extrinsic (4, 4) camera-from-world, or N of each; optional:
    height and width (of the pictures that the matrices belong to), distortion (OpenCV's
    coefficients), valid (N: whether a frame has a camera of its own). Cameras of another size and
    the same shape are scaled to `size_px`.

    Args:
        path: File or folder.
        size_px: Width and height of the frames.
        source: The frames, whose names or number tell which camera is whose. Without it cameras
            of other programs are taken in order.

    Raises:
        InputError: If there is no such file, or it holds no such cameras, or their pictures had
            another aspect ratio.
    """
    path = resolve_camera_path(path)
    refuse_pipe(path)
    if path.suffix.lower() != ".npz":
        return _read_external(path, size_px, source)
    return _read_npz_cameras(path, size_px)


def _read_npz_cameras(path: Path, size_px: tuple[int, int]) -> CameraTrack:
    arrays = read_npz(path)
    if "intrinsic" not in arrays:
        found = ", ".join(sorted(arrays)) or "nothing"
        raise InputError(f"{path} holds {found}; expected intrinsic, extrinsic, height and width.")
    intrinsics = _read_matrices(arrays, "intrinsic", 3, path)
    if (intrinsics[:, [0, 1], [0, 1]] <= 0.0).any():
        raise InputError(f"`intrinsic` in {path} has no positive focal lengths, in pixels.")
    extrinsics = np.eye(4)[None]
    if "extrinsic" in arrays:
        extrinsics = _require_rigid(_read_matrices(arrays, "extrinsic", 4, path), path)
    count = max(len(intrinsics), len(extrinsics))
    if {len(intrinsics), len(extrinsics)} - {1, count}:
        raise InputError(
            f"{path} holds {len(intrinsics)} intrinsic and {len(extrinsics)} extrinsic matrices; "
            "expected one of each, or one of each per frame."
        )
    stored_px = _read_stored_size(arrays, size_px, path)
    distortion = _read_distortion(arrays, path)
    cameras = tuple(
        Camera.from_intrinsic(
            intrinsics[min(row, len(intrinsics) - 1)],
            stored_px,
            extrinsics[min(row, len(extrinsics) - 1)],
            distortion,
        ).resize(size_px)
        for row in range(count)
    )
    note = None
    if stored_px != size_px:
        note = (
            f"The cameras in {path.name} belong to {stored_px[0]}x{stored_px[1]} px and were "
            f"scaled to the video's {size_px[0]}x{size_px[1]}."
        )
    return CameraTrack(
        cameras=cameras,
        source=path.name,
        note=note,
        frames_without_camera=_read_frames_without_camera(arrays, count, path),
    )


def write_cameras(path: Path, track: CameraTrack) -> None:
    """Writes cameras in the keys that `read_cameras` reads; all have the first one's lens."""
    first, rows = track.cameras[0], range(len(track.cameras))
    extrinsics = np.stack([camera.camera_from_world for camera in track.cameras])
    np.savez(
        path,
        intrinsic=first.intrinsic,
        extrinsic=extrinsics if track.is_moving else extrinsics[0],
        width=first.size_px[0],
        height=first.size_px[1],
        distortion=np.array(first.distortion),
        valid=np.array([row not in track.frames_without_camera for row in rows]),
    )


def _read_external(path: Path, size_px: tuple[int, int], source: FrameSource | None) -> CameraTrack:
    """Cameras of other programs, one for every frame, or one that stands still."""
    rig = find_multi_view_cameras(path)
    if rig is not None:
        camera = read_multi_view_camera(rig, None if source is None else source.path, size_px)
        if not same_aspect_ratio(camera.size_px, size_px):
            raise _aspect_ratio_error(path, camera.size_px, size_px)
        return CameraTrack(cameras=(camera.resize(size_px),), source=rig.name)
    found = read_named_cameras(path, size_px)
    stored = {each.camera.size_px for each in found}
    for size in stored:
        if not same_aspect_ratio(size, size_px):
            raise _aspect_ratio_error(path, size, size_px)
    frames = {number: each.camera for number, each in enumerate(found)}
    if source is not None:
        frames = cameras_by_frame(found, source, path)
    total = len(found) if source is None else source.frames_in_file
    cameras, missing = interpolate_missing_cameras(frames, total)
    notes = []
    if stored != {size_px}:
        sizes = ", ".join(f"{width}x{height}" for width, height in sorted(stored))
        notes.append(
            f"The cameras in {path.name} belong to {sizes} px and were scaled to the video's "
            f"{size_px[0]}x{size_px[1]}."
        )
    between = total - len(frames) - len(missing)
    if between > 0 or missing:
        notes.append(
            f"Of {total} frames {len(frames)} have a camera in {path.name}; {between} were "
            f"interpolated, {len(missing)} are left out."
        )
    return CameraTrack(
        cameras=tuple(camera.resize(size_px) for camera in cameras),
        source=path.name,
        note=" ".join(notes) or None,
        frames_without_camera=missing,
    )


def assume_static_camera(motion: Motion, size_px: tuple[int, int]) -> CameraTrack:
    """One camera at the world's origin: the tracker's K or focal length, else a phone's."""
    intrinsic = tracker_intrinsic_matrix(motion, size_px)
    if intrinsic is not None and (
        motion.assumed_focal is None or motion.assumed_focal.is_plausible
    ):
        camera = Camera.from_intrinsic(intrinsic, size_px)
        if motion.assumed_focal is None:
            return CameraTrack(cameras=(camera,), source="K of the poses")
        note = (
            f"No camera was given; the tracker's focal length of {intrinsic[0, 0]:.0f} px is used."
        )
        return CameraTrack(cameras=(camera,), source="focal length of the tracker", note=note)
    focal = DEFAULT_FOCAL_RATIO * max(size_px)
    camera = Camera.from_intrinsic(
        RelativeFocalLength(ratio=DEFAULT_FOCAL_RATIO).intrinsic_matrix(size_px), size_px
    )
    note = f"No camera was given; a focal length of {focal:.0f} px is assumed."
    if motion.assumed_focal is not None:
        note += (
            f" The tracker's own ({motion.assumed_focal.ratio:.1f} times the "
            f"{motion.assumed_focal.reference}) is no camera's; the person's distance was solved "
            "again."
        )
    return CameraTrack(cameras=(camera,), source=ASSUMED_CAMERA_SOURCE, note=note)


def tracker_intrinsic_matrix(
    motion: Motion, size_px: tuple[int, int]
) -> Float[np.ndarray, "3 3"] | None:
    """The tracker's K for pictures of a size; None if it is not known.

    A K whose principal point is the middle of a larger or smaller picture belongs to such a one.
    """
    if motion.assumed_focal is not None:
        return motion.assumed_focal.intrinsic_matrix(size_px)
    if motion.intrinsic is None or (motion.intrinsic[:2, 2] <= 0.0).any():
        return motion.intrinsic
    scale = np.array(size_px) / (2.0 * motion.intrinsic[:2, 2])
    of_other_size = abs(scale[0] / scale[1] - 1.0) < 0.02 and abs(scale.mean() - 1.0) > 0.05
    return (
        np.diag([scale[0], scale[1], 1.0]) @ motion.intrinsic if of_other_size else motion.intrinsic
    )


def _read_matrices(
    arrays: dict[str, Shaped[np.ndarray, "..."]], key: str, size: int, path: Path
) -> Float[np.ndarray, "cameras rows columns"]:
    """One or many square matrices, with the last row of (3, 4) ones filled in."""
    found = arrays[key]
    if found.dtype.kind not in "iuf" or found.ndim not in (2, 3):
        raise InputError(f"`{key}` in {path} holds no {size}x{size} matrices.")
    matrices = found.astype(np.float64).reshape(-1, *found.shape[-2:])
    if size == 4 and matrices.shape[1:] == (3, 4):
        last = np.broadcast_to([[[0.0, 0.0, 0.0, 1.0]]], (len(matrices), 1, 4))
        matrices = np.concatenate([matrices, last], axis=1)
    if matrices.shape[1:] != (size, size) or not len(matrices) or not np.isfinite(matrices).all():
        raise InputError(
            f"`{key}` in {path} has the shape {found.shape}; expected finite {size}x{size} "
            "matrices, one or one per frame."
        )
    return matrices


def _require_rigid(
    transforms: Float[np.ndarray, "cameras 4 4"], path: Path
) -> Float[np.ndarray, "cameras 4 4"]:
    rotations = transforms[:, :3, :3]
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max()
    if off > 1e-3 or (np.linalg.det(rotations) < 0.0).any():
        raise InputError(
            f"`extrinsic` in {path} is no rigid camera-from-world transform: its rotation is off "
            f"by {off:.2g}. Expected OpenCV axes (x right, y down, z forward) and no scale."
        )
    return transforms


def _read_frames_without_camera(
    arrays: dict[str, Shaped[np.ndarray, "..."]], count: int, path: Path
) -> frozenset[int]:
    """Frames without a camera of their own, if the file says so."""
    if "valid" not in arrays or count == 1:
        return frozenset()
    valid = arrays["valid"].reshape(-1)
    if len(valid) != count or valid.dtype.kind not in "biu":
        raise InputError(f"`valid` in {path} holds {len(valid)} values for {count} cameras.")
    return frozenset(np.flatnonzero(valid == 0).tolist())


def _read_stored_size(
    arrays: dict[str, Shaped[np.ndarray, "..."]], size_px: tuple[int, int], path: Path
) -> tuple[int, int]:
    """Width and height that the matrices belong to; the frames' where the file does not say."""
    if not {"width", "height"} <= arrays.keys():
        return size_px
    try:
        stored = int(arrays["width"].reshape(-1)[0]), int(arrays["height"].reshape(-1)[0])
    except (ValueError, TypeError, IndexError) as cause:
        raise InputError(f"`width` and `height` in {path} are no numbers of pixels.") from cause
    if min(stored) < 1 or not same_aspect_ratio(stored, size_px):
        raise _aspect_ratio_error(path, stored, size_px)
    return stored


def _aspect_ratio_error(
    path: Path, stored: tuple[int, int], size_px: tuple[int, int]
) -> InputError:
    return InputError(
        f"The cameras in {path} belong to pictures of {stored[0]}x{stored[1]} px, the video "
        f"has {size_px[0]}x{size_px[1]}; expected the same shape. If the video was rotated or "
        "cropped, change the cameras with it; if it was stretched, undo that (ffmpeg -vf "
        f"scale={stored[0]}:{stored[1]})."
    )


def _read_distortion(arrays: dict[str, Shaped[np.ndarray, "..."]], path: Path) -> tuple[float, ...]:
    if "distortion" not in arrays:
        return ()
    found = arrays["distortion"].reshape(-1)
    if found.dtype.kind not in "iuf" or len(found) not in (0, 4, 5, 8, 12, 14):
        raise InputError(f"`distortion` in {path}: expected OpenCV's 4, 5, 8, 12 or 14 numbers.")
    return tuple(float(k) for k in found) if found.any() else ()
