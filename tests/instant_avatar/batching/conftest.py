"""Captures for batches, and attempts whose ends are given in advance."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from instant_avatar import batch
from instant_avatar.batching.batch_arguments import BatchArguments
from instant_avatar.batching.capture_discovery import BatchCapture
from instant_avatar.batching.ingest_attempt import Attempt, record_of


def named(name: str, *, input_key: str = "input", options_key: str = "options") -> BatchCapture:
    """A capture of which only the name and the fingerprints count."""
    return BatchCapture(
        name=name, video=f"/{name}.mp4", input_key=input_key, options_key=options_key
    )


def ended(capture: BatchCapture, code: int | None = 0, psnr: float = 30.0) -> Attempt:
    """The attempt of a capture that ended with an exit code."""
    figures = {"psnr": psnr, "verdict": "sharp"} if code == 0 else {}
    files = {"avatar.iavatar": capture.name.encode()} if code == 0 else {"ingest.log": b"why"}
    cause = "" if code == 0 else "no <person>"
    record = record_of(capture, code, cause, wall_s=60.0, figures=figures)
    return Attempt(record=record, files=files)


@pytest.fixture
def scripted(monkeypatch) -> list[str]:
    """Attempts of ia-batch end at once: with 2 if the name has `bad` in it, with 1 if `weak`.

    Returns:
        The names of the captures that were started.
    """
    started = []

    def run(captures: list[BatchCapture], arguments: BatchArguments):
        for capture in captures:
            started.append(capture.name)
            codes = [code for word, code in (("bad", 2), ("weak", 1)) if word in capture.name]
            yield ended(capture, *codes)

    monkeypatch.setattr(batch, "run_attempts", run)
    return started


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

    return make
