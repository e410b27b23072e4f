"""The networks that are distributed are those that `dev/make_blazepose.py` makes."""

import hashlib

import pytest

from dev.make_blazepose import NETWORKS, WEIGHTS, verified


@pytest.mark.parametrize("name", ["blazepose_detector", "blazepose_landmarks_full"])
def test_the_networks_here_are_the_ones_that_the_script_makes(name):
    data = (WEIGHTS / f"{name}.onnx").read_bytes()
    assert hashlib.sha256(data).hexdigest() == NETWORKS[name].sha256


def test_other_data_are_refused():
    with pytest.raises(SystemExit, match="model: SHA-256 is"):
        verified(b"other", "0" * 64, "model")
