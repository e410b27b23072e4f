import shlex

import pytest

from instant_avatar import sample


def run(*arguments):
    """Exit code of `ia-sample` with these arguments."""
    try:
        return sample.main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return stop.code


def test_it_films_says_what_comes_next_and_replaces_its_own_folder_on_request(tmp_path, capsys):
    out = tmp_path / "my [c]" / ("long" * 30)
    words = (out, "--frames", 2, "--size", 32, "--background", "plain")
    assert run(*words) == 0
    assert (out / "video.mp4").exists()
    command = capsys.readouterr().err.splitlines()[-1]
    assert shlex.split(command) == [
        "ia-ingest", str(out / "video.mp4"), "--poses", str(out / "poses.npz")
    ]  # fmt: skip
    assert run(*words) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run(*words, "--overwrite") == 0


def test_a_capture_like_a_phones_names_no_preview(tmp_path, capsys):
    assert run(tmp_path / "c", "--like-a-phone", "--frames", 2, "--size", 36) == 0
    printed = capsys.readouterr().err
    assert "preview" not in printed
    assert "--poses" in printed
    assert (tmp_path / "c" / "truth" / "body.npz").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--frames", "0"), ("--size", "3"), ("--fps", "nan"), ("--mask-noise-px", "-1")],
)
def test_numbers_out_of_range_are_named(tmp_path, capsys, option, value):
    assert run(tmp_path / "c", option, value) == 2
    assert option in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
