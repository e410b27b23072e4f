"""The usual mistakes, made on purpose in a copy of a capture folder.

They are written forwards, in files, and share no code with the doctor, which undoes them.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from preprocess.body.body_file import load_body_model
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import betas_for_motion
from preprocess.poses.pose_file import read_motion, write_motion

Corruption = Callable[[Path], None]
"""Makes one mistake in a capture folder."""
OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, kw_only=True)
class CorruptedCapture:
    """A capture folder to be spoilt, and what the doctor should say of it."""

    capture: str
    corruptions: tuple[tuple[str, Corruption], ...]

    @property
    def causes(self) -> frozenset[str]:
        return frozenset(cause for cause, _ in self.corruptions)

    def write(self, captures: Path, folder: Path) -> Path:
        """A spoilt copy; pictures and masks are linked where they stay as they are."""
        shutil.copytree(captures / self.capture, folder, copy_function=_link)
        for _, spoil in self.corruptions:
            spoil(folder)
        return folder


def _link(source: str, target: str) -> None:
    Path(target).hardlink_to(source)


def _change_poses(folder: Path, change: Callable[[Motion], Motion]) -> None:
    path = folder / "poses.npz"
    motion = change(read_motion(path))
    path.unlink()
    write_motion(path, motion)


def _change_cameras(folder: Path, **changed: Any) -> None:
    path = folder / "cameras.npz"
    with np.load(path) as archive:
        arrays: dict[str, Any] = {key: archive[key] for key in archive.files}
    path.unlink()
    np.savez(path, **{**arrays, **changed})


def _extrinsic(folder: Path) -> np.ndarray:
    with np.load(folder / "cameras.npz") as archive:
        return archive["extrinsic"]


def _pelvis(motion: Motion) -> np.ndarray:
    body = load_body_model()
    return body.with_shape(betas_for_motion(body, motion)).joints[0]


def _change_world(motion: Motion, rotation: np.ndarray, shift: np.ndarray) -> Motion:
    """The motion in another world, x' = R x + b."""
    pelvis = _pelvis(motion)
    roots = Rotation.from_matrix(rotation) * Rotation.from_rotvec(motion.root_rotations)
    places = (pelvis + motion.root_translations) @ rotation.T + shift - pelvis
    return replace(motion, root_rotations=roots.as_rotvec(), root_translations=places)


def convert_to_camera_space(folder: Path) -> None:
    """No mistake yet: the same capture, told in the camera's own frame, as trackers do."""
    extrinsic = _extrinsic(folder)
    _change_poses(folder, lambda m: _change_world(m, extrinsic[:3, :3], extrinsic[:3, 3]))
    _change_cameras(folder, extrinsic=np.eye(4))


def delay_poses(frames: int) -> Corruption:
    def spoil(folder: Path) -> None:
        def change(motion: Motion) -> Motion:
            numbers = np.arange(len(motion)) + frames
            return replace(motion, frames=numbers, times_s=None)

        _change_poses(folder, change)

    return spoil


def drop_first_poses(frames: int) -> Corruption:
    """The first rows are missing, and nothing tells the frames' numbers."""

    def spoil(folder: Path) -> None:
        _change_poses(folder, lambda m: m.select_rows(np.arange(frames, len(m))))

    return spoil


def resample_poses(rate: float) -> Corruption:
    """Poses of a copy of the video at a multiple of its frame rate, without frame numbers."""

    def spoil(folder: Path) -> None:
        _change_poses(
            folder,
            lambda m: m.select_rows(np.arange(0.0, len(m) - 0.5, 1.0 / rate).round().astype(int)),
        )

    return spoil


def scale_timestamps(factor: float) -> Corruption:
    """Times reckoned with a wrong frame rate."""

    def spoil(folder: Path) -> None:
        def change(motion: Motion) -> Motion:
            assert motion.times_s is not None
            return replace(motion, frames=None, times_s=motion.times_s * factor)

        _change_poses(folder, change)

    return spoil


def use_opengl_poses(folder: Path) -> None:
    """Poses in the space of an OpenGL camera, and no word of it."""
    convert_to_camera_space(folder)
    _change_poses(folder, lambda m: _change_world(m, OPENGL, np.zeros(3)))


