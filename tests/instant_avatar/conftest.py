"""A short film of the actor and a short run on it, shared by all tests of the commands."""

import functools
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from avatar.rig import Rig
from avatar.training import held_out_pose_fitting, train
from capture.atomic_files import write_text_atomically
from export import mesh_texture, splats
from export.bake import bake_tables, fine_tuning
from export.build import ExportReport
from export.player import Player
from instant_avatar import ingest, play
from instant_avatar.report import report_writer
from instant_avatar.run import final_scoring, snapshot_writer, training_session
from instant_avatar.studio import staging
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture
from tests.cached_networks import networks_run_once as networks_run_once


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How a command ended.

    Attributes:
        code: Its exit code.
        out, err: What it said.
    """

    code: int
    out: str
    err: str

    def complaint(self) -> str:
        """Its one message, as one line of words."""
        said = [line for line in self.err.splitlines() if re.match(r"ia-\w+:", line)]
        assert len(said) == 1, self.err
        assert "Traceback" not in self.err
        return said[0]

    def refusal(self) -> str:
        """Its one message, of bad input."""
        assert self.code == 2, self.err
        return self.complaint()


Command = Callable[..., Outcome]

ENOUGH_STEPS = 150
"""Training steps after which this film's avatar is firm enough for a package."""
FEW_STEPS = 10
"""Training steps where a test is not about what was learnt."""


BRIEF_VOXEL_M = 0.008
"""Voxels of the packages, metres: coarse enough to be baked and drawn quickly."""
BRIEF = pytest.MonkeyPatch()
"""A shorter end of a run; undone after each test, for other folders measure what it shortens."""


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup():
    """Bake coarser voxels, fine-tune on fewer, smaller images, export fewer Gaussians
    and texels, fit poses in fewer steps, judge smaller pictures, close a stream in fewer
    steps, and show a shorter film."""
    BRIEF.setattr(bake_tables, "MIN_VOXEL_M", BRIEF_VOXEL_M)
    BRIEF.setattr(bake_tables, "MAX_VOXEL_M", BRIEF_VOXEL_M)
    BRIEF.setattr(bake_tables, "FINE_TUNING_PICTURES", 2)
    BRIEF.setattr(fine_tuning, "PROBE_PICTURES", 2)
    BRIEF.setattr(fine_tuning, "TRAINING_PX", 64)
    BRIEF.setattr(fine_tuning, "VALIDATION_PX", 64)
    BRIEF.setattr(splats, "MAX_CROSSED_M2", 0.4)
    BRIEF.setattr(splats, "PIXEL_M", 0.02)
    BRIEF.setattr(mesh_texture, "PIXEL_M", 0.02)
    BRIEF.setattr(mesh_texture, "TEXEL_M", 0.005)
    BRIEF.setattr(held_out_pose_fitting, "CORRECTIONS_PER_FRAME", 3)
    BRIEF.setattr(held_out_pose_fitting, "RAYS_PER_CORRECTION", 1024)
    BRIEF.setattr(final_scoring, "UNFILMED_REDUCTION", 5)
    BRIEF.setattr(train, "CLOSING_S", 0.1)
    BRIEF.setattr(train, "LEAST_STEPS", FEW_STEPS)
    BRIEF.setattr(report_writer, "ANIMATION_PX", 96)
    BRIEF.setattr(report_writer, "ANIMATION_FRAMES", 4)


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown():
    """Undo it."""
    BRIEF.undo()


@pytest.fixture(scope="session", autouse=True)
def packages_load_once():
    """One player of packages of the same bytes, of which these tests load few many times."""
    load = Player.load

    @functools.lru_cache(maxsize=8)
    def load_once(content: bytes, path: Path, options: tuple[tuple[str, object], ...]) -> Player:
        return load(path, **dict(options))

    def cached(path: Path | str, **options: object) -> Player:
        if not Path(path).is_file():
            return load(path, **options)
        return load_once(Path(path).read_bytes(), path, tuple(options.items()))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Player, "load", cached)
        yield


def film_without_novel_views(folder: Path, config: ShootConfig) -> None:
    """Film a capture folder; one picture stands for those of poses that the video does not show."""
    with pytest.MonkeyPatch.context() as patch:
        novel_poses = staging.novel_poses
        one = np.arange(1)
        patch.setattr(
            staging, "novel_poses", lambda actor: novel_poses(actor).select_rows(one, one)
        )
        film_capture(folder, config)


