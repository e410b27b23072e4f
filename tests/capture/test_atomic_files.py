"""Files and folders that appear whole or not at all, and lists of those that are ours."""

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
    """Of all files in a folder but its list, at any depth."""
    found = (str(p.relative_to(folder)) for p in folder.rglob("*") if not p.is_dir())
    return sorted(name for name in found if Path(name).name != LIST_NAME)


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "deep" / "report.json"
    write_text_atomically(path, "old")
    with atomic_file(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
        assert part.suffix == path.suffix
    assert path.read_text() == "new"
    assert [file.name for file in path.parent.iterdir()] == ["report.json"]


def test_a_file_that_fails_leaves_the_older_one(tmp_path):
    path = tmp_path / "report.json"
    write_text_atomically(path, "old")

    def fails():
        with atomic_file(path) as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fails()
    assert path.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["report.json"]


def test_a_folder_that_fails_leaves_the_older_one(tmp_path):
    path = tmp_path / "frames"
    with atomic_folder(path) as part:
        (part / "0000.png").write_bytes(b"old")

    def fails():
        with atomic_folder(path) as part:
            (part / "0000.png").write_bytes(b"half")
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        fails()
    assert (path / "0000.png").read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["frames"]


def test_a_link_stays_and_what_it_points_to_is_replaced(tmp_path):
    (tmp_path / "far").mkdir()
    (tmp_path / "frames").symlink_to(tmp_path / "far")
    with atomic_folder(tmp_path / "frames") as part:
        (part / "old.png").write_text("old")
    with atomic_folder(tmp_path / "frames") as part:
        (part / "new.png").write_text("new")
    assert (tmp_path / "frames").is_symlink()
    assert names(tmp_path / "far") == ["new.png"]
    (tmp_path / "a.json").symlink_to(tmp_path / "b.json")
    write_text_atomically(tmp_path / "a.json", "{}")
    assert (tmp_path / "a.json").is_symlink()
    assert (tmp_path / "b.json").read_text() == "{}"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.json", "b.json", "far", "frames"]


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
    assert [file.name for file in tmp_path.iterdir()] == ["pipe.png"]


# --- what is ours -----------------------------------------------------------------------------


@pytest.fixture
def listing(tmp_path):
    made = OutputFileList(tmp_path)
    made.create()
    return made


def test_a_listed_file_is_ours_until_it_is_changed(tmp_path, listing):
    path = tmp_path / "report.json"
    write_text_atomically(path, "one")
    assert listing.owns("report.json")
    write_text_atomically(path, "two")
    assert path.read_text() == "two"
    path.write_text("mine now")
    assert not listing.owns("report.json")
    with pytest.raises(InputError, match=r"report\.json is there already"):
        write_text_atomically(path, "three")
    assert not listing.remove("report.json")
    assert path.read_text() == "mine now"
    assert names(tmp_path) == ["report.json"]


def test_a_copied_folder_still_knows_its_files(tmp_path, listing):
    write_text_atomically(tmp_path / "a.json", "{}")
    shutil.copytree(tmp_path, tmp_path / "copy", copy_function=shutil.copyfile)
    assert OutputFileList(tmp_path / "copy").remove("a.json")
    assert names(tmp_path) == ["a.json"]


def test_without_a_list_the_caller_says_what_may_go(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("mine")
    with pytest.raises(InputError, match="left alone"):
        write_text_atomically(path, "ours", replace=False)
    assert path.read_text() == "mine"
    write_text_atomically(path, "ours", replace=True)
    assert path.read_text() == "ours"
    assert [file.name for file in tmp_path.iterdir()] == ["a.json"]


def test_a_file_that_comes_while_ours_is_written_stays(tmp_path, listing):
    def races():
        with atomic_file(tmp_path / "poses.npz") as part:
            part.write_bytes(b"ours")
            (tmp_path / "poses.npz").write_bytes(b"mine")

    with pytest.raises(InputError, match="left alone"):
        races()
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
    for strange in ("mine.txt", "deep/0001.png", "deep/0000.png", "empty/"):
        path = out / strange
        if strange.endswith("/"):
            path.mkdir()
        else:
            path.write_bytes(b"mine")
        with pytest.raises(InputError, match=strange.rstrip("/")):
            write(b"three")
        assert path.is_dir() or path.read_bytes() == b"mine"
        if path.is_dir():
            path.rmdir()
        elif strange == "deep/0000.png":
            path.write_bytes(b"two")
        else:
            path.unlink()
    write(b"four")
    assert (out / "deep" / "0000.png").read_bytes() == b"four"


def test_what_comes_into_a_folder_that_is_being_replaced_is_not_lost(tmp_path):
    out = tmp_path / "frames"

    def write(strange=None):
        with atomic_folder(out) as part:
            (part / "0000.png").write_bytes(b"ours")
            if strange is not None:
                (out / strange).write_bytes(b"mine")

    write()
    with pytest.raises(InputError, match=r"mine\.txt"):
        write("mine.txt")
    assert names(tmp_path) == ["frames/0000.png", "frames/mine.txt"]


def test_a_foreign_list_is_not_written_to(tmp_path):
    (tmp_path / LIST_NAME).write_text("milk, eggs")
    with pytest.raises(InputError, match="not a list"):
        OutputFileList(tmp_path).create()
    write_text_atomically(tmp_path / "a.json", "{}")
    assert (tmp_path / LIST_NAME).read_text() == "milk, eggs"


def test_a_line_that_was_cut_short_costs_only_itself(tmp_path, listing):
    write_text_atomically(tmp_path / "a.json", "{}")
    with listing.path.open("ab") as file:
        file.write(b'\n{"name": "b.js')
    write_text_atomically(tmp_path / "c.json", "{}")
    assert listing.owns("a.json")
    assert listing.owns("c.json")
    assert listing.path.read_bytes().startswith(HEADER)


def test_what_a_killed_process_left_half_written_goes(tmp_path, listing):
    code = (
        "import os, pathlib, sys; from capture.atomic_files import atomic_file\n"
        "with atomic_file(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.iavatar")], check=False)
    (tmp_path / ".a.mine.part.iavatar").write_bytes(b"mine")
    with atomic_file(tmp_path / "b.iavatar") as ours:
        assert len(names(tmp_path)) == 3
        listing.remove_temporaries()
        assert names(tmp_path) == sorted([".a.mine.part.iavatar", ours.name])
    assert names(tmp_path) == [".a.mine.part.iavatar", "b.iavatar"]


def test_a_list_alone_goes_and_with_it_nothing_else(tmp_path, listing):
    (tmp_path / "mine.txt").write_text("mine")
    listing.remove_if_empty()
    assert listing.exists()
    (tmp_path / "mine.txt").unlink()
    listing.remove_if_empty()
    assert list(tmp_path.iterdir()) == []
