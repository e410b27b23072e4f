"""Subjects of public data sets: which frames are trained on, and which are scored.

PeopleSnapshot, InstantAvatar's protocol (Jiang et al. 2023, Tab. 1), which follows Anim-NeRF (Chen
et al. 2021): train on frames of one turn for a minute, score whole frames of another turn on white,
in poses fitted to them with the avatar frozen. The data set is available from its authors on
request. Subjects are read in the folders that InstantAvatar's preprocessing writes.

NeuMan: frames of a moving camera. A subject (seattle, citron, parkinglot, bike, jogging, lab) has
images/, COLMAP's sparse/, and segmentations/ (black on the person). Poses are those that HUGS
(Kocabas et al. 2024) published with it: 4d_humans/smpl_optimized_aligned_scale.npz holds SMPL in
the COLMAP world, `scale` units per meter, and 4d_humans/sam_segmentations its masks, which are
preferred. test_split.txt and train_split.txt list names of images; without them the rule by which
NeuMan's code makes them is applied: about every fifth frame is left out of training, and the first
half of those is the test.
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from capture.atomic_files import atomic_folder
from capture.image_folder import list_images, write_png
from capture.input_error import InputError
from instant_avatar.cli.console import Console
from preprocess.cameras.camera_file import CameraTrack, write_cameras
from preprocess.cameras.camera_formats import NamedCamera, find_colmap_model, read_colmap_model
from preprocess.file_content import read_npz
from preprocess.masks.mask_files import Masks, open_masks


@dataclass(frozen=True, kw_only=True)
class SplitFrames:
    """The frames of one split.

    Attributes:
        poses: Pose file; None for the one in the folder.
        frames: Frames of the folder, START:STOP:STEP counted from 0.
    """

    folder: Path
    poses: Path | None = None
    frames: str = "::"


@dataclass(frozen=True, kw_only=True)
class DatasetSubject:
    """A subject of a data set, found in a folder.

    Attributes:
        open_splits: Returns the training and the test frames. Frames that no capture folder holds
            are written below the given folder first, once.
        size_px: Longer side of the images that are compared; None for the original size.
        paper: Scores in a paper, by metric; empty without any.
    """

    name: str
    open_splits: Callable[[Path, Console], tuple[SplitFrames, SplitFrames]]
    size_px: int | None = None
    paper: dict[str, float] = field(default_factory=dict)


def _require_rows(count: int, numbers: Sequence[int], path: Path, what: str) -> None:
    if count <= max(numbers):
        raise InputError(
            f"{path} holds {count} {what}, but the protocol needs that of frame {max(numbers)}; is "
            "it complete?"
        )


SPLITS = {
    "female-3-casual": ("0:446:4", "446:648:4"),
    "female-4-casual": ("0:336:4", "335:524:4"),
    "male-3-casual": ("0:456:4", "456:676:4"),
    "male-4-casual": ("0:660:6", "660:873:6"),
}
"""Training and test frames of the paper's subjects, START:STOP:STEP counted from 0."""
PAPER = {
    "female-3-casual": {"psnr": 27.90, "ssim": 0.9722, "lpips_alex01": 0.0249},
    "female-4-casual": {"psnr": 28.92, "ssim": 0.9692, "lpips_alex01": 0.0180},
    "male-3-casual": {"psnr": 29.65, "ssim": 0.9730, "lpips_alex01": 0.0192},
    "male-4-casual": {"psnr": 27.97, "ssim": 0.9649, "lpips_alex01": 0.0346},
}
"""InstantAvatar's scores after a minute, at 540 px on white, in fitted poses."""
LONGER_SIDE_PX = 540
"""Longer side of the paper's images: half of the video's."""
TRAIN_POSES, TEST_POSES = Path("poses/anim_nerf_train.npz"), Path("poses/anim_nerf_test.npz")
"""Anim-NeRF's poses, one row per listed frame; the capture's own replace missing ones."""


def find_people_snapshot(folder: Path) -> list[DatasetSubject]:
    """Find the paper's subjects in a folder, which may be a subject itself."""
    return [
        DatasetSubject(
            name=name,
            open_splits=partial(_open_prepared, name, place),
            size_px=LONGER_SIDE_PX,
            paper=PAPER[name],
        )
        for name in SPLITS
        for place in (folder / name, folder)
        if place.resolve().name == name and place.is_dir()
    ]


