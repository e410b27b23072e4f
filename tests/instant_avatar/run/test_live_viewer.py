"""Watching it learn: a run with a page, driven as a person would, in a headless browser."""

import importlib.util
import itertools
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tyro

from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.render import render
from avatar.training.trainer import Trainer
from export.player import Player
from instant_avatar import ingest
from instant_avatar.cli.command_line import fill_optional_value
from instant_avatar.run import live_viewer, session_start
from instant_avatar.run.ingest_arguments import VIEW_PORT, IngestArguments
from instant_avatar.run.live_viewer import (
    BACKGROUND_RGB,
    DANCE,
    NEWEST,
    PANEL_PX,
    BrowserCamera,
    PreviewPoses,
    render_preview,
)
from preprocess.body.kinematics import rotation_matrices
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.observation import DroppedFrame
from preprocess.open_capture import open_capture
from tests.instant_avatar.browser import Browser, until, with_chromium

PAPER = np.array([251, 250, 247])

KINDS = ("Training", "Paused", "Writing the package")
"""What the page says of a run, in this order."""

with_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason="viser is not installed ([viewer])"
)


def scene(browser: Browser) -> tuple[np.ndarray, np.ndarray]:
    """The picture left of the panel, below the browser's own notes, and where it is no paper."""
    picture = browser.picture()
    picture = picture[:, : picture.shape[1] - PANEL_PX].astype(int)
    picture[:160, :320] = PAPER  # Chromium shows its notice about a missing GPU here
    return picture, np.abs(picture - PAPER).max(axis=2) > 24


def shows_a_person(drawn: np.ndarray) -> bool:
    """Something upright stands in the middle, and the rest is empty."""
    rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
    if not len(rows) or not 0.02 < drawn.mean() < 0.5:
        return False
    height, width = drawn.shape
    middle = (columns[0] + columns[-1]) / 2.0
    return len(rows) > 0.5 * height and abs(middle - width / 2.0) < 0.15 * width


def actors_color(film: Path) -> np.ndarray:
    """The mean color of the person in the film's first frame."""
    _, bgr = cv2.VideoCapture(str(next(film.glob("video.*")))).read()
    alpha = cv2.imread(str(min((film / "masks").iterdir())), cv2.IMREAD_GRAYSCALE)
    return bgr[alpha > 200][:, ::-1].mean(axis=0)


def steps(browser: Browser) -> int:
    found = re.search(r"([\d,]+)\s+steps", browser.text())
    return int(found.group(1).replace(",", "")) if found else 0


@with_viser
@with_chromium
@pytest.mark.slow
def test_a_user_watches_pauses_saves_and_starts_the_dance(film, tmp_path):
    log, out = tmp_path / "log", tmp_path / "run"
    command = [sys.executable, "-m", "instant_avatar.ingest", str(film), "--out", str(out)]
    with log.open("w") as file:
        process = subprocess.Popen([*command, "--seconds", "45", "--view", "0"], stderr=file)
    try:
        until(lambda: "Live viewer" in log.read_text(), 240.0)
        address = re.search(r"http://127\.0\.0\.1:(\d+)", log.read_text())
        only_this_machine(int(address.group(1)))
        with Browser(tmp_path / "browser") as browser:
            browser.go(address.group(0))
            look_and_pause(browser, film)
            save(browser, out, process)
            browser.click("Resume")
            stay_and_dance(browser, log)
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(timeout=60.0) == 0
    finally:
        process.kill()
        process.wait()
    said = log.read_text()
    assert "Traceback" not in said
    assert "Ctrl-C closes it" in said
    assert (out / "report.html").exists()


def only_this_machine(port: int) -> None:
    """A server that listened everywhere would answer on the loopback's other addresses, too."""
    socket.create_connection(("127.0.0.1", port), timeout=5.0).close()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port), timeout=5.0)


