"""The public names of the package: what they cost to import, and training in one call."""

import subprocess
import sys

import pytest

import instant_avatar
from instant_avatar import InputError, train


def test_public_names_are_those_that_are_listed():
    for name in dir(instant_avatar):
        assert getattr(instant_avatar, name).__class__ is not None
    with pytest.raises(AttributeError, match="utils"):
        _ = instant_avatar.utils


def test_the_player_is_imported_without_torch():
    code = (
        "import sys; from instant_avatar import Player, Camera, BodyPose, JOINT_NAMES, InputError; "
        "print('torch' in sys.modules, 'cv2' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_training_refuses_bad_input_by_an_error(tmp_path):
    with pytest.raises(InputError, match=r"none\.mp4"):
        train(tmp_path / "none.mp4", tmp_path / "run", quiet=True)
    with pytest.raises(InputError, match="--steps"):
        train(tmp_path, tmp_path / "run", steps=0)
    assert not (tmp_path / "run").exists()
