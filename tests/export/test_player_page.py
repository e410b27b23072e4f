"""The page's files: what they hold, what they refuse, and that they come from nowhere else."""

import json
import re
import zlib

import numpy as np
import pytest

from capture.input_error import InputError
from export import player_page
from export.package.package_file import read_package
from export.player_inputs import graph_initializers
from export.player_page import PageMotion, StartView, flatten_pose


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder with all of onnxruntime-web's files; what is in them is of no matter here."""
    folder = tmp_path_factory.mktemp("runtime")
    for name in (*player_page.TARBALL_MEMBERS, *player_page.LICENCE_FILES):
        (folder / name).write_bytes(name.encode())
    return folder


@pytest.fixture
def clip(bent):
    return PageMotion(
        poses=np.stack([flatten_pose(bent)] * 3),
        fps=25.0,
        start_view=StartView(axes=np.diag([1.0, -1.0, -1.0]), height_m=1.7, middle_m=-0.1),
    )


@pytest.fixture
def files(exported, clip, kept, monkeypatch):
    monkeypatch.setattr(player_page, "RUNTIME_FOLDER", kept)
    return player_page.build_page(exported.path, clip, name="an avatar")


def unpacked(files, entry):
    """An array as the page reads it."""
    dtype = np.dtype(entry["dtype"]).newbyteorder("<")
    planes = np.frombuffer(zlib.decompress(files[entry["file"]]), dtype=np.uint8)
    elements = np.ascontiguousarray(planes.reshape(dtype.itemsize, -1).T)
    return elements.view(dtype).reshape(entry["shape"])


def test_every_array_comes_back_as_it_was(files, exported, clip):
    package, told = read_package(exported.path), json.loads(files["avatar.json"])
    assert set(told["tiers"]) == set(package.manifest.tiers)
    tables = {entry["name"]: unpacked(files, entry) for entry in told["tiers"]["hq"]["tables"]}
    expected = graph_initializers(package.tables["hq"], package.manifest.tiers["hq"].settings)
    assert tables.keys() == expected.keys()
    for name, array in expected.items():
        assert tables[name].dtype == array.dtype
        np.testing.assert_array_equal(tables[name], array)
    graph = unpacked(files, told["tiers"]["hq"]["graph"])
    assert graph.tobytes() == package.graphs["hq"]
    np.testing.assert_array_equal(unpacked(files, told["motion"]["poses"]), clip.poses)
    for golden, picture in zip(told["golden"], package.golden, strict=True):
        np.testing.assert_array_equal(unpacked(files, golden["picture"]), picture)
    for entry in told["tiers"]["hq"]["tables"]:
        assert entry["bytes"] == len(files[entry["file"]])


def test_the_page_loads_nothing_from_other_hosts(files):
    own = {name: text for name, text in files.items() if not name.startswith(("data/", "runtime/"))}
    assert {"index.html", "avatar.json", "graph_worker.js"} <= own.keys()
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
        named = re.findall(r'(?:from|import|URL)\s*\(?\s*"\./([\w./]+)"', script)
        assert set(named) <= files.keys(), name
    named = re.findall(r'(?:src|href)="([^"]+)"', files["index.html"].decode())
    assert set(named) <= files.keys()
    assert {"runtime/LICENSE", "runtime/ThirdPartyNotices.txt"} <= files.keys()


def test_a_missing_runtime_is_refused_with_the_command_to_run(tmp_path):
    with pytest.raises(InputError, match=r"instant_avatar\.animation\.web_server"):
        player_page.runtime_files(tmp_path)


def test_an_altered_tarball_is_refused_and_leaves_nothing(tmp_path):
    folder = tmp_path / "runtime"
    with pytest.raises(InputError, match="Nothing was kept"):
        player_page.install_runtime(b"something else", folder)
    assert not folder.exists()


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
