"""Calls with arrays of other shapes are refused while tests run, in our own packages, too."""

from collections.abc import Iterator

import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float, TypeCheckError

from capture.camera import Camera
from preprocess.body.kinematics import rotation_matrices
from tests.shape_checks import check_calls

Points = Float[np.ndarray, "points 3"]


@check_calls(typechecker=beartype)
def distances(ours: Points, theirs: Points, count: int = 99) -> Float[np.ndarray, "points"]:
    return np.linalg.norm(ours - theirs, axis=1)[:count]


@check_calls(typechecker=beartype)
def halves(ours: Points) -> Iterator[Points]:
    yield from np.split(ours, 2)


def test_a_name_of_an_axis_is_one_length_within_one_call():
    for count in (2, 5):
        assert distances(np.ones((count, 3)), np.zeros((count, 3))).shape == (count,)
    for theirs in (np.zeros((4, 3)), np.zeros((5, 2)), np.zeros((5, 3), np.float32).tolist()):
        with pytest.raises(TypeCheckError):
            distances(np.ones((5, 3)), theirs)
    with pytest.raises(TypeCheckError):
        distances(np.ones((5, 3)), np.zeros((5, 3)), 4)  # what it returns is too short


def test_generators_are_checked_when_they_are_called():
    assert [len(half) for half in halves(np.zeros((4, 3)))] == [2, 2]
    with pytest.raises(TypeCheckError):
        list(halves(np.zeros((4, 2))))


def test_functions_and_dataclasses_of_our_own_are_checked():
    with pytest.raises(TypeCheckError):
        rotation_matrices(np.zeros((4, 2)))
    with pytest.raises(TypeCheckError):
        Camera(
            focal_px=(9.0, 9.0), center_px=(4.0, 4.0), size_px=(8, 8), camera_from_world=np.eye(3)
        )  # fmt: skip
