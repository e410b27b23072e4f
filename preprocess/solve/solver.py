"""Solves a capture's cameras, stage after stage, and refuses what it cannot vouch for.

Key frames, features, matches, the global mapping, the incremental one as a second opinion, then
the frames in between. Two mappings that agree, and points followed from key frame to key frame
that land where the next camera sees them: less is not believed.
"""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from capture.errors import BadInput
from capture.source import Source
from preprocess.cameras.matching import bridged
from preprocess.solve import mapping
from preprocess.solve.gates import LEAST_REGISTERED, Gate, agreement, doubtful, judged
from preprocess.solve.keyframes import (
    MOST_KEYS,
    KeyFrame,
    PersonIn,
    choose,
    read_keys,
    write_keys,
)
from preprocess.solve.mapping import Workbench
from preprocess.solve.model import Model
from preprocess.solve.resection import Between, place_between
from preprocess.solve.solved import INTERPOLATED, KEY, MISSING, PLACED, Solved
from preprocess.solve.stages import Stages, Told
from preprocess.solve.stillness import Stillness, stillness

SEEDS = (0, 1)
"""A pair of mappings that disagrees is made anew with the next seed."""
LEAST_DEEP = 0.02
"""Share of the matched pairs of pictures that must be more than one plane's, or a mere turn's."""
MOST_BRIDGE_PX = 3.0
"""How far points that were followed may land from where a key frame's own camera sees them."""
LEAST_BRIDGES = 0.5
"""Share of the key frames that points must be followed into."""
LEAST_FRAMES = 0.5
"""Share of the frames that must have a camera in the end."""
STRAIGHT_PX = 0.3
"""A lens that bends the corners by less is taken for straight."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What a solution depends on, beside the pictures.

    Attributes:
        focal_share: Focal length in longer sides of the picture, if somebody knows it.
        seed: Of everything random.
        threads: Of features and matches.
        most_keys: Key frames at most.
    """

    focal_share: float | None = None
    seed: int = 0
    threads: int = 1
    most_keys: int = MOST_KEYS


def solve(
    source: Source, person_in: PersonIn, folder: Path, settings: Settings, told: Told
) -> Solved:
    """Solves the cameras of all wanted frames.

    Args:
        source: The frames.
        person_in: Where the person is, who moves and must not be looked at.
        folder: Where stages leave their results; what is finished there is not done again.
        settings: What it depends on.
        told: Called with the stage and how much of it is done.

    Raises:
        BadInput: If pycolmap is missing, or no solution can be vouched for.
    """
    mapping.check_installed()
    stages = Stages(folder, told)
    keys = _keys(source, person_in, stages, settings)
    rest = stillness(keys)
    if rest.still:
        return _standing(source, rest, keys, stages)
    height, width = keys[0].grey.shape
    bench = _bench(stages, (width, height), settings)
    deep = _parallax(bench, len(keys))
    if not deep.passed:
        raise _refusal([deep])
    model, gates = _agreed(bench, len(keys), stages, settings.seed)
    model = _straightened(model)
    between = _between(source, model, keys, stages)
    gates = [deep, *gates, _followed(between, len(model.frames))]
    if not gates[-1].passed:
        raise _refusal([gates[-1]])
    cameras, marks = _every_frame(source, model, between)
    wanted = [i for i in range(source.frames_in_file) if source.selection.wants(i)]
    share = float((marks[wanted] != MISSING).mean())
    if share < LEAST_FRAMES:
        raise BadInput(
            f"--cameras solve: only {share:.0%} of the frames could be placed. Film without sudden "
            "movements, or give only the part that goes well (--frames START:STOP)."
        )
    return Solved(
        still=False, moved=rest.moved, gates=tuple(gates), model=model, camera_from_solved=cameras,
        marks=marks, keys=len(keys), costs=stages.totals(),
    )  # fmt: skip


def _keys(
    source: Source, person_in: PersonIn, stages: Stages, settings: Settings
) -> list[KeyFrame]:
    def make(part: Path, told: mapping.Told) -> None:
        chosen = choose(source, person_in, told, settings.most_keys)
        write_keys(chosen, part / "images", part / "masks")

    folder = stages.result("key frames", make)
    return read_keys(folder / "images", folder / "masks")


def _standing(source: Source, rest: Stillness, keys: list[KeyFrame], stages: Stages) -> Solved:
    none = np.zeros((source.frames_in_file, 4, 4))
    return Solved(
        still=True, moved=rest.moved, gates=(), model=None, camera_from_solved=none,
        marks=np.zeros(source.frames_in_file, dtype=np.int64), keys=len(keys),
        costs=stages.totals(),
    )  # fmt: skip


def _bench(stages: Stages, size_px: tuple[int, int], settings: Settings) -> Workbench:
    """Features and matches of the key frames."""
    shown = stages.folder / "key frames"
    share = settings.focal_share
    bench = Workbench(
        images=shown / "images", masks=shown / "masks", database=shown,
        focal_px=None if share is None else share * max(size_px), threads=settings.threads,
    )  # fmt: skip
    features = stages.result(
        "features", lambda part, told: mapping.extract(replace(bench, database=part), told)
    )

    def matched(part: Path, told: mapping.Told) -> None:
        shutil.copyfile(features, part)
        mapping.match(replace(bench, database=part), told)

    return replace(bench, database=stages.result("matches", matched))


