"""Where commands may write: single files, a run's folder, and its lock."""

import json
import os
from pathlib import Path

import pytest

from avatar.training import checkpoint
from capture.atomic_files import write_text_atomically
from capture.input_error import InputError
from instant_avatar import ingest
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import (
    check_output_file,
    check_writable,
    unused_path,
)
from instant_avatar.run.run_folder import (
    CHECKPOINT_FILES,
    STATE_FILE,
    RunFolder,
    claim_folder,
)


def test_a_place_that_cannot_be_written_to_is_named_before_any_work(tmp_path):
    check_writable(tmp_path / "new" / "run", "--out")
    (tmp_path / "report.json").write_text("{}")
    check_writable(tmp_path / "report.json", "--json")
    with pytest.raises(InputError, match=r"--out is .*report\.json is a file"):
        check_writable(tmp_path / "report.json" / "run", "--out")
    with pytest.raises(InputError, match=r"--json is .* a folder"):
        check_output_file(tmp_path, "--json")
    if Path("/proc/self").exists():
        with pytest.raises(InputError, match="is not writable"):
            check_output_file(Path("/proc/a.json"), "--json")
    assert os.listdir(tmp_path) == ["report.json"]


def test_an_existing_file_is_replaced_only_on_request(tmp_path):
    path = tmp_path / "clip.mp4"
    path.write_bytes(b"film")
    with pytest.raises(InputError, match=r"--overwrite.*--out \S*clip-2\.mp4"):
        check_output_file(path, "--out")
    check_output_file(path, "--out", overwrite=True)
    assert unused_path(path).name == "clip-2.mp4"


# --- a run's folder ---------------------------------------------------------------------------


def begun(folder):
    """A run that has written its report and a checkpoint."""
    run = RunFolder(path=folder)
    run.start_run(resume=False)
    write_text_atomically(run.report_json, json.dumps({}))
    write_text_atomically(run.checkpoint / STATE_FILE, "learnt")
    return run


def check(run, flag=""):
    """Check that a run with one of the flags may be written there."""
    run.check_usable([], resume=flag == "resume", overwrite=flag == "overwrite")


def test_the_names_of_a_checkpoint_are_those_that_are_written():
    assert checkpoint.CHECKPOINT_FILE == STATE_FILE
    assert set(CHECKPOINT_FILES) == {
        checkpoint.CHECKPOINT_FILE, "person.npz", "fit.npz", checkpoint.LAST_RUN_FILE,
        checkpoint.EARLIER_VIDEOS_FILE,
    }  # fmt: skip


def test_an_empty_run_folder_is_removed_and_one_of_the_user_stays(tmp_path):
    (tmp_path / "mine").mkdir()
    for name in ("runs/run", "mine"):
        run = RunFolder(path=tmp_path / name)
        with run.claim(Console(), resume=False, overwrite=False):
            run.start_run(resume=False)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("flag", ["", "resume", "overwrite"])
def test_a_folder_with_files_of_others_is_refused_unless_it_holds_a_run(tmp_path, flag):
    folder = tmp_path / "others"
    folder.mkdir()
    (folder / "letter.txt").write_text("mine")
    with pytest.raises(InputError, match=r"letter\.txt was not written by ia-ingest"):
        check(RunFolder(path=folder), flag)
    run = begun(tmp_path / "run")
    (run.path / "poses.npz").write_text("mine")
    with pytest.raises(InputError, match=r"poses\.npz was not written by ia-ingest"):
        check(run, flag)
    with pytest.raises(InputError, match="was kept"):
        run.remove(run.poses)
    run.poses.unlink()
    run.tracking.mkdir()
    run.tracked_poses.write_text("mine")
    with pytest.raises(InputError, match=r"tracking/poses\.npz was not written by ia-ingest"):
        check(run, flag)


def test_a_run_does_not_replace_what_ia_track_wrote(tmp_path):
    begun(tmp_path)
    write_text_atomically(tmp_path / "grade.json", "{}")
    with pytest.raises(InputError, match="poses that ia-track wrote"):
        check(RunFolder(path=tmp_path), "overwrite")


def test_resuming_needs_a_run_and_no_other_flag(film, tmp_path, call):
    refusal = call(ingest, film, "--out", tmp_path / "typo", "--resume").refusal()
    assert "No run to --resume in" in refusal
    assert os.listdir(tmp_path) == []
    run = RunFolder(path=tmp_path / "killed")
    with run.claim(Console(), resume=False, overwrite=False):
        check(run, "resume")  # whenever it was killed
        with pytest.raises(InputError, match="mutually exclusive"):
            run.check_usable([], resume=True, overwrite=True)


# --- its lock ---------------------------------------------------------------------------------


def test_a_second_run_into_a_folder_is_refused_while_the_first_goes_on(film, tmp_path, call):
    with claim_folder(tmp_path, Console()):
        ended = call(ingest, film, "--out", tmp_path, "--overwrite")
    assert ended.code == 3
    assert "--out" in ended.complaint()
    with claim_folder(tmp_path, Console()):
        pass
    assert os.listdir(tmp_path) == []
