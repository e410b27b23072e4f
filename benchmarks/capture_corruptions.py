"""The usual mistakes, made on purpose in a copy of a capture folder.

They are written forwards, in files, and share no code with the corrections that undo them.
"""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import betas_for_motion, load_body_model
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses

Corruption = Callable[[Path], None]
"""Makes one mistake in a capture folder."""
OPENGL = np.diag([1.0, -1.0, -1.0])
"""Rotation between OpenGL's camera axes and OpenCV's."""


@dataclass(frozen=True, kw_only=True)
class CorruptedCapture:
    """A capture to be corrupted, and the causes that ia-check should name."""

    capture: str
    corruptions: tuple[tuple[str, Corruption], ...]

    @property
    def causes(self) -> frozenset[str]:
        """The causes that were made."""
        return frozenset(cause for cause, _ in self.corruptions)

    def write(self, captures: Path, folder: Path) -> Path:
        """Write a corrupted copy; unchanged images and masks are linked."""
        shutil.copytree(captures / self.capture, folder, copy_function=_link)
        for _, corrupt in self.corruptions:
            corrupt(folder)
        return folder


def _link(source: str, target: str) -> None:
    Path(target).hardlink_to(source)


def _change_poses(folder: Path, change: Callable[[Motion], Motion]) -> None:
    path = folder / "poses.npz"
    motion = change(read_poses(path))
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
    translations = (pelvis + motion.root_translations) @ rotation.T + shift - pelvis
    return replace(motion, root_rotations=roots.as_rotvec(), root_translations=translations)


def convert_to_camera_space(folder: Path) -> None:
    """Convert to the camera's own frame, as trackers do: no mistake yet."""
    extrinsic = _extrinsic(folder)
    _change_poses(folder, lambda m: _change_world(m, extrinsic[:3, :3], extrinsic[:3, 3]))
    _change_cameras(folder, extrinsic=np.eye(4))


def delay_poses(frames: int) -> Corruption:
    """Poses whose frame numbers are too large by this many frames."""

    def corrupt(folder: Path) -> None:
        def change(motion: Motion) -> Motion:
            numbers = np.arange(len(motion)) + frames
            return replace(motion, frames=numbers, times_s=None)

        _change_poses(folder, change)

    return corrupt


def drop_first_poses(frames: int) -> Corruption:
    """Poses without the first rows and without frame numbers."""

    def corrupt(folder: Path) -> None:
        _change_poses(folder, lambda m: m.select_rows(np.arange(frames, len(m))))

    return corrupt


def resample_poses(rate: float) -> Corruption:
    """Poses of a copy of the video at a multiple of its frame rate, without frame numbers."""

    def corrupt(folder: Path) -> None:
        _change_poses(
            folder,
            lambda m: m.select_rows(np.arange(0.0, len(m) - 0.5, 1.0 / rate).round().astype(int)),
        )

    return corrupt


def scale_timestamps(factor: float) -> Corruption:
    """Times computed with a wrong frame rate."""

    def corrupt(folder: Path) -> None:
        def change(motion: Motion) -> Motion:
            assert motion.times_s is not None
            return replace(motion, frames=None, times_s=motion.times_s * factor)

        _change_poses(folder, change)

    return corrupt


def use_opengl_poses(folder: Path) -> None:
    """Poses in the space of an OpenGL camera, labelled OpenCV."""
    convert_to_camera_space(folder)
    _change_poses(folder, lambda m: _change_world(m, OPENGL, np.zeros(3)))


def use_opengl_cameras(folder: Path) -> None:
    """nerfstudio's matrix unchanged: world-from-camera, y up, z back."""
    pose = np.linalg.inv(_extrinsic(folder))
    pose[:3, :3] = pose[:3, :3] @ OPENGL
    _change_cameras(folder, extrinsic=pose)


def use_opengl_roots(folder: Path) -> None:
    """Root rotations of an OpenGL camera with translations of an OpenCV one."""
    convert_to_camera_space(folder)
    turned = Rotation.from_matrix(OPENGL)

    def change(m: Motion) -> Motion:
        roots = turned * Rotation.from_rotvec(m.root_rotations)
        return replace(m, root_rotations=roots.as_rotvec())

    _change_poses(folder, change)


def flip_translation_y(folder: Path) -> None:
    """Translations with the wrong sign of y, rotations unchanged."""
    convert_to_camera_space(folder)
    _change_poses(
        folder,
        lambda m: replace(m, root_translations=m.root_translations * np.array([1.0, -1.0, 1.0])),
    )


def rotate_tracker_input(degrees: float) -> Corruption:
    """Poses of a tracker that saw the images rotated."""

    def corrupt(folder: Path) -> None:
        convert_to_camera_space(folder)
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        _change_poses(folder, lambda m: _change_world(m, turn, np.zeros(3)))

    return corrupt


def use_z_up_poses(folder: Path) -> None:
    """Poses in a world with z up (AMASS), cameras in one with y up."""
    turn = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    _change_poses(folder, lambda m: _change_world(m, turn, np.zeros(3)))


def apply_extrinsics_twice(folder: Path) -> None:
    """Poses in the camera's frame with a camera that is not at the origin."""
    extrinsic = _extrinsic(folder)
    _change_poses(folder, lambda m: _change_world(m, extrinsic[:3, :3], extrinsic[:3, 3]))


def invert_extrinsics(folder: Path) -> None:
    """World-from-camera in place of camera-from-world."""
    _change_cameras(folder, extrinsic=np.linalg.inv(_extrinsic(folder)))


def reset_extrinsics(folder: Path) -> None:
    """Poses in the world without the camera's position."""
    _change_cameras(folder, extrinsic=np.eye(4))


