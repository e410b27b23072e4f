"""Cameras of a capture: InstantAvatar's cameras.npz, other programs' files, or none at all."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture.camera import Camera, Matrix3, same_aspect_ratio
from capture.image_folder import refuse_pipe
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.body.body_pose import Motion, RelativeFocalLength
from preprocess.cameras.camera_formats import (
    checked_camera,
    checked_rigid,
    find_multi_view_cameras,
    read_multi_view_camera,
    read_named_cameras,
)
from preprocess.capture_inputs import find_cameras
from preprocess.file_content import explain_damage, read_npz
from preprocess.frame_association import cameras_by_frame, interpolate_missing_cameras

DEFAULT_FOCAL_RATIO = 0.85
"""Focal length of a phone's main camera in video, in units of the image's longer side."""
ASSUMED_CAMERA_SOURCE = f"{DEFAULT_FOCAL_RATIO} x longer side"
"""Origin of a camera, for the report, if neither a file nor the poses state one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraTrack:
    """The cameras of a capture, already of the frames' size.

    There is one for all frames, or one for each in order; frames without one cannot be used. The
    report says their origin (`source`) and the changes that made them fit (`note`).
    """

    cameras: tuple[Camera, ...]
    source: str
    note: str | None = None
    frames_without_camera: frozenset[int] = frozenset()

    @property
    def is_moving(self) -> bool:
        """Return whether each frame has a camera of its own."""
        return len(self.cameras) > 1

    def __getitem__(self, frame_index: int) -> Camera:
        """The camera of one frame."""
        return self.cameras[frame_index if self.is_moving else 0]

    def scale_focal(self, factor: float) -> "CameraTrack":
        """The cameras with focal lengths times a factor."""
        scaled = tuple(camera.scale_focal(factor) for camera in self.cameras)
        return replace(self, cameras=scaled)


def read_cameras(
    path: Path, size_px: tuple[int, int] | None, source: FrameSource | None = None
) -> CameraTrack:
    """Read cameras: an .npz of ours, or a file of another program (`camera_registry`).

    Of a capture folder, its cameras.npz is read.

    The .npz holds intrinsic (3, 3), extrinsic (4, 4) camera-from-world, or N of each; optional:
    height and width (of the images that the matrices belong to), distortion (OpenCV's
    coefficients), valid (N: whether a frame has a camera of its own). Cameras of another size and
    the same shape are scaled to `size_px`.

    Without the frames' size that of the file's own images counts; without `source`, whose names or
    number tell which camera is whose, cameras of other programs are taken in order.
    """
    own = path / "cameras.npz"
    path = own if own.is_file() else path
    refuse_pipe(path)
    if path.suffix.lower() == ".npz":
        return _read_npz_cameras(path, size_px)
    return _read_external(path, size_px, source)


def _read_npz_cameras(path: Path, size_px: tuple[int, int] | None) -> CameraTrack:
    arrays = read_npz(path)
    with explain_damage(path, "an .npz of intrinsic, extrinsic, height and width"):
        if arrays["intrinsic"].shape[-2:] != (3, 3):
            raise ValueError(f"`intrinsic` has the shape {arrays['intrinsic'].shape}, not (3, 3)")
        intrinsics = arrays["intrinsic"].astype(np.float64).reshape(-1, 3, 3)
        extrinsics = checked_rigid(arrays.get("extrinsic", np.eye(4))).reshape(-1, 4, 4)
        count = max(len(intrinsics), len(extrinsics))
        stored_px = size_px or (2.0 * intrinsics[0, 0, 2], 2.0 * intrinsics[0, 1, 2])
        if "width" in arrays and "height" in arrays:
            stored_px = tuple(float(arrays[side].reshape(-1)[0]) for side in ("width", "height"))
        distortion = np.array(arrays.get("distortion", ()), dtype=np.float64).reshape(-1)
        if len(distortion) not in (0, 4, 5, 8, 12, 14):
            raise ValueError("`distortion` is not OpenCV's 4, 5, 8, 12 or 14 numbers")
        cameras = tuple(
            checked_camera(k[[0, 1], [0, 1]], k[:2, 2], stored_px, view, distortion)
            for k, view in zip(
                np.broadcast_to(intrinsics, (count, 3, 3)),
                np.broadcast_to(extrinsics, (count, 4, 4)),
                strict=True,
            )
        )
        missing = np.zeros(count, dtype=bool)
        if "valid" in arrays and count > 1:
            missing[:] = arrays["valid"].reshape(-1) == 0
    return _fit_to_frames(cameras, path, size_px, frozenset(np.flatnonzero(missing).tolist()))


