"""Which captures are found in folders and tables, and when one counts as changed."""

import os
from pathlib import Path

import pytest

from capture.input_error import InputError
from instant_avatar.batching.capture_discovery import find_captures


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("content")


def names(*places: object) -> list[str]:
    return [capture.name for capture in find_captures(map(str, places))]


def test_folders_videos_and_images_are_captures(tmp_path):
    touch(
        tmp_path / "anna" / "video.mp4", tmp_path / "anna" / "poses.npz",
        tmp_path / "anna" / "preview.mp4", tmp_path / "anna" / "truth" / "video.mp4",
        tmp_path / "bob" / "images" / "0.png",
        tmp_path / "carl" / "0.jpg", tmp_path / "carl" / "1.jpg",
        tmp_path / "takes" / "one.mp4", tmp_path / "takes" / "two.mov",
        tmp_path / "takes" / "masks" / "0.png", tmp_path / "takes" / "masks" / "1.png",
        tmp_path / "eve" / "video.mp4", tmp_path / "dora.mp4", tmp_path / "notes.txt",
        tmp_path / ".hidden" / "x.mp4",
    )  # fmt: skip
    (tmp_path / "linked").symlink_to(tmp_path / "bob")
    assert names(tmp_path) == [
        "anna", "bob", "carl", "dora", "eve", "linked", "takes-one", "takes-two",
    ]  # fmt: skip
    assert names(tmp_path / "anna") == ["anna"]
    assert names(tmp_path / "dora.mp4") == ["dora"]


def test_rows_of_a_table_name_captures_and_options(tmp_path, monkeypatch):
    touch(tmp_path / "films" / "a.mp4", tmp_path / "films" / "b.mp4", tmp_path / "poses.npz")
    (tmp_path / "list.csv").write_text(
        "capture,name,poses,height-cm,refine_poses,mask-invert,cameras\n"
        "films/a.mp4,anna,poses.npz,171,no,yes,static\nfilms/b.mp4,,,,,,\n"
    )
    monkeypatch.chdir(tmp_path)
    anna, b = find_captures(["list.csv"], ["--steps", "5", "--body=body.npz"])
    assert (anna.name, anna.video) == ("anna", f"{tmp_path}/films/a.mp4")
    body = {"--body": f"{tmp_path}/body.npz"}
    assert anna.paths == {**body, "--poses": f"{tmp_path}/poses.npz", "--cameras": "static"}
    own = ("--height-cm", "171", "--no-refine-poses", "--mask-invert")
    assert anna.options == ("--steps", "5", *own)
    assert (b.name, b.paths, b.options) == ("b", body, ("--steps", "5"))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("name\nanna", "no capture"),
        ("capture,stepz\na.mp4,3", "stepz"),
        ("capture,steps\na.mp4,many", "many"),
        ("capture,steps\na.mp4,0", "--steps"),
        ("capture,out\na.mp4,elsewhere", "--out"),
        ("capture\na.mp4,more", "more"),
        ("capture\ngone.mp4", "gone.mp4"),
    ],
)
def test_a_wrong_row_is_named(tmp_path, row, message):
    touch(tmp_path / "a.mp4")
    (tmp_path / "list.csv").write_text(row + "\n")
    with pytest.raises(InputError, match=f"row 1.*{message}"):
        find_captures([str(tmp_path / "list.csv")])


def test_names_are_unique_and_safe(tmp_path):
    touch(tmp_path / "a b" / "ü x.mp4", tmp_path / "c" / "d.mp4", tmp_path / "c-d.mp4")
    assert names(tmp_path / "a b") == ["ü-x"]
    with pytest.raises(InputError, match="c-d"):
        names(tmp_path)
    with pytest.raises(InputError, match="holds no capture"):
        names(tmp_path / "a b" / "nothing")


def test_a_capture_has_changed_if_a_file_or_an_option_has(tmp_path):
    touch(tmp_path / "anna" / "video.mp4", tmp_path / "anna" / "poses.npz")

    def keys(*words: str) -> tuple[str, str]:
        (capture,) = find_captures([str(tmp_path)], words)
        return capture.input_key, capture.options_key

    first = keys("--steps", "5")
    assert keys("--steps=5", "--threads", "3", "--force") == first
    assert keys("--steps", "6")[1] != first[1]
    assert keys("--steps", "5", "--body", "b.npz")[1] != first[1]
    os.utime(tmp_path / "anna" / "poses.npz", ns=(1, 1))
    changed = keys("--steps", "5")
    assert changed[0] != first[0]
    assert changed[1] == first[1]
