"""What ia-ingest says before training about skin that a film will not show."""

from dataclasses import replace

import numpy as np
import pytest

from instant_avatar.cli.console import Console
from instant_avatar.run.session_start import _announce_coverage
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.capture_inputs import CaptureInputs
from preprocess.open_capture import open_capture


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("announced") / "capture"
    film_capture(folder, ShootConfig(frames=24, size=64, turns=1.0))
    return folder


def announced(capture) -> list[str]:
    console = Console()
    _announce_coverage(capture, console)
    return console.warnings


def test_a_whole_turn_gives_no_warning(folder):
    assert not announced(open_capture(CaptureInputs(video=folder)))


def test_the_front_of_a_turn_warns_of_unseen_skin(folder):
    (warning,) = announced(open_capture(CaptureInputs(video=folder, frames=slice(0, 3))))
    assert "of the person's skin" in warning
    assert "back" in warning


def test_poses_without_a_frame_do_not_count(folder):
    capture = open_capture(CaptureInputs(video=folder, frames=slice(0, 3)))
    numbers = np.arange(24.0)
    numbers[5:] = np.nan
    strays = replace(capture.geometry(), row_frames=numbers)
    object.__setattr__(capture, "geometry", lambda: strays)
    assert len(announced(capture)) == 1