def use_opengl_cameras(folder: Path) -> None:
    """nerfstudio's matrix as it stands there: world-from-camera, y up, z back."""
    pose = np.linalg.inv(_extrinsic(folder))
    pose[:3, :3] = pose[:3, :3] @ OPENGL
    _change_cameras(folder, extrinsic=pose)


def use_opengl_roots(folder: Path) -> None:
    """Root rotations of an OpenGL camera beside places of an OpenCV one."""
    convert_to_camera_space(folder)
    turned = Rotation.from_matrix(OPENGL)

    def change(m: Motion) -> Motion:
        roots = turned * Rotation.from_rotvec(m.root_rotations)
        return replace(m, root_rotations=roots.as_rotvec())

    _change_poses(folder, change)


def flip_translation_y(folder: Path) -> None:
    """The places' y with the wrong sign, the rotations as they should be."""
    convert_to_camera_space(folder)
    _change_poses(
        folder,
        lambda m: replace(m, root_translations=m.root_translations * np.array([1.0, -1.0, 1.0])),
    )


def rotate_tracker_input(degrees: float) -> Corruption:
    """The tracker saw the pictures turned."""

    def spoil(folder: Path) -> None:
        convert_to_camera_space(folder)
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        _change_poses(folder, lambda m: _change_world(m, turn, np.zeros(3)))

    return spoil


def use_z_up_poses(folder: Path) -> None:
    """Poses in a world with z up (AMASS), cameras in one with y up."""
    turn = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    _change_poses(folder, lambda m: _change_world(m, turn, np.zeros(3)))


def apply_extrinsics_twice(folder: Path) -> None:
    """Poses in the camera's frame beside a camera that stands somewhere."""
    extrinsic = _extrinsic(folder)
    _change_poses(folder, lambda m: _change_world(m, extrinsic[:3, :3], extrinsic[:3, 3]))


def invert_extrinsics(folder: Path) -> None:
    _change_cameras(folder, extrinsic=np.linalg.inv(_extrinsic(folder)))


def reset_extrinsics(folder: Path) -> None:
    """Poses in the world, and nothing says where the camera stood."""
    _change_cameras(folder, extrinsic=np.eye(4))


def scale_focal(factor: float) -> Corruption:
    def spoil(folder: Path) -> None:
        with np.load(folder / "cameras.npz") as archive:
            intrinsic = archive["intrinsic"].copy()
        intrinsic[[0, 1], [0, 1]] *= factor
        _change_cameras(folder, intrinsic=intrinsic)

    return spoil


def swap_left_right(folder: Path) -> None:
    """Left joints' rotations under the right ones' numbers."""
    _change_poses(
        folder, lambda m: replace(m, joint_rotations=m.joint_rotations[:, SWAPPED_JOINTS])
    )


def mirror_limbs(folder: Path) -> None:
    _change_poses(folder, _mirror_motion)


def mirror_tracker_input(folder: Path) -> None:
    """The tracker saw a selfie camera's preview."""
    convert_to_camera_space(folder)

    def change(motion: Motion) -> Motion:
        rotations, signs = motion.root_rotations, np.array([1.0, -1.0, -1.0])
        places = (_pelvis(motion) + motion.root_translations) * np.array([-1.0, 1.0, 1.0])
        return replace(
            _mirror_motion(motion),
            root_rotations=rotations * signs,
            root_translations=places - _pelvis(motion),
        )

    _change_poses(folder, change)


SWAPPED_JOINTS = (1, 0, 2, 4, 3, 5, 7, 6, 8, 10, 9, 11, 13, 12, 14, 16, 15, 18, 17, 20, 19, 22, 21)
"""Row of the other side's joint, for joints 1 … 23."""


def _mirror_motion(motion: Motion) -> Motion:
    limbs = motion.joint_rotations[:, SWAPPED_JOINTS] * np.array([1.0, -1.0, -1.0])
    return replace(motion, joint_rotations=limbs)


def root_about_origin(folder: Path) -> None:
    """EasyMocap's convention: x -> R x + Th."""
    convert_to_camera_space(folder)

    def change(motion: Motion) -> Motion:
        pelvis = _pelvis(motion)
        turned = Rotation.from_rotvec(motion.root_rotations).apply(pelvis)
        return replace(motion, root_translations=pelvis + motion.root_translations - turned)

    _change_poses(folder, change)