def look_and_pause(browser: Browser, film: Path) -> None:
    until(lambda: "Pause" in browser.text() and steps(browser) >= 100, 120.0)
    browser.click("Pause")
    until(lambda: "Paused" in browser.text(), 30.0)
    before = steps(browser)
    time.sleep(2.0)
    assert steps(browser) == before  # a step takes some 20 ms
    until(lambda: shows_a_person(scene(browser)[1]), 60.0)
    picture, drawn = scene(browser)
    # not just a shape: it is dressed as the actor is
    assert np.abs(picture[drawn].mean(axis=0) - actors_color(film)).max() < 40.0
    assert "seen" in browser.text()


def save(browser: Browser, out: Path, process: subprocess.Popen) -> None:
    browser.click("Save package now")
    until(lambda: "Package saved" in browser.text() or "No package" in browser.text(), 120.0)
    if "Package saved" in browser.text():  # on a slow machine it may be too early for one
        Player.load(out / "avatar.iavatar")
    assert process.poll() is None


def stay_and_dance(browser: Browser, log: Path) -> None:
    until(lambda: "viewer stays open" in log.read_text(), 240.0)
    until(lambda: "Done after 45 s" in browser.text(), 30.0)
    browser.click("Dance")
    pictures = []
    for _ in range(4):
        time.sleep(1.0)
        pictures.append(scene(browser)[0])
    until(lambda: shows_a_person(scene(browser)[1]), 30.0)
    moved = [np.abs(b - a).max(axis=2).mean() for a, b in itertools.pairwise(pictures)]
    assert max(moved) > 0.5


class StandInPage:
    """Takes the place of viser's page: one press of each button, and what is shown."""

    def __init__(self, name, port):
        self.address, self.pose_choice, self.chosen_at = "nowhere", NEWEST, 0.0
        self.save_requested = False
        self.statuses, self.notes = [], []

    @property
    def paused(self):
        """True until a status says so, once a package was saved."""
        return bool(self.notes) and not any("Paused" in status for status in self.statuses)

    def show_status(self, status, advice):
        self.statuses.append(status)
        self.save_requested = not self.notes and " 0 steps" not in status

    def notify(self, title, message):
        self.notes.append(title)

    def browser_cameras(self):
        return {}

    def show_frame(self, image): ...

    def close(self): ...


def test_the_viewer_reads_events_pauses_and_saves(
    capture, call_ingest, without_baking, tmp_path, monkeypatch
):
    viewers = []

    def open_viewer(arguments, recording, run, console):
        viewers.append(live_viewer.LiveViewer(recording, run, console, 0))
        viewers[0].serve_until_interrupt = lambda session: None
        return viewers[0]

    monkeypatch.setattr(live_viewer, "ViserPage", StandInPage)
    monkeypatch.setattr(live_viewer, "PANEL_INTERVAL_S", 0.0)
    monkeypatch.setattr(session_start, "_open_viewer", open_viewer)
    outcome = call_ingest(
        capture, "--frames", "0:8", "--no-refine-poses", "--out", tmp_path / "run"
    )
    assert outcome.code == 0
    page = viewers[0].page
    assert page.notes == ["Package saved"]
    kinds = [next(kind for kind in KINDS if kind in status) for status in page.statuses]
    assert list(dict.fromkeys(kinds)) == list(KINDS)


def test_view_without_viser_says_how_to_get_it(film, tmp_path, monkeypatch, call):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *more: None if name == "viser" else found(name, *more),
    )
    refusal = call(ingest, film, "--out", tmp_path / "run", "--view").refusal()
    assert "viser is not installed" in refusal
    assert "[viewer]" in refusal
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "port"),
    [
        (["v.mp4", "--view"], VIEW_PORT),
        (["--view", "v.mp4"], VIEW_PORT),
        (["v.mp4", "--view", "9000"], 9000),
        (["v.mp4"], None),
    ],
)
def test_the_port_may_be_left_out(words, port):
    given = tyro.cli(IngestArguments, args=fill_optional_value(words, "--view", VIEW_PORT))
    assert given.view == port
    assert given.video == Path("v.mp4")


