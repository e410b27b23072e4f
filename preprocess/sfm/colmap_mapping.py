"""Structure from motion on key frames: pycolmap's features, matches and mapper.

A key frame is the sharpest image of a stretch of the video. The mapper is the incremental one
(Schönberger & Frahm 2016): between repeating tiles it places few frames, where the global one (Pan
et al. 2024) places all of them wrongly. One thread from the matches on, images registered in order,
and fixed seeds: the same images give the same cameras, bit by bit, however many threads look for
features.

The database is COLMAP's alone while it works: it brings a SQLite of its own, and Python's in the
same process would break its locks (seen: SIGBUS in the write-ahead log).
"""

import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from capture.image_folder import write_png
from capture.input_error import InputError, install_command
from capture.source import Frame, FrameSource, shrink_to_longer_side
from preprocess.sfm.camera_solution import SparseModel

PersonPixels = Bool[np.ndarray, "height width"]
"""Pixels of the person in an image."""

MAX_KEYFRAMES = 60
"""Most key frames of a video."""
MIN_KEYFRAMES = 8
"""Fewest key frames that can be solved."""
PersonMaskFn = Callable[[Frame, tuple[int, int]], PersonPixels | None]
"""Pixels of the person in a frame, in an image of a given size; None if unknown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SfmKeyframe:
    """One image that is solved by features; in `person_mask` are ignored pixels with a margin."""

    index: int
    gray: UInt8[np.ndarray, "height width"]
    person_mask: PersonPixels

    @property
    def name(self) -> str:
        """Name of the image's file."""
        return f"{self.index:06d}.png"


