"""Live sources from the command line: a stand-in writes the images while the person is tracked."""

import json
import os
import shutil
import threading
import time

import cv2
import pytest

from avatar.training import train
from avatar.training.train import warm_up
from capture.source_opening import open_source
from instant_avatar import ingest

FRAMES = 10


@pytest.fixture
def watch(call_ingest, without_baking, monkeypatch, tmp_path):
    """Runs ia-ingest on a live source; returns its exit code and its report."""

    def watch(*arguments):
        monkeypatch.setattr(train, "warm_up", warm_up)  # a live source waits for no compiler
        out, small = ("--out", str(tmp_path / "run")), ("--no-refine-poses", "--size", "96")
        code = ingest.main([*map(str, arguments), *out, *small])
        path = tmp_path / "run" / "report.json"
        return code, json.loads(path.read_text()) if path.exists() else None

    return watch


@pytest.fixture
def studio(filmed, tmp_path):
    """A folder that a camera begins to fill, and how it goes on."""
    folder = tmp_path / "studio"
    (folder / "images").mkdir(parents=True)
    shutil.copy(filmed / "cameras.npz", folder)
    images = [frame.rgb for frame in open_source(filmed).frames()]

    def shoot(index):
        path = folder / "images" / f"{index:04d}.png"
        cv2.imwrite(str(path), images[index][..., ::-1])
        return path

    began = time.time() - 10.0
    for index in range(6):
        os.utime(shoot(index), (began, began + 0.1 * index))

    def film_the_rest():
        for index in range(6, FRAMES):
            time.sleep(0.1)
            shoot(index)
        (folder / "images" / "DONE").touch()

    return folder, film_the_rest


def test_a_growing_folder_becomes_an_avatar(watch, studio):
    folder, film_the_rest = studio
    thread = threading.Thread(target=film_the_rest)
    thread.start()
    code, report = watch(folder, "--live", "--seconds", "600", "--idle-seconds", "5")
    thread.join()
    assert code == 0
    assert report["stream"]["realtime"]
    assert report["recipe"]["masks"] == "tracked"
    assert report["frames"]["read"] == FRAMES
    assert report["stream"]["inbox_dropped"] == 0
    assert report["training"]["steps"] > 0


@pytest.mark.slow
def test_a_live_source_that_goes_on_is_left_when_the_time_is_up(watch, studio):
    folder, _ = studio
    began = time.perf_counter()
    code, report = watch(folder, "--live", "--seconds", "0.5", "--idle-seconds", "3600")
    assert code == 0
    assert report["training"]["wall_seconds"] >= 0.5
    assert time.perf_counter() - began < 1800.0  # not an hour


@pytest.mark.slow
def test_a_camera_becomes_an_avatar(watch, filmed):
    """A file stands in for the camera, opened through the same class."""
    code, report = watch(f"camera:{filmed / 'video.mp4'}", "--seconds", "1.5")
    assert code == 0
    assert report["stream"]["realtime"]
    assert report["frames"]["used"] >= 2


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--realtime"], "--realtime"),
        (["--idle-seconds", "0.2"], "No image came"),
        (["--poses", "growing.jsonl"], "--poses"),
        (["--masks", "masks"], "--masks"),
        (["--cameras", "solve"], "--cameras solve"),
    ],
)
def test_what_a_live_source_cannot_have_is_refused(call_ingest, tmp_path, arguments, word):
    (tmp_path / "capture" / "images").mkdir(parents=True)
    outcome = call_ingest(tmp_path / "capture", "--live", *arguments, "--out", tmp_path / "run")
    assert outcome.code == 2
    assert word in outcome.complaint()
