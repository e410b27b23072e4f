"""Live sources from the command line: stand-ins write pictures and poses while they are read."""

import errno
import json
import shutil
import threading
import time

import numpy as np
import pytest

from apps import ingest
from avatar.training import train
from avatar.training.train import warm_up
from capture import live_sources
from capture.source_opening import open_source

FRAMES = 14


@pytest.fixture
def watch(call_ingest, without_baking, monkeypatch, tmp_path, capsys):
    """Runs ia-ingest on a live source; returns its exit code and its report."""

    def watch(*arguments):
        monkeypatch.setattr(train, "warm_up", warm_up)  # a live source waits for no compiler
        code = ingest.main([*map(str, arguments), "--out", str(tmp_path / "run")])
        path = tmp_path / "run" / "report.json"
        return code, json.loads(path.read_text()) if path.exists() else None

    return watch


@pytest.fixture
def studio(film, tmp_path):
    """A folder that a camera, a segmenter and a tracker begin to fill; and how they go on."""
    import cv2

    folder = tmp_path / "studio"
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    shutil.copy(film / "cameras.npz", folder)
    pictures = [frame.rgb for frame in open_source(film).frames()]
    masks = sorted((film / "masks").iterdir())
    with np.load(film / "poses.npz") as archive:
        motion = {key: archive[key] for key in archive.files}

    def shoot(index):
        name = f"{index:04d}.png"
        cv2.imwrite(str(folder / "images" / name), pictures[index][..., ::-1])
        shutil.copy(masks[index], folder / "masks" / name)
        rows = {k: v[: index + 1] if len(v.shape) > 1 and len(v) == 24 else v
                for k, v in motion.items()}  # fmt: skip
        rows = {k: v[: index + 1] if v.shape == (24,) else v for k, v in rows.items()}
        np.savez(folder / "half.npz", **rows)
        (folder / "half.npz").rename(folder / "poses.npz")

    shoot(0)

    def film_the_rest():
        for index in range(1, FRAMES):
            time.sleep(0.04)
            shoot(index)
        (folder / "images" / "DONE").touch()

    return folder, film_the_rest


def test_a_growing_folder_with_growing_poses_becomes_an_avatar(watch, studio):
    folder, film_the_rest = studio
    thread = threading.Thread(target=film_the_rest)
    thread.start()
    code, report = watch(folder, "--live", "--seconds", "2", "--idle-seconds", "5")
    thread.join()
    assert code == 0
    assert report["stream"]["realtime"]
    frames = report["frames"]
    assert frames["read"] == frames["used"] + frames["held_out"] + len(frames["dropped"])
    assert 2 <= frames["read"] + report["stream"]["inbox_dropped"] <= FRAMES
    assert report["training"]["steps"] > 0


def test_a_live_source_that_goes_on_is_left_when_the_time_is_up(watch, studio):
    folder, _ = studio
    began = time.perf_counter()
    code, report = watch(folder, "--live", "--seconds", "0.5", "--idle-seconds", "3600")
    assert code == 0
    assert report["frames"]["used"] == 1
    assert report["training"]["wall_seconds"] >= 0.5
    assert time.perf_counter() - began < 120.0


def test_a_camera_with_growing_poses_becomes_an_avatar(watch, film):
    """A file stands in for the camera, opened through the same class."""
    code, report = watch(
        f"camera:{film / 'video.mp4'}", "--poses", film / "poses.npz", "--seconds", "1.5"
    )
    assert code == 0
    assert report["stream"]["realtime"]
    assert 2 <= report["frames"]["read"] + report["stream"]["inbox_dropped"] <= 24
    assert report["frames"]["used"] >= 2


def test_a_camera_that_is_not_there(call_ingest, film, tmp_path):
    outcome = call_ingest("camera:97", "--poses", film / "poses.npz", "--out", tmp_path / "run")
    assert outcome.code == 2
    assert "no camera '97'" in outcome.complaint()
    assert not (tmp_path / "run").exists()


def test_a_camera_that_another_program_uses(call_ingest, film, tmp_path, monkeypatch):
    def busy(address):
        raise OSError(errno.EBUSY, "another program may be using it", "/dev/video0")

    monkeypatch.setattr(live_sources, "_open_device", busy)
    outcome = call_ingest("camera:0", "--poses", film / "poses.npz", "--out", tmp_path / "run")
    assert outcome.code == 3
    assert "busy" in outcome.complaint()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--live", "--realtime"], "--realtime"),
        (["--live", "--idle-seconds", "0"], "--idle-seconds"),
        (["--live", "--idle-seconds", "0.2"], "No picture came"),
    ],
)
def test_errors_of_a_live_source_are_reported(call_ingest, tmp_path, arguments, word):
    (tmp_path / "capture" / "images").mkdir(parents=True)
    outcome = call_ingest(tmp_path / "capture", *arguments, "--out", tmp_path / "run")
    assert outcome.code == 2
    assert word in outcome.complaint()