@pytest.fixture(scope="module")
def recording(film) -> Capture:
    return open_capture(CaptureInputs(video=film))


@pytest.fixture(scope="module")
def observations(recording):
    return [item for item in recording.observations() if not isinstance(item, DroppedFrame)]


def look(**changes) -> BrowserCamera:
    """From 3.7 m before the origin, level."""
    first = BrowserCamera(
        world_from_camera=np.diag([1.0, -1.0, -1.0]),
        position=np.array([0.0, 0.0, 3.7]),
        fov=0.6,
        aspect=1.5,
        moved_at=0.0,
    )
    return replace(first, **changes)


def test_the_camera_looks_where_the_browser_does():
    camera = look().to_camera(100)
    assert camera.size_px == (150, 100)
    assert camera.project(np.zeros(3)) == pytest.approx([75.0, 50.0])
    right, up = camera.project(np.eye(3)[:2])
    assert right[0] > 75.0
    assert up[1] < 50.0
    half = 3.7 * np.tan(0.3)  # what the field of view holds, above and below
    assert camera.project(np.array([0.0, half, 0.0]))[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("choice", [NEWEST, DANCE])
def test_every_pose_has_its_pelvis_at_the_origin(recording, observations, choice):
    poser = PreviewPoses(recording)
    for seconds in (0.0, 0.3, 100.0):
        pose = poser.pose_at(choice, seconds, observations[3])
        assert recording.shaped.with_pose(pose).joints()[0] == pytest.approx(np.zeros(3), abs=1e-9)


def test_the_first_look_sees_the_newest_frame_as_its_camera_did(recording, observations):
    poser, newest = PreviewPoses(recording), observations[5]
    page = recording.shaped.with_pose(poser.pose_at(NEWEST, 0.0, newest)).joints()
    world = recording.shaped.with_pose(newest.pose).joints()
    rotation = newest.camera.camera_from_world[:3, :3]
    seen_there = (world - world[0]) @ rotation.T
    seen_here = page @ look().to_camera(100).camera_from_world[:3, :3].T
    assert seen_here == pytest.approx(seen_there, abs=1e-6)


def test_the_dance_goes_on_and_begins_again(recording):
    poser = PreviewPoses(recording)
    first, later = poser.pose_at(DANCE, 0.0, None), poser.pose_at(DANCE, 1.0, None)
    assert not np.allclose(first.joint_rotations, later.joint_rotations)
    assert poser.pose_at(DANCE, 3.0, None).joint_rotations == pytest.approx(first.joint_rotations)


def test_before_the_first_frame_the_person_stands(recording):
    standing = PreviewPoses(recording).pose_at(NEWEST, 0.0, None)
    assert rotation_matrices(standing.root_rotation) == pytest.approx(np.eye(3))


def test_the_avatar_stands_on_paper(recording, rig):
    config = TrainConfig(rays=64, sample_step_m=0.03, finest_m=0.05, levels=2, table_size=1 << 10)
    avatar = Trainer(rig, config).avatar  # nothing learnt: fog all around
    pose = PreviewPoses(recording).pose_at(NEWEST, 0.0, None)
    cells = CorrespondenceGrid.solve(rig, pose.joint_rotations)
    camera = look(aspect=1.2).to_camera(60)
    picture = render_preview(avatar, pose, camera, cells=cells)
    alpha = render(avatar, pose, camera, cells=cells)[..., 3]
    assert np.all(picture[alpha == 0.0] == BACKGROUND_RGB)
    fog = alpha > 0.02
    assert np.all((picture[fog] != BACKGROUND_RGB).any(axis=1))
    rows = np.flatnonzero(fog.any(axis=1))
    assert 0.7 < len(rows) / 60.0 <= 1.0  # the first look shows the whole person
