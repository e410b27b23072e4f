import errno
import sys

import pytest

from apps import sample


def run(monkeypatch, *arguments):
    """Exit code of `ia-sample` with these arguments."""
    monkeypatch.setattr(sys, "argv", ["ia-sample", *map(str, arguments)])
    try:
        sample.main()
    except SystemExit as stop:
        return stop.code
    return 0


def test_it_films_and_says_what_comes_next(monkeypatch, tmp_path, capsys):
    out = tmp_path / "c"
    assert run(monkeypatch, out, "--frames", 2, "--size", 32, "--background", "plain") == 0
    assert (out / "video.mp4").exists()
    assert "ia-ingest" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value"),
    [("--frames", "0"), ("--size", "3"), ("--fps", "nan"), ("--mask-noise-px", "-1")],
)
def test_numbers_out_of_range_are_named(monkeypatch, tmp_path, capsys, option, value):
    assert run(monkeypatch, tmp_path / "c", option, value) == 2
    assert option in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_refused_with_advice(monkeypatch, tmp_path, capsys):
    (tmp_path / "poses.npz").write_bytes(b"")
    assert run(monkeypatch, tmp_path, "--frames", 1, "--size", 32) == 2
    assert "--overwrite" in " ".join(capsys.readouterr().err.split())


def test_unknown_subjects_are_bad_input(monkeypatch, tmp_path):
    assert run(monkeypatch, tmp_path / "c", "--subject", 3) == 2


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), 130),
        (OSError(errno.ENOSPC, "No space left on device"), 3),
        (PermissionError(errno.EACCES, "Permission denied"), 2),
    ],
)
def test_what_goes_wrong_has_an_exit_code(monkeypatch, tmp_path, error, code):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(sample, "shoot", fail)
    assert run(monkeypatch, tmp_path / "c") == code
