"""Solves a capture's cameras, stage after stage, and refuses what it cannot vouch for.

Key frames, features, matches, the global mapping, the incremental one as a second opinion, then
the frames in between. Two mappings that agree, and points followed from key frame to key frame
that land where the next camera sees them: less is not believed. Finished stages are not repeated.
"""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from capture.atomic_files import write_text_atomically
from capture.input_error import InputError
from capture.process_metrics import peak_memory_mb
from capture.source import FrameSource
from preprocess.frame_association import interpolate_missing_cameras
from preprocess.sfm import colmap_mapping
from preprocess.sfm.camera_solution import (
    INTERPOLATED,
    KEY,
    MIN_REGISTERED_FRACTION,
    MISSING,
    PLACED,
    CameraSolution,
    QualityGate,
    SparseModel,
    compare_models,
    evaluate_gates,
    find_outlier_cameras,
)
from preprocess.sfm.colmap_mapping import (
    MAX_KEYFRAMES,
    ColmapWorkspace,
    PersonMaskFn,
    SfmKeyframe,
    read_keyframes,
    select_keyframes,
    write_keyframes,
)
from preprocess.sfm.point_tracking import (
    ResectionResult,
    StaticCameraTest,
    detect_static_camera,
    resect_intermediate_frames,
)

STAGES_FILE = "stages.json"
"""What the folder's stages have cost, by name."""
StageProgressFn = Callable[[str, float], None]
"""Called now and then with a stage's name and how much of it is done, in [0, 1]."""


@final
class StageCache:
    """Names the parts of the work, times them, and remembers which are done.

    A stage writes to a name that passes (`.part`); its result takes its own name when it is whole.

    Attributes:
        folder: Where results lie.
        costs: Of each finished stage: wall and core seconds, also from an earlier process.
    """

    def __init__(self, folder: Path, told: StageProgressFn) -> None:
        """Takes up what lies in the folder."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self._told = folder, told
        self._notes = folder / STAGES_FILE
        self.costs: dict[str, dict[str, float]] = {}
        if self._notes.exists():
            self.costs = json.loads(self._notes.read_text(encoding="utf-8"))

    def run_or_reuse(
        self, name: str, make: Callable[[Path, Callable[[float], None]], None]
    ) -> Path:
        """The file or folder of a stage, made if it is not there yet.

        Args:
            name: Of the result.
            make: Writes it to a path, telling how far it is.
        """
        path = self.folder / name
        if path.exists() and name in self.costs:
            return path
        part = self.folder / f"part.{name}"
        for old in (part, path):
            _remove(old)
        with self._timed(name):
            make(part, lambda share: self._told(name, share))
            part.rename(path)
        return path

    @contextmanager
    def _timed(self, name: str) -> Iterator[None]:
        wall, core = time.perf_counter(), time.process_time()
        self._told(name, 0.0)
        yield
        self._told(name, 1.0)
        self.costs[name] = {
            "wall_seconds": time.perf_counter() - wall,
            "cpu_seconds": time.process_time() - core,
            "peak_memory_mb": peak_memory_mb(),
        }
        write_text_atomically(self._notes, json.dumps(self.costs, indent=1))

    def totals(self) -> dict[str, Any]:
        """Time and memory of all stages together, for the report."""
        return {
            "wall_seconds": sum(cost["wall_seconds"] for cost in self.costs.values()),
            "cpu_seconds": sum(cost["cpu_seconds"] for cost in self.costs.values()),
            "peak_memory_mb": max(
                (cost["peak_memory_mb"] for cost in self.costs.values()), default=0.0
            ),
        }


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


SEED_OFFSETS = (0, 1)
"""Added to the seed for each pair of mappings; the second pair is made if the first disagrees."""

MIN_PARALLAX_FRACTION = 0.02
"""Fraction of matched image pairs that must show parallax, not one plane or a mere rotation."""

MAX_TRACKED_POINT_ERROR_PX = 3.0
"""Largest distance of tracked points from their projection by a key frame's own camera, pixels."""

MIN_TRACKED_KEYFRAMES = 0.5
"""Fraction of the key frames that points must be tracked into."""

MIN_SOLVED_FRAMES = 0.5
"""Fraction of the frames that must have a camera in the end."""

MAX_IGNORED_DISTORTION_PX = 0.3
"""Distortion of the corners below which a lens counts as free of distortion, pixels."""


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """What a solution depends on, beside the pictures.

    Attributes:
        focal_ratio: Known focal length as a fraction of the image's longer side, if any.
        seed: Seed of everything random.
        threads: Threads for features and matches.
        max_keyframes: Largest number of key frames.
    """

    focal_ratio: float | None = None
    seed: int = 0
    threads: int = 1
    max_keyframes: int = MAX_KEYFRAMES