def _parallax(bench: Workbench, keys: int) -> Gate:
    """Whether enough pairs of pictures show depth."""
    pairs, share = mapping.parallax(bench.database)
    if pairs < LEAST_REGISTERED * (keys - 1):
        return Gate(
            name="matched_pairs", value=float(pairs), bound=LEAST_REGISTERED * (keys - 1),
            passed=False, words="the pictures have hardly anything in common",
        )  # fmt: skip
    return Gate(
        name="pairs_with_parallax", value=share, bound=LEAST_DEEP, passed=share >= LEAST_DEEP,
        words="the camera turns on the spot, or sees one flat wall, so that nothing shows depth",
    )  # fmt: skip


def _agreed(bench: Workbench, keys: int, stages: Stages, seed: int) -> tuple[Model, list[Gate]]:
    """The global model, once an incremental one agrees with it, and the gates it has passed.

    Raises:
        BadInput: If none passes, or no two agree.
    """
    good: dict[str, list[Model]] = {"global": [], "incremental": []}
    failed: list[Gate] = []
    for number in SEEDS:
        for kind in good:
            model = _mapped(kind, bench, stages, seed + number)
            if model is None:
                continue
            model = model.without(doubtful(model))
            gates = judged(model, keys)
            if all(gate.passed for gate in gates):
                good[kind].append(model)
            else:
                failed += [gate for gate in gates if not gate.passed]
        for one, other in ((a, b) for a in good["global"] for b in good["incremental"]):
            agreed = agreement(one, other)
            if agreed.passed:
                return one, [*judged(one, keys), agreed]
            failed.append(agreed)
        if not any(good.values()):
            break
    raise _refusal(failed)


def _mapped(kind: str, bench: Workbench, stages: Stages, seed: int) -> Model | None:
    """One mapper's model; None if it fails."""

    def make(part: Path, told: mapping.Told) -> None:
        part.mkdir()
        mapper = mapping.map_globally if kind == "global" else mapping.map_incrementally
        raw = part / "colmap"
        raw.mkdir()
        model = mapper(bench, raw, seed, told)
        shutil.rmtree(raw)
        if model is not None:
            model.save(part / "model.npz")

    path = stages.result(f"{kind} mapping {seed}", make) / "model.npz"
    return Model.load(path) if path.exists() else None


def _refusal(failed: list[Gate]) -> BadInput:
    """What went wrong, each kind once, and what can be done about it."""
    words = {gate.name: gate.words for gate in reversed(failed)}  # the first of each kind
    why = "; ".join(list(words.values())[::-1][:3]) or "neither way of solving found any"
    return BadInput(
        f"The cameras could not be solved with certainty: {why}. Film with the surroundings in "
        "view (textured, not repeating, well lit), walking slowly and without sudden turns; or "
        "give cameras (--cameras FILE, docs/formats.md); or, if the camera hardly moved, "
        "--cameras static."
    )


def _between(source: Source, model: Model, keys: list[KeyFrame], stages: Stages) -> Between:
    def make(part: Path, told: mapping.Told) -> None:
        found = place_between(source, model, keys, told)
        frames, bridges = sorted(found.placed), sorted(found.bridges)
        np.savez(
            part.with_suffix(".npz"),
            frames=np.array(frames, dtype=np.int64),
            cameras=np.array([found.placed[f] for f in frames]).reshape(-1, 4, 4),
            bridges=np.array(bridges, dtype=np.int64),
            misses=np.array([found.bridges[f] for f in bridges]),
        )
        part.with_suffix(".npz").rename(part)

    path = stages.result("frames between", make)
    with np.load(path, allow_pickle=False) as file:
        placed = dict(zip(file["frames"].tolist(), file["cameras"], strict=True))
        bridges = dict(zip(file["bridges"].tolist(), file["misses"].tolist(), strict=True))
    return Between(placed=placed, bridges=bridges)


def _followed(between: Between, keys: int) -> Gate:
    """Whether points that were followed land where the next key frame's camera sees them."""
    misses = np.array(list(between.bridges.values()))
    known = misses[np.isfinite(misses)]
    share = len(known) / max(keys - 1, 1)
    worst = float(known.max()) if len(known) else float("inf")
    words = f"points followed through the video land up to {worst:.1f} px beside where they should"
    if share < LEAST_BRIDGES:
        words = "the surroundings could hardly be followed from picture to picture"
    return Gate(
        name="followed_px", value=worst, bound=MOST_BRIDGE_PX, words=words,
        passed=share >= LEAST_BRIDGES and worst < MOST_BRIDGE_PX,
    )  # fmt: skip


def _straightened(model: Model) -> Model:
    """The same with a straight lens, if it bends too little to be told from one."""
    corner = np.hypot(*model.size_px) / 2.0 / model.focal_px
    bends = abs(model.bend) * corner**3 * model.focal_px
    return replace(model, bend=0.0) if bends < STRAIGHT_PX else model


def _every_frame(
    source: Source, model: Model, between: Between
) -> tuple[Float[np.ndarray, "frames 4 4"], Int[np.ndarray, "frames"]]:
    """A camera for each frame of the file, and what each is; short gaps are filled in."""
    total = max(source.frames_in_file, int(model.frames.max()) + 1)
    marks = np.full(total, INTERPOLATED)
    known = dict.fromkeys(between.placed, PLACED)
    known.update(dict.fromkeys(model.frames.tolist(), KEY))
    for frame, mark in known.items():
        marks[frame] = mark
    own = dict(zip(model.frames.tolist(), model.camera_from_world, strict=True))
    found = {frame: model.camera(at) for frame, at in (between.placed | own).items()}
    cameras, missing = bridged(found, total)
    marks[list(missing)] = MISSING
    return np.stack([camera.camera_from_world for camera in cameras]), marks
