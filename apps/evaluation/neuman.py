"""NeuMan protocol: frames of a moving camera, in the splits that its recent users share.

A subject (seattle, citron, parkinglot, bike, jogging, lab) has images/, COLMAP's sparse/, and
segmentations/ (black on the person). Poses are those that HUGS (Kocabas et al. 2024) published with
it: 4d_humans/smpl_optimized_aligned_scale.npz holds SMPL in the COLMAP world, `scale` units per
meter, and 4d_humans/sam_segmentations its masks, which are preferred. test_split.txt and
train_split.txt list names of images; without them the rule by which NeuMan's code makes them is
applied: about every fifth frame is left out of training, and the first half of those is the test.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from apps.cli.console import Console
from apps.evaluation.dataset_subject import (
    DatasetSubject,
    SplitFrames,
    require_rows,
    write_image,
    write_splits,
)
from capture.image_folder import list_images
from capture.input_error import InputError
from preprocess.cameras.camera_file import CameraTrack, write_cameras
from preprocess.cameras.camera_registry import find_colmap_model, read_colmap_model
from preprocess.cameras.named_camera import NamedCamera
from preprocess.file_content import read_npz
from preprocess.masks.mask_files import Masks, open_masks

POSES = Path("4d_humans/smpl_optimized_aligned_scale.npz")
MASK_FOLDERS = {Path("4d_humans/sam_segmentations"): False, Path("segmentations"): True}
"""Masks in the order of preference, and whether the person is black in them."""
POSE_KEYS = ("global_orient", "body_pose", "transl", "betas", "scale")
NOT_TRAINED_EVERY = 5
"""One frame of these is not trained on."""


def find_neuman(folder: Path) -> list[DatasetSubject]:
    """Find subjects in a folder, which may be a subject itself."""
    inside = sorted(folder.iterdir()) if folder.is_dir() else []
    return [
        DatasetSubject(name=place.resolve().name, open_splits=partial(_open_subject, place))
        for place in (folder, *inside)
        if (place / "sparse").is_dir() and (place / POSES).is_file()
    ]


def split_by_rule(count: int) -> tuple[list[int], list[int]]:
    """Return training and test frames of NeuMan's rule; the rest are validation frames."""
    step = int(1 / max(1, count // NOT_TRAINED_EVERY) * count)  # rounded as NeuMan's code does
    left_out = list(range(count))[step // 2 :: step]
    train = sorted(set(range(count)) - set(left_out))
    return train, left_out[: len(left_out) // 2]


def _open_subject(place: Path, into: Path, console: Console) -> tuple[SplitFrames, SplitFrames]:
    """Write both splits with cameras and poses in meters.

    Raises:
        InputError: If a part is missing or does not match the others.
    """
    model = find_colmap_model(place / "sparse")
    if model is None:
        raise InputError(f"{place / 'sparse'} holds no COLMAP model (cameras and images).")
    cameras = read_colmap_model(model)
    splits = _read_splits(place, [Path(each.name or "").name for each in cameras])
    write = partial(_write_frames, place, cameras)
    return write_splits(into / place.resolve().name, splits, write, console)


def _read_splits(place: Path, names: list[str]) -> dict[str, Sequence[int]]:
    """Return the rows of "train" and "test" in the list of all names."""
    files = {split: place / f"{split}_split.txt" for split in ("train", "test")}
    if not all(path.is_file() for path in files.values()):
        splits = dict(zip(files, split_by_rule(len(names)), strict=True))
    else:
        row, splits = {name: k for k, name in enumerate(names)}, {}
        for split, path in files.items():
            listed = [Path(line.strip()).stem for line in path.read_text().splitlines()]
            unknown = [name for name in listed if name and name not in row]
            if unknown:
                raise InputError(f"{path} lists {unknown[0]}, which has no camera in sparse/.")
            splits[split] = [row[name] for name in listed if name]
    if not all(splits.values()):
        raise InputError(f"{place} has {len(names)} frames, too few for a training and a test set.")
    return dict(splits)


def _write_frames(
    place: Path, cameras: list[NamedCamera], part: Path, rows: Sequence[int]
) -> Iterator[int]:
    """Write frames of the camera's order; yield their rows."""
    stored = read_npz(place / POSES, POSE_KEYS)
    missing = [key for key in POSE_KEYS if key not in stored]
    if missing:
        raise InputError(f"{place / POSES} lacks {', '.join(missing)}.")
    require_rows(len(stored["transl"]), rows, place / POSES, "poses")
    scales = np.broadcast_to(stored["scale"].reshape(-1), len(stored["transl"]))
    if not (np.isfinite(scales).all() and scales.min() > 0.0):
        raise InputError(f"`scale` in {place / POSES} is not positive.")
    unit, chosen = float(np.median(scales)), [cameras[row].camera for row in rows]
    centers = np.stack([camera.center_world for camera in chosen])
    tracks = [_in_meters(camera.camera_from_world, unit) for camera in chosen]
    write_cameras(
        part / "cameras.npz",
        CameraTrack(
            cameras=tuple(
                replace(camera, camera_from_world=track)
                for camera, track in zip(chosen, tracks, strict=True)
            ),
            source="sparse",
        ),
    )
    # a person of another scale at another distance: the same image from this frame's camera
    away = (stored["transl"][rows] - centers) / scales[rows][:, None]
    np.savez(
        part / "poses.npz",
        global_orient=stored["global_orient"][rows].reshape(len(rows), 3),
        body_pose=stored["body_pose"][rows].reshape(len(rows), 69),
        transl=centers / unit + away,
        betas=np.median(stored["betas"].reshape(-1, stored["betas"].shape[-1]), axis=0),
    )
    yield from _copy_images(place, cameras, part, rows)


def _copy_images(
    place: Path, cameras: list[NamedCamera], part: Path, rows: Sequence[int]
) -> Iterator[int]:
    images = {path.stem: path for path in list_images(place / "images")}
    folder = next((place / each for each in MASK_FOLDERS if (place / each).is_dir()), None)
    if folder is None:
        raise InputError(f"{place} holds no segmentations/.")
    masks = open_masks(folder, invert=MASK_FOLDERS[folder.relative_to(place)])
    for row in rows:
        name = Path(cameras[row].name or "").name
        if name not in images:
            raise InputError(f"{place / 'images'} lacks {name}, which has a camera in sparse/.")
        shutil.copyfile(images[name], part / "images" / images[name].name)
        alpha = masks.alpha(_mask_row(masks, name, row), cameras[row].camera.size_px)
        write_image(part / "masks" / f"{name}.png", (alpha * 255.0).round().astype(np.uint8))
        yield row


def _mask_row(masks: Masks, name: str, row: int) -> int:
    """Return the row of a frame's mask: by its name, or else in order."""
    names = [Path(each).stem for each in masks.names or ()]  # also 00000.png.npy
    if name in names:
        return names.index(name)
    require_rows(masks.count, [row], masks.path, "masks")
    return row


def _in_meters(
    camera_from_world: Float[np.ndarray, "4 4"], unit: float
) -> Float[np.ndarray, "4 4"]:
    """Return a camera's transform in a world whose unit is the meter."""
    scaled: Shaped[np.ndarray, "4 4"] = camera_from_world.copy()
    scaled[:3, 3] /= unit
    return scaled