def _open_prepared(
    name: str, place: Path, _into: Path, _console: Console
) -> tuple[SplitFrames, SplitFrames]:
    """Name the frames of a folder that InstantAvatar's preprocessing wrote."""
    if not (place / "images").is_dir():
        raise InputError(
            f"{place} holds no images/. The data set's own files (a video, camera.pkl, HDF5) are "
            "prepared first, by InstantAvatar's preprocess_PeopleSnapshot.py (docs/evaluation.md)."
        )
    files = (place / TRAIN_POSES, place / TEST_POSES)
    train, test = (
        SplitFrames(folder=place, poses=poses if poses.is_file() else None, frames=frames)
        for poses, frames in zip(files, SPLITS[name], strict=True)
    )
    return train, test


POSES = Path("4d_humans/smpl_optimized_aligned_scale.npz")
MASK_FOLDERS = {Path("4d_humans/sam_segmentations"): False, Path("segmentations"): True}
"""Masks in the order of preference, and whether the person is black in them."""
POSE_KEYS = ("global_orient", "body_pose", "transl", "betas", "scale")


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
    step = int(1 / max(1, count // 5) * count)  # about 5, rounded as NeuMan's code does
    left_out = list(range(count))[step // 2 :: step]
    train = sorted(set(range(count)) - set(left_out))
    return train, left_out[: len(left_out) // 2]


def _open_subject(place: Path, into: Path, console: Console) -> tuple[SplitFrames, SplitFrames]:
    """Write the capture folders "train" and "test", in meters; those that exist stay."""
    model = find_colmap_model(place / "sparse")
    if model is None:
        raise InputError(f"{place / 'sparse'} holds no COLMAP model (cameras and images).")
    cameras = read_colmap_model(model)
    splits = _read_splits(place, [Path(each.name or "").name for each in cameras])
    folder = into / place.resolve().name
    for name, rows in splits.items():
        if (folder / name).is_dir():  # written whole or not at all
            continue
        with (
            atomic_folder(folder / name) as part,
            console.progress(f"writing {folder / name}", float(len(rows))) as bar,
        ):
            for done, row in enumerate(_write_frames(place, cameras, part, rows), start=1):
                bar.update(float(done), f"frame {row}")
    return SplitFrames(folder=folder / "train"), SplitFrames(folder=folder / "test")


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
    _require_rows(len(stored["transl"]), rows, place / POSES, "poses")
    scales = np.broadcast_to(stored["scale"].reshape(-1), len(stored["transl"]))
    if not (np.isfinite(scales).all() and scales.min() > 0.0):
        raise InputError(f"`scale` in {place / POSES} is not positive.")
    unit, chosen = float(np.median(scales)), [cameras[row].camera for row in rows]
    centers = np.stack([camera.center_world for camera in chosen])
    tracks = np.stack([camera.camera_from_world for camera in chosen])
    tracks[:, :3, 3] /= unit
    scaled = (replace(each, camera_from_world=t) for each, t in zip(chosen, tracks, strict=True))
    write_cameras(part / "cameras.npz", CameraTrack(cameras=tuple(scaled), source="sparse"))
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
    for made in ("images", "masks"):
        (part / made).mkdir()
    for row in rows:
        name = Path(cameras[row].name or "").name
        if name not in images:
            raise InputError(f"{place / 'images'} lacks {name}, which has a camera in sparse/.")
        shutil.copyfile(images[name], part / "images" / images[name].name)
        alpha = masks.alpha(_mask_row(masks, name, row), cameras[row].camera.size_px)
        write_png(part / "masks" / f"{name}.png", (alpha * 255.0).round().astype(np.uint8))
        yield row


def _mask_row(masks: Masks, name: str, row: int) -> int:
    """Return the row of a frame's mask: by its name, or else in order."""
    names = [Path(each).stem for each in masks.names or ()]  # also 00000.png.npy
    if name in names:
        return names.index(name)
    _require_rows(masks.count, [row], masks.path, "masks")
    return row