def to_grayscale(frame: Frame, size_px: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
    """A frame's brightness at a size."""
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    if frame.size_px == size_px:
        return grey
    return cv2.resize(grey, size_px, interpolation=cv2.INTER_AREA)


def select_keyframes(
    source: FrameSource,
    person_in: PersonMaskFn,
    report_progress: Callable[[float], None],
    max_keyframes: int = MAX_KEYFRAMES,
) -> Iterator[SfmKeyframe]:
    """The sharpest frame of each of some equal stretches of the video, in order.

    Sharpness is the variance of the image's Laplacian. Frames without an answer from `person_in`
    are skipped; progress is the fraction of the video that was examined.
    """
    total = source.frame_count or source.frames_in_file
    # one of four: frames between are placed as well, in a tenth of the time
    stretches = min(max_keyframes, total, max(24, total // 4))
    size_px = shrink_to_longer_side(source.size_px, 960)
    best: tuple[float, SfmKeyframe] | None = None
    at = 0
    for frame in source.frames():
        place = source.selection.position(frame.index)
        report_progress(min((place + 1) / total, 1.0))
        stretch = min(place * stretches // total, stretches - 1)
        if stretch > at and best is not None:
            yield best[1]
            best = None
        at = max(at, stretch)
        if "corrupt" in frame.flags:
            continue
        grey = to_grayscale(frame, size_px)
        sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        if best is not None and sharpness <= best[0]:
            continue
        person = person_in(frame, size_px)
        if person is not None:
            best = (
                sharpness,
                SfmKeyframe(index=frame.index, gray=grey, person_mask=dilate_person(person)),
            )
    if best is not None:
        yield best[1]


def dilate_person(person: PersonPixels) -> PersonPixels:
    """The person with a margin all round."""
    side = 2 * max(1, round(0.015 * max(person.shape))) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return cv2.dilate(person.astype(np.uint8), disc) > 0


def write_keyframes(keys: Iterator[SfmKeyframe], images: Path, masks: Path) -> list[SfmKeyframe]:
    """Write images and masks (0 where pixels are ignored), named by the frames' numbers."""
    images.mkdir(parents=True)
    masks.mkdir(parents=True)
    kept = []
    for key in keys:
        write_png(images / key.name, key.gray)
        write_png(masks / f"{key.name}.png", np.where(key.person_mask, 0, 255).astype(np.uint8))
        kept.append(key)
    if len(kept) < MIN_KEYFRAMES:
        raise InputError(
            f"Only {len(kept)} frames can be used to solve cameras; at least {MIN_KEYFRAMES} sharp "
            "ones were expected in which the person is known (a mask, or a pose)."
        )
    return kept


STATED_FOCAL_TOLERANCE = 0.02
"""Relative difference to the solved focal length within which the stated one is used."""
ProgressFn = Callable[[float], None]
"""Called now and then with how much of a stage is done, in [0, 1]."""


@dataclass(frozen=True, kw_only=True)
class ColmapWorkspace:
    """Key frames on disk and the database that features and matches go to.

    Masks are 8-bit images, 0 where pixels are ignored; `focal_px` is the focal length, if known.
    """

    images: Path
    masks: Path
    database: Path
    names: tuple[str, ...]
    size_px: tuple[int, int]
    focal_px: float | None
    threads: int


def require_pycolmap() -> None:
    """Raise an InputError if pycolmap is missing."""
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            "--cameras solve needs pycolmap, which is not installed. Install it: "
            f"{install_command('learn')}. Or give the cameras that another program has solved "
            "(docs/formats.md)."
        )


def extract_features(workspace: ColmapWorkspace, report_progress: ProgressFn) -> None:
    """Find SIFT features (Lowe 2004) outside the masked parts."""
    colmap = _colmap()
    width, height = workspace.size_px
    reader, options = colmap.ImageReaderOptions(), colmap.FeatureExtractionOptions()
    reader.mask_path = str(workspace.masks)
    reader.camera_model = "SIMPLE_RADIAL"
    if workspace.focal_px is not None:
        reader.camera_params = f"{workspace.focal_px},{width / 2.0},{height / 2.0},0"
    else:
        reader.default_focal_length_factor = 0.85
    options.num_threads, options.use_gpu = workspace.threads, False
    options.max_image_size = max(width, height)
    options.sift.max_num_features = 2048
    names, step = list(workspace.names), 4 * workspace.threads
    with colmap.Database.open(workspace.database):  # makes it
        pass
    colmap.import_images(
        workspace.database, workspace.images, camera_mode=colmap.CameraMode.SINGLE,
        image_names=names, options=reader,
    )  # fmt: skip
    for first in range(0, len(names), step):
        report_progress(first / len(names))
        colmap.extract_features(
            workspace.database, workspace.images, image_names=names[first : first + step],
            camera_mode=colmap.CameraMode.SINGLE, reader_options=reader,
            extraction_options=options, device=colmap.Device.cpu,
        )  # fmt: skip


def match_features(workspace: ColmapWorkspace, report_progress: ProgressFn) -> None:
    """Match features between images that were taken one soon after the other."""
    colmap = _colmap()
    options = colmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = 1, False
    report_progress(0.0)
    if len(workspace.names) <= 40:  # of every pair, which closes loops
        colmap.match_exhaustive(
            workspace.database, matching_options=options, device=colmap.Device.cpu
        )
        return
    pairing = colmap.SequentialPairingOptions()
    pairing.overlap, pairing.num_threads = 10, 1  # besides powers of two beyond
    colmap.match_sequential(
        workspace.database, matching_options=options, pairing_options=pairing,
        device=colmap.Device.cpu,
    )  # fmt: skip


def parallax_fraction(database: Path) -> tuple[int, float]:
    """Number of matched pairs, and the share that no homography explains: 0 of a mere turn.

    A plane, too, is seen by homographies; neither says where the camera was.
    """
    colmap = _colmap()
    flat = colmap.TwoViewGeometryConfiguration
    with colmap.Database.open(database) as base:
        found = base.read_two_view_geometries()[1]
    kinds = [int(pair.config) for pair in found if len(pair.inlier_matches) >= 15]
    plain = {int(flat.PLANAR), int(flat.PANORAMIC), int(flat.PLANAR_OR_PANORAMIC)}
    return len(kinds), sum(kind not in plain for kind in kinds) / max(len(kinds), 1)


def map_incrementally(
    workspace: ColmapWorkspace, out: Path, seed: int, report_progress: ProgressFn
) -> SparseModel | None:
    """Register one camera after the other; None if it fails."""
    colmap = _colmap()
    options = colmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, seed
    options.min_model_size, options.max_num_models = 3, 2
    # without parallax it would try pairs to start with for minutes
    options.init_num_trials, options.extract_colors = 50, False
    total, done = len(workspace.names), 0

    def next_image() -> None:
        nonlocal done
        done += 1
        report_progress(min(done / total, 1.0))

    report_progress(0.0)
    found = colmap.incremental_mapping(
        workspace.database, workspace.images, out, options=options, next_image_callback=next_image
    )
    return _largest_model(found, workspace.focal_px)


def _colmap() -> Any:
    import pycolmap  # heavy, and only needed here

    pycolmap.logging.minloglevel = 3  # its log would go to stderr
    pycolmap.set_random_seed(0)
    return pycolmap


def _largest_model(models: dict[int, Any], stated_px: float | None) -> SparseModel | None:
    """The model with most cameras as plain arrays; with the stated focal length, if it fits."""
    if not models:
        return None
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
    lens = next(iter(best.cameras.values()))
    if stated_px is not None and abs(lens.params[0] / stated_px - 1.0) < STATED_FOCAL_TOLERANCE:
        _adjust_to_focal(best, stated_px)
    return _to_sparse_model(best)


def _adjust_to_focal(found: Any, focal_px: float) -> None:
    """Move cameras and points until a lens of a known focal length sees all."""
    colmap = _colmap()
    for lens in found.cameras.values():
        lens.params = [focal_px, *lens.params[1:]]
    options, config = colmap.BundleAdjustmentOptions(), colmap.BundleAdjustmentConfig()
    options.refine_focal_length, options.print_summary = False, False
    options.ceres.use_gpu, options.ceres.solver_options.num_threads = False, 1
    for number in found.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # colmap.bundle_adjustment does the same, and writes to stderr whatever the level of its log
    colmap.create_default_bundle_adjuster(options, config, found).solve()


def _to_sparse_model(found: Any) -> SparseModel:
    images = {
        int(Path(found.image(number).name).stem): found.image(number)
        for number in found.reg_image_ids()
    }
    frames = sorted(images)
    ids = sorted(found.points3D)
    row_of = {number: row for row, number in enumerate(ids)}
    seen_by, seen_point, pixels = [], [], []
    for row, frame in enumerate(frames):
        for point in images[frame].get_observation_points2D():
            seen_by.append(row)
            seen_point.append(row_of[point.point3D_id])
            pixels.append(point.xy)
    transforms = np.tile(np.eye(4), (len(frames), 1, 1))
    for row, frame in enumerate(frames):
        transforms[row, :3] = images[frame].cam_from_world().matrix()
    lens = found.camera(images[frames[0]].camera_id)
    focal, x, y, radial = (float(value) for value in lens.params)
    return SparseModel(
        frames=np.array(frames),
        camera_from_world=transforms,
        focal_px=focal,
        center_px=(x, y),
        radial_distortion=radial,
        size_px=(int(lens.width), int(lens.height)),
        points=np.array([found.points3D[number].xyz for number in ids]).reshape(-1, 3),
        observation_camera=np.array(seen_by, dtype=np.int64),
        observation_point=np.array(seen_point, dtype=np.int64),
        pixels=np.array(pixels, dtype=np.float64).reshape(-1, 2),
    )
