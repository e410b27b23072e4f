"""What an avatar is made with, and what that allows: the strictest part decides."""

from dataclasses import replace
from pathlib import Path

import pytest

from preprocess.capture_inputs import CaptureInputs
from preprocess.licence_chain import LICENCES, licence_chain, made_with
from preprocess.open_capture import open_capture
from preprocess.poses.pose_file import as_stored
from preprocess.poses.pose_format_registry import TRACKERS


@pytest.fixture(scope="module")
def capture(small_capture):
    return open_capture(CaptureInputs(video=small_capture, masks=Path("segmenter:blazepose")))


def by_program(capture, program):
    return replace(capture, motion=replace(capture.motion, program=program))


def test_the_built_in_tracker_and_body_allow_commercial_use(capture):
    chain = licence_chain(made_with(by_program(capture, "blazepose")))
    assert chain["commercial_use"] == "yes"
    assert [part["part"] for part in chain["parts"]] == ["poses", "body", "masks"]
    assert "BlazePose, the built-in tracker (Apache-2.0)" in chain["summary"]
    assert "Commercial use: yes" in chain["summary"]


@pytest.mark.parametrize(
    ("program", "use", "because"),
    [
        (None, "unknown", "poses: poses.npz of unknown origin"),
        ("vitpose", "unknown", "poses: vitpose"),
        *((program, "no", program) for program in ("WHAM", "VIBE", "AMASS or AIST++")),
    ],
)
def test_poses_of_other_programs_forbid_it_or_leave_it_unknown(capture, program, use, because):
    chain = licence_chain(made_with(by_program(capture, program)))
    assert chain["commercial_use"] == use
    assert because in chain["because"]
    assert "body" not in chain["because"]


def test_an_smpl_file_as_body_forbids_it(capture):
    body = replace(capture.shaped.body, family="smpl")
    shaped = replace(capture.shaped, body=body)
    chain = licence_chain(made_with(replace(by_program(capture, "blazepose"), shaped=shaped)))
    assert chain["commercial_use"] == "no"
    assert chain["because"].startswith("body: an SMPL model file")


def test_one_forbidden_video_decides_for_all(capture):
    parts = [*made_with(by_program(capture, "blazepose")), *made_with(by_program(capture, "WHAM"))]
    assert licence_chain(parts)["commercial_use"] == "no"
    assert licence_chain([])["commercial_use"] == "unknown"


def test_the_program_is_stored_with_the_poses(capture):
    motion = replace(capture.motion, program="blazepose")
    assert as_stored(motion, Path("poses.npz")).program == "blazepose"
    assert as_stored(replace(motion, program=None), Path("poses.npz")).program is None


def test_known_programs_are_those_that_files_are_recognised_by():
    own = {"blazepose", "body24", "smpl", "SAM 3D Body", "GEM-X"}
    assert LICENCES.keys() - own <= TRACKERS.keys()
