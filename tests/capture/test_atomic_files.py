"""Files and folders that appear whole or not at all, and markers of those that are ours."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from capture.atomic_files import (
    HEADER,
    LIST_NAME,
    OutputFileList,
    atomic_file,
    atomic_folder,
    write_text_atomically,
)
from capture.input_error import InputError


def names(folder):
    """Names of all files in a folder but its marker, at any depth."""
    files = (str(p.relative_to(folder)) for p in folder.rglob("*") if not p.is_dir())
    return sorted(name for name in files if Path(name).name != LIST_NAME)


def write_half(atomic, path, name=""):
    """Fail in the middle of writing."""
    with atomic(path) as part:
        (part / name).write_bytes(b"half")
        raise KeyboardInterrupt


def test_a_file_appears_when_it_is_whole_and_one_that_fails_leaves_the_older(tmp_path):
    path = tmp_path / "deep" / "report.json"
    write_text_atomically(path, "old")
    with pytest.raises(KeyboardInterrupt):
        write_half(atomic_file, path)
    assert names(tmp_path) == ["deep/report.json"]
    with atomic_file(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
        assert part.suffix == path.suffix
    assert path.read_text() == "new"
    assert os.listdir(path.parent) == ["report.json"]


def test_a_folder_that_fails_leaves_the_older_one(tmp_path):
    path = tmp_path / "frames"
    with atomic_folder(path) as part:
        (part / "0000.png").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write_half(atomic_folder, path, "0000.png")
    assert (path / "0000.png").read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["frames"]


def test_a_link_stays_and_what_it_points_to_is_replaced(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "frames").symlink_to(tmp_path / "far")
    for name in ("old.png", "new.png"):
        with atomic_folder(tmp_path / "frames") as part:
            (part / name).write_text("ours")
    assert (tmp_path / "frames").is_symlink()
    assert names(tmp_path / "far") == ["new.png"]
    (tmp_path / "a.json").symlink_to(tmp_path / "b.json")
    write_text_atomically(tmp_path / "a.json", "{}")
    assert (tmp_path / "a.json").is_symlink()
    assert (tmp_path / "b.json").read_text() == "{}"
    assert set(os.listdir(tmp_path)) == {"a.json", "b.json", "far", "frames"}


def test_figures_can_go_to_stdout_and_no_device_is_ever_replaced(capfd, tmp_path):
    stdout = Path("/dev/stdout")
    if not stdout.exists():
        pytest.skip("there is no /dev/stdout here")
    write_text_atomically(stdout, "figures\n")
    assert capfd.readouterr().out == "figures\n"
    os.mkfifo(tmp_path / "pipe.png")
    for device in (Path(os.devnull), stdout, tmp_path / "pipe.png"):
        with pytest.raises(InputError, match="device or a pipe"), atomic_file(device):
            pass
    assert os.listdir(tmp_path) == ["pipe.png"]


# --- what is ours -----------------------------------------------------------------------------


@pytest.fixture
def marker(tmp_path):
    made = OutputFileList(tmp_path)
    made.create()
    return made


def test_in_a_marked_folder_only_what_was_written_there_is_replaced_or_removed(tmp_path, marker):
    (tmp_path / "poses.npz").write_text("mine")
    for content in ("one", "two"):
        write_text_atomically(tmp_path / "report.json", content)
    with pytest.raises(InputError, match=r"poses\.npz is there already"):
        write_text_atomically(tmp_path / "poses.npz", "ours")
    assert not marker.remove("poses.npz")
    shutil.copytree(tmp_path, tmp_path / "copy")
    assert OutputFileList(tmp_path / "copy").remove("report.json")
    assert names(tmp_path) == ["copy/poses.npz", "poses.npz", "report.json"]
    assert (tmp_path / "poses.npz").read_text() == "mine"


def test_without_a_marker_the_caller_says_what_may_go(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("mine")
    with pytest.raises(InputError, match="left alone"):
        write_text_atomically(path, "ours", replace=False)
    assert path.read_text() == "mine"
    write_text_atomically(path, "ours", replace=True)
    assert path.read_text() == "ours"


def test_a_file_that_comes_while_ours_is_written_stays(tmp_path, marker):
    with pytest.raises(InputError, match="left alone"), atomic_file(tmp_path / "poses.npz"):
        (tmp_path / "poses.npz").write_bytes(b"mine")
    assert (tmp_path / "poses.npz").read_bytes() == b"mine"
    assert names(tmp_path) == ["poses.npz"]


def test_a_folder_with_one_strange_file_is_never_replaced(tmp_path):
    out = tmp_path / "frames"

    def write(content):
        with atomic_folder(out) as part:
            (part / "deep").mkdir()
            (part / "deep" / "0000.png").write_bytes(content)

    write(b"one")
    write(b"two")
    assert names(tmp_path) == ["frames/deep/0000.png"]
    for strange in ("mine.txt", "deep/0001.png"):
        (out / strange).write_bytes(b"mine")
        with pytest.raises(InputError, match=strange):
            write(b"three")
        assert (out / strange).read_bytes() == b"mine"
        (out / strange).unlink()
    with pytest.raises(InputError, match=r"mine\.txt"), atomic_folder(out):
        (out / "mine.txt").write_bytes(b"mine")
    assert names(tmp_path) == ["frames/deep/0000.png", "frames/mine.txt"]


def test_a_marker_of_others_is_not_written_to_and_names_nothing_outside_its_folder(tmp_path):
    (tmp_path / LIST_NAME).write_text("milk, eggs")
    with pytest.raises(InputError, match=LIST_NAME):
        OutputFileList(tmp_path).create()
    assert (tmp_path / LIST_NAME).read_text() == "milk, eggs"
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / "deep").mkdir()
    lines = b'\n{"name": "../mine.txt"}\n{"name": "%s"}' % bytes(tmp_path / "mine.txt")
    (tmp_path / "deep" / LIST_NAME).write_bytes(HEADER + lines)
    OutputFileList(tmp_path / "deep").remove_all()
    assert names(tmp_path) == ["mine.txt"]


def test_a_line_that_was_cut_short_costs_only_itself(tmp_path, marker):
    write_text_atomically(tmp_path / "a.json", "{}")
    with marker.path.open("ab") as file:
        file.write(b'\n{"name": "b.js')
    write_text_atomically(tmp_path / "c.json", "{}")
    assert marker.names() == {"a.json", "c.json"}


def test_what_a_killed_process_left_half_written_goes(tmp_path, marker):
    code = (
        "import os, pathlib, sys; from capture.atomic_files import atomic_file\n"
        "with atomic_file(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.iavatar")], check=False)
    (tmp_path / ".a.mine.part.iavatar").write_bytes(b"mine")
    with atomic_file(tmp_path / "b.iavatar") as ours:
        assert len(names(tmp_path)) == 3
        marker.remove_temporaries()
        assert names(tmp_path) == sorted([".a.mine.part.iavatar", ours.name])
    assert names(tmp_path) == [".a.mine.part.iavatar", "b.iavatar"]


def test_a_marker_alone_goes_and_with_it_nothing_else(tmp_path, marker):
    (tmp_path / "mine.txt").write_text("mine")
    marker.remove_if_empty()
    assert marker.exists()
    (tmp_path / "mine.txt").unlink()
    marker.remove_if_empty()
    assert os.listdir(tmp_path) == []
