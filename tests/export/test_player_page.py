"""The page's files: what they hold, what they refuse, and that they come from nowhere else."""

import re
import zlib

import numpy as np
import pytest

from capture.input_error import InputError
from export import player_page
from preprocess.poses.pose_format_registry import read_poses
from tests.motions import make_motion


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder with all of onnxruntime-web's files; what is in them is of no matter here."""
    folder = tmp_path_factory.mktemp("runtime")
    for name in (*player_page.TARBALL_MEMBERS, *player_page.LICENCE_FILES):
        (folder / name).write_bytes(name.encode())
    return folder


@pytest.fixture
def motion(bent):
    """Three poses, of which the tracker lost the second."""
    share = np.array([0.5, 1.0, 0.8])[:, None]
    joints, valid = share[:, None] * bent.joint_rotations, np.array([True, False, True])
    roots, places = share * bent.root_rotation, share * bent.root_translation
    return make_motion(roots, places, joints, valid=valid)


@pytest.fixture
def files(exported, motion, kept, monkeypatch):
    monkeypatch.setattr(player_page, "RUNTIME_FOLDER", kept)
    return player_page.build_page(
        exported.path,
        {"Given": player_page.encode_motion(motion, 25.0), "Turn": b"turn"},
        name="<an avatar>",
    )


def test_the_page_holds_the_package_and_the_valid_poses(files, exported, motion, tmp_path):
    assert files["avatar.iavatar"] == exported.path.read_bytes()
    assert b"<title>&lt;an avatar&gt;</title>" in files["index.html"]
    assert zlib.decompress(files["runtime/ort.wasm.zlib"]) == b"ort.wasm"
    options = '<option value="motion.npz">Given</option><option value="turn.npz">Turn</option>'
    assert options in files["index.html"].decode()
    assert files["turn.npz"] == b"turn"
    path = tmp_path / "motion.npz"
    path.write_bytes(files["motion.npz"])
    with np.load(path) as held:
        assert held["fps"] == 25.0
    again = read_poses(path)
    chosen = motion.select_rows(np.array([0, 2]))
    for field in ("root_rotations", "root_translations", "joint_rotations"):
        np.testing.assert_allclose(getattr(again, field), getattr(chosen, field), atol=1e-6)


def test_the_page_loads_nothing_from_other_hosts(files):
    own = {name: text for name, text in files.items() if name.endswith(player_page.PAGE_SUFFIXES)}
    own = {name: text for name, text in own.items() if not name.startswith("runtime/")}
    assert {"index.html", "ia-avatar.js", "graph_worker.js"} <= own.keys()
    for name, content in own.items():
        found = set(re.findall(r"(?:https?:)?//[\w.-]+\.\w+", content.decode()))
        assert found <= {"http://www.w3.org"}, (
            name
        )  # the XML namespace of SVG, which is not fetched
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', own["index.html"].decode())
    assert "default-src 'none'" in policy.group(1)
    assert "http" not in policy.group(1)


def test_every_file_that_the_page_names_is_there(files):
    scripts = {name: text.decode() for name, text in files.items() if name.endswith(".js")}
    for name, script in scripts.items():
        named = re.findall(r'(?:from|import|URL)\s*\(?\s*"\./([\w./-]+)"', script)
        assert set(named) <= files.keys(), name
    named = re.findall(r'(?:src|href|motion)="([^"]+)"', files["index.html"].decode())
    assert set(named) <= files.keys()
    assert {"runtime/LICENSE", "runtime/ThirdPartyNotices.txt"} <= files.keys()


def test_a_missing_runtime_is_refused_with_the_command_to_run(tmp_path, monkeypatch):
    monkeypatch.setattr(player_page, "RUNTIME_FOLDER", tmp_path)
    with pytest.raises(InputError, match=r"instant_avatar\.animation\.web_server"):
        player_page.runtime_files()


def test_an_altered_tarball_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(player_page, "RUNTIME_FOLDER", tmp_path / "runtime")
    with pytest.raises(InputError, match="Nothing was kept"):
        player_page.install_runtime(b"something else")
    assert list(tmp_path.iterdir()) == []


def test_what_changes_with_every_picture_is_not_read_aloud():
    """An <output> is a live region, which a screen reader would speak of all the time."""
    page = player_page.static_page_files()["index.html"].decode()
    outputs = re.findall(r"<output[^>]*>", page)
    assert len(outputs) == 2
    assert all('aria-live="off"' in each for each in outputs)


def test_the_runtime_is_kept_outside_of_the_installation():
    """`pip uninstall` would leave it behind there, and it may not be writable."""
    assert player_page.WEB not in player_page.RUNTIME_FOLDER.parents
    assert "instant-avatar-stream" in player_page.RUNTIME_FOLDER.parts