def scale_focal(factor: float) -> Corruption:
    """Focal lengths multiplied by a factor."""

    def corrupt(folder: Path) -> None:
        with np.load(folder / "cameras.npz") as archive:
            intrinsic = archive["intrinsic"].copy()
        intrinsic[[0, 1], [0, 1]] *= factor
        _change_cameras(folder, intrinsic=intrinsic)

    return corrupt


def swap_left_right(folder: Path) -> None:
    """Rotations of left and right joints exchanged."""
    _change_poses(
        folder, lambda m: replace(m, joint_rotations=m.joint_rotations[:, SWAPPED_JOINTS])
    )


def mirror_limbs(folder: Path) -> None:
    """Limbs mirrored, the root unchanged."""
    _change_poses(folder, _mirror_motion)


def mirror_tracker_input(folder: Path) -> None:
    """Poses of a tracker that saw a selfie camera's mirrored preview."""
    convert_to_camera_space(folder)

    def change(motion: Motion) -> Motion:
        rotations, signs = motion.root_rotations, np.array([1.0, -1.0, -1.0])
        translations = (_pelvis(motion) + motion.root_translations) * np.array([-1.0, 1.0, 1.0])
        return replace(
            _mirror_motion(motion),
            root_rotations=rotations * signs,
            root_translations=translations - _pelvis(motion),
        )

    _change_poses(folder, change)


SWAPPED_JOINTS = (1, 0, 2, 4, 3, 5, 7, 6, 8, 10, 9, 11, 13, 12, 14, 16, 15, 18, 17, 20, 19, 22, 21)
"""Row of the other side's joint, for joints 1 … 23."""


def _mirror_motion(motion: Motion) -> Motion:
    limbs = motion.joint_rotations[:, SWAPPED_JOINTS] * np.array([1.0, -1.0, -1.0])
    return replace(motion, joint_rotations=limbs)


def root_about_origin(folder: Path) -> None:
    """Translations in EasyMocap's convention: x -> R x + Th."""
    convert_to_camera_space(folder)

    def change(motion: Motion) -> Motion:
        pelvis = _pelvis(motion)
        turned = Rotation.from_rotvec(motion.root_rotations).apply(pelvis)
        return replace(motion, root_translations=pelvis + motion.root_translations - turned)

    _change_poses(folder, change)


def scale_translations(factor: float) -> Corruption:
    """Translations computed for a body of another size."""

    def corrupt(folder: Path) -> None:
        convert_to_camera_space(folder)

        def change(m: Motion) -> Motion:
            pelvis = _pelvis(m)
            return replace(m, root_translations=(pelvis + m.root_translations) * factor - pelvis)

        _change_poses(folder, change)

    return corrupt


def change_units(factor: float) -> Corruption:
    """Translations in millimetres (1000) or centimetres (100)."""

    def corrupt(folder: Path) -> None:
        convert_to_camera_space(folder)
        _change_poses(folder, lambda m: replace(m, root_translations=m.root_translations * factor))

    return corrupt


def use_z_up_poses_without_pelvis(folder: Path) -> None:
    """Poses in a world with z up, converted without the pelvis's offset."""
    turn = Rotation.from_euler("x", 90, degrees=True)

    def change(m: Motion) -> Motion:
        roots = turn * Rotation.from_rotvec(m.root_rotations)
        translations = turn.apply(m.root_translations)
        return replace(m, root_rotations=roots.as_rotvec(), root_translations=translations)

    _change_poses(folder, change)


def keep_last_poses(frames: int) -> Corruption:
    """The last frames' poses only, with no frame numbers and no times."""

    def corrupt(folder: Path) -> None:
        def change(m: Motion) -> Motion:
            last = m.select_rows(np.arange(len(m) - frames, len(m)))
            return replace(last, frames=None, times_s=None)

        _change_poses(folder, change)

    return corrupt


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
    fps, images = reader.get(cv2.CAP_PROP_FPS), []
    while (read := reader.read())[0]:
        images.append(read[1])
    reader.release()
    path.unlink()
    images = change(images)
    code = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, fps, images[0].shape[1::-1])
    for image in images:
        writer.write(np.ascontiguousarray(image))
    writer.release()


def rotate_video(quarter_turns: int) -> Corruption:
    """The video alone rotated counter-clockwise; its images must be square."""
    return lambda folder: rewrite_video(
        folder, lambda images: [np.rot90(p, quarter_turns) for p in images]
    )


def mirror_video(folder: Path) -> None:
    """The video alone mirrored."""
    rewrite_video(folder, lambda images: [image[:, ::-1] for image in images])


def crop_video(left: float, top: float, size: float) -> Corruption:
    """The video alone cropped and scaled to its old size; a size above 1 adds black borders."""

    def crop(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        affine = np.array([[1.0, 0.0, -left * width], [0.0, 1.0, -top * height]]) / size
        return np.asarray(cv2.warpAffine(image, affine, (width, height)))

    return lambda folder: rewrite_video(folder, lambda images: [crop(p) for p in images])


def trim_video(frames: int) -> Corruption:
    """The video without its first frames; masks and poses are those of all frames."""
    return lambda folder: rewrite_video(folder, lambda images: images[frames:])


def delay_video(frames: int) -> Corruption:
    """The video with its first frame repeated and its end cut off."""
    return lambda folder: rewrite_video(
        folder, lambda images: [images[0]] * frames + images[:-frames]
    )


def reverse_video(folder: Path) -> None:
    """The video alone backwards."""
    rewrite_video(folder, lambda images: images[::-1])


def invert_masks(folder: Path) -> None:
    """Masks that are 0 where the person is."""
    for path in sorted((folder / "masks").iterdir()):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert mask is not None
        path.unlink()
        cv2.imwrite(str(path), 255 - mask)