def scale_translations(factor: float) -> Corruption:
    """Places that a tracker reckoned for a body of another size."""

    def spoil(folder: Path) -> None:
        convert_to_camera_space(folder)

        def change(m: Motion) -> Motion:
            pelvis = _pelvis(m)
            return replace(m, root_translations=(pelvis + m.root_translations) * factor - pelvis)

        _change_poses(folder, change)

    return spoil


def change_units(factor: float) -> Corruption:
    """Places in millimetres (1000) or centimetres (100)."""

    def spoil(folder: Path) -> None:
        convert_to_camera_space(folder)
        _change_poses(folder, lambda m: replace(m, root_translations=m.root_translations * factor))

    return spoil


def use_z_up_poses_without_pelvis(folder: Path) -> None:
    """As `use_z_up_poses`, converted without the pelvis's offset: translations are rotated by themselves."""
    turn = Rotation.from_euler("x", 90, degrees=True)

    def change(m: Motion) -> Motion:
        roots = turn * Rotation.from_rotvec(m.root_rotations)
        places = turn.apply(m.root_translations)
        return replace(m, root_rotations=roots.as_rotvec(), root_translations=places)

    _change_poses(folder, change)


def keep_last_poses(frames: int) -> Corruption:
    """The last frames' poses only, with no frame numbers and no times."""

    def spoil(folder: Path) -> None:
        def change(m: Motion) -> Motion:
            last = m.select_rows(np.arange(len(m) - frames, len(m)))
            return replace(last, frames=None, times_s=None)

        _change_poses(folder, change)

    return spoil


def add_second_person(folder: Path) -> None:
    """Add a second person at the left side of every mask."""
    for path in sorted((folder / "masks").iterdir()):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert mask is not None
        path.unlink()
        height, width = mask.shape[:2]
        mask[height // 4 : -height // 8, width // 40 : width // 10] = 255
        cv2.imwrite(str(path), mask)


def rewrite_video(folder: Path, change: Callable[[list[np.ndarray]], list[np.ndarray]]) -> None:
    """Rewrite the video's images losslessly; masks and poses stay."""
    path = folder / "video.mp4"
    reader = cv2.VideoCapture(str(path))
    fps, pictures = reader.get(cv2.CAP_PROP_FPS), []
    while (read := reader.read())[0]:
        pictures.append(read[1])
    reader.release()
    path.unlink()
    pictures = change(pictures)
    code = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, pictures[0].shape[1::-1])
    for picture in pictures:
        writer.write(np.ascontiguousarray(picture))
    writer.release()


def rotate_video(quarter_turns: int) -> Corruption:
    """The film alone rotated counter-clockwise; its pictures must be square."""
    return lambda folder: rewrite_video(
        folder, lambda film: [np.rot90(p, quarter_turns) for p in film]
    )


def mirror_video(folder: Path) -> None:
    rewrite_video(folder, lambda pictures: [picture[:, ::-1] for picture in pictures])


def crop_video(left: float, top: float, size: float) -> Corruption:
    """A part of the film alone, scaled up to the old size; a size above 1 adds black borders."""

    def crop(picture: np.ndarray) -> np.ndarray:
        height, width = picture.shape[:2]
        affine = np.array([[1.0, 0.0, -left * width], [0.0, 1.0, -top * height]]) / size
        return np.asarray(cv2.warpAffine(picture, affine, (width, height)))

    return lambda folder: rewrite_video(folder, lambda pictures: [crop(p) for p in pictures])


def trim_video(frames: int) -> Corruption:
    """The film's beginning is cut off; masks and poses are still those of all frames."""
    return lambda folder: rewrite_video(folder, lambda pictures: pictures[frames:])


def delay_video(frames: int) -> Corruption:
    """The film's first picture stands still at first, and the end is cut off."""
    return lambda folder: rewrite_video(folder, lambda film: [film[0]] * frames + film[:-frames])


def reverse_video(folder: Path) -> None:
    rewrite_video(folder, lambda pictures: pictures[::-1])


def invert_masks(folder: Path) -> None:
    for path in sorted((folder / "masks").iterdir()):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert mask is not None
        path.unlink()
        cv2.imwrite(str(path), 255 - mask)