def solve_cameras(
    source: FrameSource,
    person_mask: PersonMaskFn,
    folder: Path,
    settings: SolverSettings,
    report_progress: StageProgressFn,
) -> CameraSolution:
    """Solves the cameras of all wanted frames.

    Args:
        source: The frames.
        person_mask: Where the person is, who moves and must not be looked at.
        folder: Where stages leave their results; what is finished there is not done again.
        settings: What it depends on.
        report_progress: Called with the stage and how much of it is done.

    Raises:
        InputError: If pycolmap is missing, or no solution can be vouched for.
    """
    colmap_mapping.require_pycolmap()
    stages = StageCache(folder, report_progress)
    keys = _keyframes(source, person_mask, stages, settings)
    rest = detect_static_camera(keys)
    if rest.is_static:
        return _static_solution(source, rest, keys, stages)
    height, width = keys[0].gray.shape
    bench = _prepare_workspace(stages, (width, height), settings)
    deep = _parallax(bench, len(keys))
    if not deep.passed:
        raise _unsolved_error([deep])
    model, gates = _map_twice(bench, len(keys), stages, settings.seed)
    model = _drop_small_distortion(model)
    between = _resect(source, model, keys, stages)
    gates = [deep, *gates, _tracking_gate(between, len(model.frames))]
    if not gates[-1].passed:
        raise _unsolved_error([gates[-1]])
    cameras, marks = _cameras_of_all_frames(source, model, between)
    wanted = [i for i in range(source.frames_in_file) if source.selection.contains(i)]
    share = float((marks[wanted] != MISSING).mean())
    if share < MIN_SOLVED_FRAMES:
        raise InputError(
            f"--cameras solve: only {share:.0%} of the frames could be placed. Film without sudden "
            "movements, or give only the part that goes well (--frames START:STOP)."
        )
    return CameraSolution(
        is_static=False, background_motion=rest.background_motion, gates=tuple(gates), model=model,
        camera_from_solved=cameras, frame_status=marks, keyframe_count=len(keys),
        costs=stages.totals(),
    )  # fmt: skip


def _keyframes(
    source: FrameSource, person_in: PersonMaskFn, stages: StageCache, settings: SolverSettings
) -> list[SfmKeyframe]:
    def make(part: Path, told: colmap_mapping.ProgressFn) -> None:
        chosen = select_keyframes(source, person_in, told, settings.max_keyframes)
        write_keyframes(chosen, part / "images", part / "masks")

    folder = stages.run_or_reuse("key frames", make)
    return read_keyframes(folder / "images", folder / "masks")


def _static_solution(
    source: FrameSource, rest: StaticCameraTest, keys: list[SfmKeyframe], stages: StageCache
) -> CameraSolution:
    none = np.zeros((source.frames_in_file, 4, 4))
    return CameraSolution(
        is_static=True, background_motion=rest.background_motion, gates=(), model=None,
        camera_from_solved=none, keyframe_count=len(keys),
        frame_status=np.zeros(source.frames_in_file, dtype=np.int64),
        costs=stages.totals(),
    )  # fmt: skip


def _prepare_workspace(
    stages: StageCache, size_px: tuple[int, int], settings: SolverSettings
) -> ColmapWorkspace:
    """Features and matches of the key frames."""
    shown = stages.folder / "key frames"
    share = settings.focal_ratio
    bench = ColmapWorkspace(
        images=shown / "images", masks=shown / "masks", database=shown,
        focal_px=None if share is None else share * max(size_px), threads=settings.threads,
    )  # fmt: skip
    features = stages.run_or_reuse(
        "features",
        lambda part, told: colmap_mapping.extract_features(replace(bench, database=part), told),
    )

    def matched(part: Path, told: colmap_mapping.ProgressFn) -> None:
        shutil.copyfile(features, part)
        colmap_mapping.match_features(replace(bench, database=part), told)

    return replace(bench, database=stages.run_or_reuse("matches", matched))


def _parallax(bench: ColmapWorkspace, keys: int) -> QualityGate:
    """Whether enough pairs of pictures show depth."""
    pairs, share = colmap_mapping.parallax_fraction(bench.database)
    if pairs < MIN_REGISTERED_FRACTION * (keys - 1):
        return QualityGate(
            name="matched_pairs", value=float(pairs), bound=MIN_REGISTERED_FRACTION * (keys - 1),
            passed=False, failure_reason="the pictures have hardly anything in common",
        )  # fmt: skip
    return QualityGate(
        name="pairs_with_parallax", value=share, bound=MIN_PARALLAX_FRACTION,
        passed=share >= MIN_PARALLAX_FRACTION,
        failure_reason="the camera turns on the spot, or sees one flat wall, so that nothing shows "
        "depth",
    )  # fmt: skip


def _map_twice(
    bench: ColmapWorkspace, keys: int, stages: StageCache, seed: int
) -> tuple[SparseModel, list[QualityGate]]:
    """The global model, once an incremental one agrees with it, and the gates it has passed.

    Raises:
        InputError: If none passes, or no two agree.
    """
    good: dict[str, list[SparseModel]] = {"global": [], "incremental": []}
    failed: list[QualityGate] = []
    for number in SEED_OFFSETS:
        for kind in good:
            model = _run_mapper(kind, bench, stages, seed + number)
            if model is None:
                continue
            model = model.without_cameras(find_outlier_cameras(model))
            gates = evaluate_gates(model, keys)
            if all(gate.passed for gate in gates):
                good[kind].append(model)
            else:
                failed += [gate for gate in gates if not gate.passed]
        for one, other in ((a, b) for a in good["global"] for b in good["incremental"]):
            agreed = compare_models(one, other)
            if agreed.passed:
                return one, [*evaluate_gates(one, keys), agreed]
            failed.append(agreed)
        if not any(good.values()):
            break
    raise _unsolved_error(failed)


