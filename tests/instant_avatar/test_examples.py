"""The examples run as they stand, only shorter."""

import functools
import http.server
import importlib.util
import runpy
import shutil
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from instant_avatar import export
from tests.instant_avatar.browser import Browser, until, with_chromium

EXAMPLES = Path(__file__).parents[2] / "examples"
PACKAGES = EXAMPLES.parent / "build" / "npm" / "node_modules"
"""Where `make test-all` has npm put three.js and Spark."""


def load(name):
    spec = importlib.util.spec_from_file_location("example", EXAMPLES / name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_examples_are_one_walk_each():
    for file in EXAMPLES.glob("*.py"):
        assert len(file.read_text().splitlines()) <= 80


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_what_is_missing_is_one_line(file, tmp_path, monkeypatch):
    """A package that is not installed; and an avatar, or a folder, that is not there."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", [str(file), str(tmp_path / "file" / "none")])
    with pytest.raises(SystemExit, match=r"none|is a file"):
        runpy.run_path(str(file), run_name="__main__")
    monkeypatch.setitem(sys.modules, "numpy" if file.stem[0] != "1" else "torch", None)
    with pytest.raises(SystemExit, match=r"pip install -e '?\."):
        runpy.run_path(str(file), run_name="__main__")


@pytest.mark.slow
def test_an_avatar_is_trained_from_python(film, tmp_path, monkeypatch, capsys):
    example = load("1_train_from_python.py")
    monkeypatch.setattr(example, "STEPS", 150)
    example.main(film, tmp_path / "run")
    assert (tmp_path / "run" / "avatar.iavatar").exists()
    assert "dB on" in capsys.readouterr().out


def test_a_package_is_played_in_a_pose_of_our_own(run, tmp_path, capsys):
    example = load("2_play_in_a_new_pose.py")
    example.main(run / "avatar.iavatar", tmp_path / "pose.png")
    with Image.open(tmp_path / "pose.png") as picture:
        rgba = np.asarray(picture)
    assert rgba.shape == (540, 540, 4)
    assert 0.05 < (rgba[..., 3] > 0).mean() < 0.3
    # the person's left arm is up, so the right half of the picture has its highest pixel
    columns = np.flatnonzero(rgba[np.flatnonzero(rgba[..., 3].max(axis=1) > 127)[0], :, 3] > 127)
    assert columns.mean() > 270


def test_an_avatar_is_drawn_from_all_sides(run, tmp_path, capsys):
    example = load("3_turntable_with_workers.py")
    example.main(run / "avatar.iavatar", tmp_path / "turn.webp")
    assert "540x540 px" in capsys.readouterr().out
    with Image.open(tmp_path / "turn.webp") as clip:
        assert clip.n_frames == example.PICTURES
        widths = []
        for number in range(clip.n_frames):
            clip.seek(number)
            alpha = np.asarray(clip.convert("RGBA"))[..., 3] > 127
            rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
            assert rows[0] > 0
            assert rows[-1] < example.SIZE - 1
            widths.append(columns[-1] - columns[0])
    # arms are away from the body: from the side the person is much narrower than from the front
    assert widths[6] < 0.6 * widths[0]
    assert abs(widths[12] - widths[0]) < 8


class QuietFiles(http.server.SimpleHTTPRequestHandler):
    """A server that says nothing."""

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture(scope="module")
def site(run, film, tmp_path_factory):
    """The address of the examples beside an avatar's exports, and a folder for browsers."""
    folder = tmp_path_factory.mktemp("site")
    for file in EXAMPLES.glob("[56]_*"):
        shutil.copy(file, folder)
    (folder / "node_modules").symlink_to(PACKAGES)
    avatar, poses = run / "avatar.iavatar", film / "truth" / "novel" / "poses.npz"
    for words in (
        ["--to", "splats", "--out", folder / "avatar.spz"],
        ["--to", "glb", "--triangles", "20000", "--poses", poses, "--out", folder / "dance.glb"],
    ):
        assert export.main([str(avatar), *map(str, words)]) == 0
    files = functools.partial(QuietFiles, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), files) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}", folder
        server.shutdown()


@pytest.mark.slow
@with_chromium
@pytest.mark.skipif(not PACKAGES.is_dir(), reason="`make test-all` fetches three.js and Spark")
def test_mesh_in_three_and_splats_in_spark_are_one_figure_and_move(site):
    """Both pages have the same camera; splats follow the skeleton of the mesh."""
    address, folder = site
    size = (300, 400)
    shown = {}
    with Browser(folder / "browser", size=size) as browser:

        def ready(query):
            thrown = [said for said in browser.complaints if "exceptionDetails" in said]
            assert not thrown
            return browser.run(f"!!window.ready && location.search === '{query}'")

        def settled():
            before = picture()
            until(lambda: (before == (now := picture())).all() and now.std() > 10.0, 180.0)
            return before

        def picture():
            browser.run("new Promise((done) => setTimeout(done, 1000))")
            return browser.picture().astype(float)

        for page in ("5_avatar_in_three.html", "6_moving_splats.html"):
            browser.emulate(scheme="light", size=size, motion="reduce")
            browser.go(f"{address}/{page}")
            until(lambda: ready(""), 180.0)
            shown[page] = settled()
            browser.emulate(scheme="light", size=size)
            browser.go(f"{address}/{page}?moving")
            until(lambda: ready("?moving"), 180.0)
            until(lambda: np.abs(picture() - shown[page]).mean() > 1.0, 180.0)  # noqa: B023
    mesh, splats = shown.values()
    figure = np.abs(mesh - mesh[0, 0]).max(axis=2) > 30.0
    other = np.abs(splats - splats[0, 0]).max(axis=2) > 30.0
    assert 0.02 < figure.mean() < 0.5
    shared = (figure & other).sum() / (figure | other).sum()
    assert shared > 0.8  # 0.84 of a film of 64 px, 0 where nothing moves the splats
    assert np.abs(mesh - splats)[figure & other].mean() < 20.0
