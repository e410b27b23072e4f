"""Which captures are found in folders and manifests, and when one counts as changed."""

import json
import os
from pathlib import Path

import pytest

from apps.batching.capture_discovery import find_captures, parse_options
from capture.input_error import InputError


def touch(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("content")


def names(*places: object) -> list[str]:
    return [capture.name for capture in find_captures(map(str, places), {})]


def test_folders_videos_and_images_are_captures(tmp_path):
    touch(
        tmp_path / "anna" / "video.mp4", tmp_path / "anna" / "poses.npz",
        tmp_path / "anna" / "preview.webm", tmp_path / "anna" / "truth" / "video.mp4",
        tmp_path / "bob" / "images" / "0.png",
        tmp_path / "carl" / "0.jpg", tmp_path / "carl" / "1.jpg",
        tmp_path / "takes" / "one.mp4", tmp_path / "takes" / "two.mov",
        tmp_path / "dora.mp4", tmp_path / "notes.txt", tmp_path / ".hidden" / "x.mp4",
    )  # fmt: skip
    assert names(tmp_path) == ["anna", "bob", "carl", "dora", "takes-one", "takes-two"]
    assert names(tmp_path / "anna") == ["anna"]


def test_parts_beside_a_video_belong_to_the_video_of_their_name(tmp_path):
    touch(
        tmp_path / "anna.mp4", tmp_path / "anna_poses.npz", tmp_path / "anna.masks" / "0000.png",
        tmp_path / "anna.masks" / "0001.png", tmp_path / "bob.mp4", tmp_path / "bob.npz",
        tmp_path / "carl.mp4",
    )  # fmt: skip
    options = {capture.name: capture.options for capture in find_captures([str(tmp_path)], {})}
    assert options == {
        "anna": {"poses": f"{tmp_path}/anna_poses.npz", "masks": f"{tmp_path}/anna.masks"},
        "bob": {"poses": f"{tmp_path}/bob.npz"},
        "carl": {},
    }
    (alone,) = find_captures([str(tmp_path / "anna.mp4")], {})
    assert alone.options == options["anna"]


def test_rows_of_a_manifest_name_captures_and_options(tmp_path):
    touch(tmp_path / "films" / "a.mp4", tmp_path / "films" / "b.mp4", tmp_path / "poses.npz")
    table = tmp_path / "list.csv"
    table.write_text(
        "capture,name,poses,height-cm,refine_poses,cameras\n"
        "films/a.mp4,anna,poses.npz,171,no,static\nfilms/b.mp4,,,,,\n"
    )
    lines = tmp_path / "list.jsonl"
    lines.write_text(
        json.dumps({"capture": "films/a.mp4", "name": "carl", "steps": 7})
        + "\n\n" + json.dumps({"video": str(tmp_path / "films" / "b.mp4")}) + "\n"
    )  # fmt: skip
    found = {c.name: c for c in find_captures([str(table), str(lines)], {"steps": 5})}
    assert sorted(found) == ["anna", "b", "carl"]
    assert found["anna"].video == f"{tmp_path}/films/a.mp4"
    assert found["anna"].options == {
        "steps": 5, "poses": f"{tmp_path}/poses.npz", "height_cm": 171.0, "refine_poses": False,
        "cameras": "static",
    }  # fmt: skip
    assert found["carl"].options == {"steps": 7}
    assert found["b"].options == {"steps": 5}


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("name\nanna", "no capture"),
        ("capture,stepz\na.mp4,3", "'stepz' is no option"),
        ("capture,steps\na.mp4,many", "steps is 'many'"),
        ("capture,out\na.mp4,elsewhere", "'out' is no option"),
        ("capture\ngone.mp4", "gone.mp4 does not exist"),
    ],
)
def test_a_wrong_row_is_named(tmp_path, row, message):
    touch(tmp_path / "a.mp4")
    (tmp_path / "list.csv").write_text(row + "\n")
    with pytest.raises(InputError, match=message):
        find_captures([str(tmp_path / "list.csv")], {})


def test_names_are_unique_and_safe(tmp_path):
    touch(tmp_path / "a b" / "ü.mp4", tmp_path / "c" / "d.mp4", tmp_path / "c-d.mp4")
    assert names(tmp_path / "a b") == ["ü"]
    with pytest.raises(InputError, match="Two captures would be called c-d"):
        names(tmp_path)
    with pytest.raises(InputError, match="holds no capture"):
        names(tmp_path / "a b" / "nothing")


def test_a_capture_has_changed_if_a_file_or_an_option_has(tmp_path):
    touch(tmp_path / "anna" / "video.mp4", tmp_path / "anna" / "poses.npz")

    def keys(**options: object) -> tuple[str, str]:
        (found,) = find_captures([str(tmp_path)], options)
        return found.input_key, found.options_key

    first = keys(steps=5)
    assert keys(steps=5) == first
    assert keys(steps=5, threads=3) == first
    assert keys(steps=6)[1] != first[1]
    os.utime(tmp_path / "anna" / "poses.npz", ns=(1, 1))
    changed = keys(steps=5)
    assert changed[0] != first[0]
    assert changed[1] == first[1]


def test_flags_are_words_or_truths():
    given = {"mask-invert": "yes", "refine_poses": False, "seed": 3}
    assert parse_options(given, "here") == {"mask_invert": True, "refine_poses": False, "seed": 3}