@pytest.fixture(scope="session")
def film(tmp_path_factory) -> Path:
    """A capture folder: 24 frames of 64 px."""
    folder = tmp_path_factory.mktemp("film") / "capture"
    film_capture(folder, ShootConfig(frames=24, size=64, background="plain"))
    return folder


@pytest.fixture(scope="session")
def run(film, tmp_path_factory) -> Path:
    """What ia-ingest makes of it."""
    out = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "warm_up", lambda trainer: 0.0)
        patch.setattr(bake_tables, "FINE_TUNING_PICTURES", 0)  # tests of export/ show it
        assert ingest.main([str(film), "--out", str(out), "--steps", str(ENOUGH_STEPS)]) == 0
    return out


@pytest.fixture(scope="session")
def package(run) -> Path:
    return run / "avatar.iavatar"


@pytest.fixture(scope="session")
def player(package) -> Player:
    return Player.load(package)


@pytest.fixture(scope="session")
def novel(film) -> Path:
    """Twelve poses that the film does not show, thirty a second."""
    return film / "truth" / "novel" / "poses.npz"


@pytest.fixture(scope="session")
def rig(film) -> Rig:
    """The rig of the actor, whom all of these films are about."""
    return Rig.from_shaped_body(open_capture(CaptureInputs(video=film)).shaped)


@pytest.fixture
def capture(film, tmp_path) -> Path:
    """A copy of the film that a test may spoil."""
    copy = tmp_path / "capture"
    shutil.copytree(film, copy)
    return copy


@pytest.fixture
def on_one_core(monkeypatch) -> None:
    """Fits in this process; another one takes two seconds, and tests of start-up show it."""
    monkeypatch.setattr(ingest, "usable_cores", lambda: 1)
    monkeypatch.setattr(train, "warm_up", lambda trainer: 0.0)


@pytest.fixture
def call(capsys) -> Command:
    """Runs a command, of which the module is given, with arguments of any type."""

    def call(command: ModuleType, *arguments: object) -> Outcome:
        try:
            code = command.main([str(argument) for argument in arguments])
        except SystemExit as end:  # of words that cannot be parsed
            code = end.code
        captured = capsys.readouterr()
        return Outcome(code=code, out=captured.out, err=captured.err)

    return call


@pytest.fixture
def call_ingest(call, on_one_core) -> Command:
    """Runs ia-ingest, for a few steps unless the test says otherwise."""
    return lambda *arguments, steps=FEW_STEPS: call(ingest, *arguments, "--steps", steps)


@pytest.fixture
def call_play(call) -> Command:
    """Runs ia-play."""
    return functools.partial(call, play)


@pytest.fixture
def without_baking(monkeypatch) -> None:
    """Leaves out the seconds that baking takes, where a test is not about the package.

    Nor is it about how good the avatar is, for which half a second may not be enough: views that
    were not filmed are not drawn.
    """

    def export_nothing(avatar, path, **options):
        write_text_atomically(path, "stand-in")
        yield ExportReport(
            path=path, bytes=8, seconds=0.0, psnr_to_renderer={"hq": 40.0},
            largest_difference=0.0, warnings=(),
        )  # fmt: skip

    monkeypatch.setattr(snapshot_writer, "export_avatar", export_nothing)
    monkeypatch.setattr(training_session, "update_metrics", lambda path, metrics: 8)
    opaque = [np.ones((1, 1, 4), np.float32)]
    monkeypatch.setattr(final_scoring, "render_unfilmed_views", lambda avatar, reduction: opaque)
    monkeypatch.setattr(report_writer, "diagnose_failure", lambda report: None)
    monkeypatch.setattr(report_writer, "demo_animation", lambda player: b"")
    monkeypatch.setattr(report_writer.Player, "load", lambda path: None)


@pytest.fixture
def changed() -> Callable[..., None]:
    """Rewrites an .npz with some arrays changed, or left out where they are None."""

    def change(path: Path, **arrays: np.ndarray | None) -> None:
        with np.load(path) as archive:
            content = {key: archive[key] for key in archive.files}
        content.update(arrays)
        np.savez(path, **{key: array for key, array in content.items() if array is not None})

    return change