def _run_mapper(
    kind: str, bench: ColmapWorkspace, stages: StageCache, seed: int
) -> SparseModel | None:
    """One mapper's model; None if it fails."""

    def make(part: Path, told: colmap_mapping.ProgressFn) -> None:
        part.mkdir()
        mapper = colmap_mapping.map_global if kind == "global" else colmap_mapping.map_incremental
        raw = part / "colmap"
        raw.mkdir()
        model = mapper(bench, raw, seed, told)
        shutil.rmtree(raw)
        if model is not None:
            model.save(part / "model.npz")

    path = stages.run_or_reuse(f"{kind} mapping {seed}", make) / "model.npz"
    return SparseModel.load(path) if path.exists() else None


def _unsolved_error(failed: list[QualityGate]) -> InputError:
    """What went wrong, each kind once, and what can be done about it."""
    words = {gate.name: gate.failure_reason for gate in reversed(failed)}  # the first of each kind
    why = "; ".join(list(words.values())[::-1][:3]) or "neither way of solving found any"
    return InputError(
        f"The cameras could not be solved with certainty: {why}. Film with the surroundings in "
        "view (textured, not repeating, well lit), walking slowly and without sudden turns; or "
        "give cameras (--cameras FILE, docs/formats.md); or, if the camera hardly moved, "
        "--cameras static."
    )


def _resect(
    source: FrameSource, model: SparseModel, keys: list[SfmKeyframe], stages: StageCache
) -> ResectionResult:
    def make(part: Path, told: colmap_mapping.ProgressFn) -> None:
        found = resect_intermediate_frames(source, model, keys, told)
        frames, bridges = sorted(found.cameras), sorted(found.keyframe_errors_px)
        np.savez(
            part.with_suffix(".npz"),
            frames=np.array(frames, dtype=np.int64),
            cameras=np.array([found.cameras[f] for f in frames]).reshape(-1, 4, 4),
            bridges=np.array(bridges, dtype=np.int64),
            misses=np.array([found.keyframe_errors_px[f] for f in bridges]),
        )
        part.with_suffix(".npz").rename(part)

    path = stages.run_or_reuse("frames between", make)
    with np.load(path, allow_pickle=False) as file:
        placed = dict(zip(file["frames"].tolist(), file["cameras"], strict=True))
        bridges = dict(zip(file["bridges"].tolist(), file["misses"].tolist(), strict=True))
    return ResectionResult(cameras=placed, keyframe_errors_px=bridges)


def _tracking_gate(between: ResectionResult, keys: int) -> QualityGate:
    """Whether points that were followed land where the next key frame's camera sees them."""
    misses = np.array(list(between.keyframe_errors_px.values()))
    known = misses[np.isfinite(misses)]
    share = len(known) / max(keys - 1, 1)
    worst = float(known.max()) if len(known) else float("inf")
    words = f"points followed through the video land up to {worst:.1f} px beside where they should"
    if share < MIN_TRACKED_KEYFRAMES:
        words = "the surroundings could hardly be followed from picture to picture"
    return QualityGate(
        name="followed_px", value=worst, bound=MAX_TRACKED_POINT_ERROR_PX, failure_reason=words,
        passed=share >= MIN_TRACKED_KEYFRAMES and worst < MAX_TRACKED_POINT_ERROR_PX,
    )  # fmt: skip


def _drop_small_distortion(model: SparseModel) -> SparseModel:
    """The model without distortion, where that moves the corners by less than can be measured."""
    corner = np.hypot(*model.size_px) / 2.0 / model.focal_px
    bends = abs(model.radial_distortion) * corner**3 * model.focal_px
    return replace(model, radial_distortion=0.0) if bends < MAX_IGNORED_DISTORTION_PX else model


def _cameras_of_all_frames(
    source: FrameSource, model: SparseModel, between: ResectionResult
) -> tuple[Float[np.ndarray, "frames 4 4"], Int[np.ndarray, "frames"]]:
    """A camera for each frame of the file, and what each is; short gaps are filled in."""
    total = max(source.frames_in_file, int(model.frames.max()) + 1)
    marks = np.full(total, INTERPOLATED)
    known = dict.fromkeys(between.cameras, PLACED)
    known.update(dict.fromkeys(model.frames.tolist(), KEY))
    for frame, mark in known.items():
        marks[frame] = mark
    own = dict(zip(model.frames.tolist(), model.camera_from_world, strict=True))
    found = {frame: model.camera(at) for frame, at in (between.cameras | own).items()}
    cameras, missing = interpolate_missing_cameras(found, total)
    marks[list(missing)] = MISSING
    return np.stack([camera.camera_from_world for camera in cameras]), marks