def write_cameras(path: Path, track: CameraTrack) -> None:
    """Write cameras in the keys that `read_cameras` reads; all have the first one's lens."""
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


def _read_external(
    path: Path, size_px: tuple[int, int] | None, source: FrameSource | None
) -> CameraTrack:
    """Cameras of other programs, one for every frame, or one that stands still."""
    rig = find_multi_view_cameras(path)
    if rig is not None:
        camera = read_multi_view_camera(rig, None if source is None else source.path, size_px)
        return _fit_to_frames((camera,), rig, size_px)
    named = read_named_cameras(path, size_px)
    frames = {number: each.camera for number, each in enumerate(named)}
    if source is not None:
        frames = cameras_by_frame(named, source, path)
    total = len(named) if source is None else source.frames_in_file
    cameras, missing = interpolate_missing_cameras(frames, total)
    track = _fit_to_frames(cameras, path, size_px, missing)
    between = total - len(frames) - len(missing)
    if between <= 0 and not missing:
        return track
    note = (
        f"Of {total} frames {len(frames)} have a camera in {path.name}; {between} were "
        f"interpolated, {len(missing)} are left out."
    )
    return replace(track, note=note if track.note is None else f"{track.note} {note}")


def _fit_to_frames(
    cameras: tuple[Camera, ...],
    path: Path,
    size_px: tuple[int, int] | None,
    missing: frozenset[int] = frozenset(),
) -> CameraTrack:
    """Scale cameras, each of its own image's size, to the frames' size.

    `size_px` None leaves them as they are; `missing` are frames without a camera.
    """
    note = None
    for stored in sorted({camera.size_px for camera in cameras}):
        if size_px is not None and not same_aspect_ratio(stored, size_px):
            raise InputError(
                f"The cameras in {path} belong to images of {stored[0]}x{stored[1]} px, the video "
                f"has {size_px[0]}x{size_px[1]}; expected the same shape, upright. If the "
                "video was rotated (also by its rotation flag) or cropped, change the cameras with "
                f"it; if it was stretched, undo that (ffmpeg -vf scale={stored[0]}:{stored[1]})."
            )
        if size_px is not None and stored != size_px:
            note = (
                f"The cameras in {path.name} belong to {stored[0]}x{stored[1]} px and were scaled "
                f"to the video's {size_px[0]}x{size_px[1]}."
            )
    if size_px is not None:
        cameras = tuple(camera.resize(size_px) for camera in cameras)
    return CameraTrack(cameras=cameras, source=path.name, note=note, frames_without_camera=missing)


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
    camera = _phone_camera(size_px)
    note = f"No camera was given; a focal length of {camera.focal_px[0]:.0f} px is assumed."
    if motion.assumed_focal is not None:
        note += (
            f" The tracker's own ({motion.assumed_focal.ratio:.1f} times the "
            f"{motion.assumed_focal.reference}) is no camera's; the person's distance was solved "
            "again."
        )
    return CameraTrack(cameras=(camera,), source=ASSUMED_CAMERA_SOURCE, note=note)


def _phone_camera(size_px: tuple[int, int]) -> Camera:
    phone = RelativeFocalLength(ratio=DEFAULT_FOCAL_RATIO)
    return Camera.from_intrinsic(phone.intrinsic_matrix(size_px), size_px)


def assume_camera(video: Path, named: str | None, source: FrameSource) -> Camera:
    """A camera at the origin: the first one of a file, or a phone's where there is none.

    `named` is the value of --cameras; without it cameras are looked for beside the video (see
    `find_cameras`).
    """
    path = find_cameras(video, named)
    if path is None:
        return _phone_camera(source.size_px)
    cameras = read_cameras(path, source.size_px, None if source.live else source)
    return replace(cameras[0], camera_from_world=np.eye(4))


def tracker_intrinsic_matrix(motion: Motion, size_px: tuple[int, int]) -> Matrix3 | None:
    """The tracker's K for images of a size; None if it is not known.

    A K whose principal point is the middle of a larger or smaller image belongs to such a one.
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
