"""Where commands may write: places, a run's folder, its lock, and what is ours in it."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from apps import ingest
from apps.cli.command_line import CommandExit
from apps.cli.console import Console
from apps.cli.shared_options import (
    check_disjoint_from_inputs,
    check_output_file,
    check_writable,
    unused_path,
)
from apps.run import run_folder
from apps.run.run_folder import CHECKPOINT_FILES, LOCK_FILE_NAME, STATE_FILE, RunFolder, lock_folder
from avatar.training import checkpoint
from capture.atomic_files import OutputFileList, write_text_atomically
from capture.input_error import InputError


def listed(folder):
    """Names in a folder, but for the list."""
    return sorted(
        path.name for path in folder.iterdir() if path.name != OutputFileList(folder).path.name
    )


# --- places -----------------------------------------------------------------------------------


def test_a_place_that_cannot_be_written_to_is_named_before_any_work(tmp_path):
    check_writable(tmp_path / "new" / "run", "--out")
    (tmp_path / "report.json").write_text("{}")
    check_writable(tmp_path / "report.json", "--json")
    with pytest.raises(InputError, match=r"--out is .*report\.json is a file"):
        check_writable(tmp_path / "report.json" / "run", "--out")
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def test_a_folder_where_a_file_should_be_is_named_before_any_work(tmp_path):
    check_output_file(tmp_path / "new" / "report.json", "--json")
    with pytest.raises(InputError, match=r"--json is .* a folder"):
        check_output_file(tmp_path, "--json")
    assert not list(tmp_path.iterdir())


def test_tracked_poses_that_lie_in_the_way_are_found_before_any_work(tmp_path):
    run = RunFolder(path=tmp_path / "run")
    write_text_atomically(run.tracked_poses, "mine")
    with pytest.raises(InputError, match=r"tracking/poses\.npz was not written by ia-ingest"):
        run.check_usable([], resume=False, overwrite=True)
    run.tracked_poses.unlink()
    with pytest.raises(InputError, match="No run to --resume"):
        run.check_usable([], resume=True, overwrite=False)
    OutputFileList(run.tracking).create()  # Ctrl-C came while the person was tracked
    run.check_usable([], resume=True, overwrite=False)
    apart = tmp_path / "tracked"
    apart.mkdir()
    OutputFileList(apart).create()
    for name in ("poses.npz", "grade.json"):
        write_text_atomically(apart / name, "tracked")
    with pytest.raises(InputError, match="poses that ia-track wrote"):
        RunFolder(path=apart).check_usable([], resume=False, overwrite=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_for_reading_alone_is_named_before_any_work(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="is not writable"):
        check_writable(tmp_path / "new" / "run", "--out")
    tmp_path.chmod(0o700)


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="there is no /proc here")
def test_a_folder_that_cannot_be_made_is_found_before_any_work():
    with pytest.raises(InputError, match="is not writable"):
        RunFolder(path=Path("/proc/run")).check_usable([], resume=False, overwrite=False)
    with pytest.raises(InputError, match="is not writable"):
        check_output_file(Path("/proc/a.json"), "--json")


@pytest.mark.parametrize(
    ("out", "clash"),
    [
        ("capture", "is"), ("capture/.", "is"), ("link", "is"), ("capture/run", "lies in"),
        ("link/deep/run", "lies in"), ("capture/masks", "lies in"), (".", "contains"),
        ("", "contains"),
    ],
)  # fmt: skip
def test_an_output_folder_is_no_input_and_none_lies_in_the_other(tmp_path, out, clash):
    capture = tmp_path / "capture"
    (capture / "masks").mkdir(parents=True)
    (tmp_path / "link").symlink_to(capture)
    with pytest.raises(InputError, match=f" {clash} an input ") as caught:
        check_disjoint_from_inputs(tmp_path / out, "--out", [capture])
    advised = shlex.split(re.search(r"--out (\S+)$", str(caught.value))[1])[0]
    check_disjoint_from_inputs(Path(advised), "--out", [capture])
    assert not Path(advised).exists()


def test_what_is_advised_can_be_pasted_where_one_stands(tmp_path, monkeypatch):
    capture = tmp_path / "my capture"
    capture.mkdir()
    monkeypatch.chdir(capture)
    with pytest.raises(InputError, match=r"--out '\.\./my capture-run'$"):
        check_disjoint_from_inputs(Path(), "--out", [Path()])


def test_a_folder_beside_an_input_file_is_apart(tmp_path):
    (tmp_path / "video.mp4").write_bytes(b"film")
    check_disjoint_from_inputs(tmp_path / "run", "--out", [tmp_path / "video.mp4"])
    with pytest.raises(InputError, match="contains an input"):
        check_disjoint_from_inputs(tmp_path, "--out", [tmp_path / "video.mp4"])


def test_a_file_is_never_an_input_nor_read_as_a_part_of_one(tmp_path):
    capture = tmp_path / "capture"
    (capture / "runs").mkdir(parents=True)
    (capture / "poses.npz").write_bytes(b"poses")
    os.link(capture / "poses.npz", tmp_path / "hard.npz")
    (tmp_path / "soft.npz").symlink_to(capture / "poses.npz")
    inputs = [capture, capture / "poses.npz"]
    for name in ("capture/poses.npz", "hard.npz", "soft.npz", "capture/transforms.json"):
        with pytest.raises(InputError, match="input of this command"):
            check_output_file(tmp_path / name, "--json", inputs, overwrite=True)
    check_output_file(capture / "runs" / "sheet.png", "--sheet", inputs, overwrite=False)


def test_an_existing_file_is_replaced_only_on_request(tmp_path):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"film")
    with pytest.raises(InputError, match=r"--overwrite.*--out \S*clip-2\.mp4"):
        check_output_file(path, "--out", overwrite=False)
    check_output_file(path, "--out", overwrite=True)
    OutputFileList(tmp_path).create()
    with pytest.raises(InputError, match="--overwrite"):
        check_output_file(path, "--out", overwrite=False)
    path.unlink()
    write_text_atomically(path, "ours")
    check_output_file(path, "--out", overwrite=False)
    assert unused_path(path).name == "clip-2.mp4"


# --- a run's folder ---------------------------------------------------------------------------


def begun(folder, **given):
    """A run that has written its report and a checkpoint."""
    run = RunFolder(path=folder)
    run.start_run(resume=False)
    write_text_atomically(run.report_json, json.dumps(given))
    write_text_atomically(run.checkpoint / STATE_FILE, "learnt")
    return run


def test_the_names_of_a_checkpoint_are_those_that_are_written():
    names = {
        checkpoint.CHECKPOINT_FILE,
        "person.npz",
        "fit.npz",
        checkpoint.LAST_RUN_FILE,
        checkpoint.EARLIER_VIDEOS_FILE,
    }
    assert set(CHECKPOINT_FILES) == names
    assert checkpoint.CHECKPOINT_FILE == STATE_FILE


def test_a_run_folder_begins_empty_unless_it_is_resumed(tmp_path):
    run = begun(tmp_path / "run")
    (run.path / "notes.txt").write_text("mine")
    (run.checkpoint / "other.pt").write_text("mine")
    run.start_run(resume=True)
    assert run.has_checkpoint()
    assert "--resume" in run.describe_remaining_files()
    run.start_run(resume=False)
    assert listed(run.path) == ["checkpoint", "notes.txt"]
    assert listed(run.checkpoint) == ["other.pt"]


def test_an_empty_run_folder_is_removed(tmp_path):
    run, console = RunFolder(path=tmp_path / "runs" / "run"), Console()
    with run.claim(console, resume=False, overwrite=False):
        run.start_run(resume=False)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "run").mkdir()
    with RunFolder(path=tmp_path / "run").claim(console, resume=False, overwrite=False):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_resuming_and_overwriting_contradict(tmp_path):
    with pytest.raises(InputError, match="mutually exclusive"):
        RunFolder(path=tmp_path).check_usable([], resume=True, overwrite=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"):
        RunFolder(path=tmp_path / "file").check_usable([], resume=False, overwrite=False)


@pytest.mark.parametrize(
    "name",
    [
        "avatar.iavatar", "report.json", "report.html", "cameras.npz", "poses.npz", "checkpoint",
        "cameras", "checkpoint/state.pt", "checkpoint/person.npz", ".instant-avatar-files",
    ],
)  # fmt: skip
@pytest.mark.parametrize("given", ["", "resume", "overwrite"])
def test_a_foreign_file_with_a_runs_name_is_refused(tmp_path, name, given):
    path = tmp_path / "run" / name
    path.parent.mkdir(parents=True)
    path.write_bytes(b"mine")
    run = RunFolder(path=tmp_path / "run")
    with pytest.raises(InputError, match=re.escape(str(path))):
        run.check_usable([], resume=given == "resume", overwrite=given == "overwrite")
    assert path.read_bytes() == b"mine"


def test_a_file_that_was_changed_counts_as_foreign(tmp_path):
    run = begun(tmp_path)
    run.check_usable([], resume=True, overwrite=False)
    run.report_json.write_text("notes of mine")
    for resume in (True, False):
        with pytest.raises(InputError, match=r"report\.json was not written by ia-ingest"):
            run.check_usable([], resume=resume, overwrite=not resume)
    with pytest.raises(InputError, match="was kept"):
        run.remove(run.report_json)
    assert run.report_json.read_text() == "notes of mine"


def test_resuming_needs_a_run(tmp_path):
    begun(tmp_path / "walk")
    with pytest.raises(InputError, match=r"No run to --resume.*mean --out \S*walk\?"):
        RunFolder(path=tmp_path / "wakl").check_usable([], resume=True, overwrite=False)
    run = RunFolder(path=tmp_path / "killed")
    run.start_run(resume=False)  # and killed before its first checkpoint
    run.check_usable([], resume=True, overwrite=False)
    run = RunFolder(path=tmp_path / "killed earlier")
    with run.claim(Console(), resume=False, overwrite=False):
        run.check_usable([], resume=True, overwrite=False)


def test_resuming_a_name_that_was_mistyped_is_an_error(film, tmp_path, capsys):
    assert ingest.main([str(film), "--out", str(tmp_path / "typo"), "--resume"]) == 2
    assert "No run to --resume in" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


# --- its lock ---------------------------------------------------------------------------------


def test_a_second_run_into_a_folder_is_refused_while_the_first_goes_on(film, tmp_path, capsys):
    with lock_folder(tmp_path, Console()):
        assert ingest.main([str(film), "--out", str(tmp_path), "--overwrite"]) == 3
    said = " ".join(capsys.readouterr().err.split())
    assert f"process {os.getpid()}, since 2" in said
    assert "--out" in said
    with lock_folder(tmp_path, Console()):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_killed_run_holds_its_folder_no_longer(tmp_path):
    code = (
        "import os, pathlib, sys\n"
        "from apps.run.run_folder import lock_folder\n"
        "from apps.cli.console import Console\n"
        "with lock_folder(pathlib.Path(sys.argv[1]), Console()): print('held', flush=True); input()"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        with (
            pytest.raises(CommandExit, match=f"process {process.pid}"),
            lock_folder(tmp_path, Console()),
        ):
            pass
        process.kill()
    assert (tmp_path / LOCK_FILE_NAME).exists()
    with lock_folder(tmp_path, Console()):
        assert f"process {os.getpid()}" in (tmp_path / LOCK_FILE_NAME).read_text()
    assert not (tmp_path / LOCK_FILE_NAME).exists()


def test_a_foreign_file_is_not_taken_for_a_lock(tmp_path):
    (tmp_path / LOCK_FILE_NAME).write_text("mine")
    with pytest.raises(InputError, match="not a lock"), lock_folder(tmp_path, Console()):
        pass
    assert (tmp_path / LOCK_FILE_NAME).read_text() == "mine"


def test_without_locks_a_run_warns_and_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "fcntl", None)
    console = Console()
    with lock_folder(tmp_path, console):
        pass
    assert "no locks" in console.warnings[0]
    assert list(tmp_path.iterdir()) == []
