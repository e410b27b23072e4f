"""Captures for batches, and a hook by which some ia-ingest processes hang or eat memory."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from apps.batching.capture_discovery import BatchCapture
from apps.batching.ingest_attempt import IngestJob

HOOK = """
import sys, time

class BeforeIngest:
    def find_spec(self, name, path=None, target=None):
        if name == "apps.ingest":
            sys.meta_path.remove(self)
            act(" ".join(sys.argv))

def act(words):
    if "hangs" in words:
        print("about to hang", flush=True)
        time.sleep(600.0)
    if "eats" in words:
        held = []
        while True:
            held.append(bytearray(b"x" * 20_000_000))
            time.sleep(0.02)
    if "bad" not in words:  # a shorter end of training, as in tests/apps/conftest.py
        from apps.animation.driving_motion import demo_motion
        from avatar.training import held_out_pose_fitting
        from export.bake import bake_tables, fine_tuning
        demo_motion.__defaults__ = (6,)
        fine_tuning.ROUNDS = 1
        bake_tables.FINE_TUNING_PICTURES = 2
        bake_tables.VOXEL_FACTORS = (1.6, 1.6)
        fine_tuning.TRAINING_PX = fine_tuning.VALIDATION_PX = 128
        held_out_pose_fitting.CORRECTIONS_PER_FRAME = 4

if "apps.batching.ingest_attempt" in sys.orig_argv:
    sys.meta_path.insert(0, BeforeIngest())
"""
"""What an ia-ingest process does first, by the name of its capture."""


@pytest.fixture
def hooked(tmp_path, monkeypatch) -> None:
    """Processes of this test obey the hook."""
    folder = tmp_path / "hook"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(HOOK, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(folder))


@pytest.fixture
def job(tmp_path) -> IngestJob:
    """An attempt at a file that is no video."""
    video = tmp_path / "bad.mp4"
    video.write_text("no video")
    return IngestJob(name="bad", video=str(video), options={}, scratch=str(tmp_path / "scratch"))


@pytest.fixture
def copies(film) -> Callable[[Path, list[str]], None]:
    """Copies of the film by name; one called bad… is no video."""

    def make(folder: Path, names: list[str]) -> None:
        folder.mkdir(exist_ok=True)
        for number, name in enumerate(names):
            if name.startswith("bad"):
                (folder / f"{name}.mp4").write_text(f"no video {number}")
            else:
                shutil.copytree(film, folder / name, ignore=shutil.ignore_patterns("truth"))
                (folder / name / "notes.txt").write_text(name)  # no two have the same content

    return make


@pytest.fixture
def named() -> Callable[..., BatchCapture]:
    """Makes a capture of which only the name counts."""

    def make(name: str, *, input_key: str = "input", options_key: str = "options") -> BatchCapture:
        return BatchCapture(
            name=name, video=f"/{name}.mp4", options={}, sources=(),
            input_key=input_key, options_key=options_key,
        )  # fmt: skip

    return make
