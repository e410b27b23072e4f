"""The coach's sentence: what it says about a body that was seen in known ways."""

import numpy as np
import pytest

from avatar.evaluation.coverage import (
    PART_NAMES,
    SEEN_COMPLETELY,
    SIDE_NAMES,
    Coverage,
    VisibilityStage,
    coverage_advice,
)


def without(
    coverage: Coverage, where: np.ndarray, stage: VisibilityStage = VisibilityStage.FACING_AWAY
) -> Coverage:
    """Everything is seen squarely but some patches, which came only so far."""
    coverage.stages[:] = np.where(where, stage, VisibilityStage.SEEN)
    coverage.cosines[:] = np.where(where, 0.0, 1.0)
    return coverage


def here(coverage: Coverage, *parts: str, side: str | None = None) -> np.ndarray:
    """The patches of some parts (all parts if none is named), on one side of them or on all."""
    patches = coverage.patches
    where = np.isin(patches.parts, [PART_NAMES.index(part) for part in parts or PART_NAMES])
    return where if side is None else where & (patches.sides == SIDE_NAMES.index(side))


def arm(whose: str) -> tuple[str, str, str]:
    return f"{whose} upper arm", f"{whose} forearm", f"{whose} hand"


@pytest.fixture
def coverage(shaped) -> Coverage:
    return Coverage(shaped)


@pytest.mark.parametrize(
    ("turned", "sentence"),
    [
        (0.0, "Turn until your back has been seen."),
        (np.pi, "Face the camera: your front was never seen."),
        (-np.pi / 2, "Turn until your right side has been seen."),
        (np.pi / 2, "Turn until your left side has been seen."),
    ],
)
def test_the_side_is_the_persons_and_opposite_to_the_seen_one(observed, coverage, turned, sentence):
    coverage.add(observed(turned=turned))
    assert coverage_advice(coverage) == sentence


def test_feet_below_the_picture_ask_for_a_step_back(observed, coverage):
    for turned in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        coverage.add(observed(turned=turned, up_m=1.0))
    assert coverage_advice(coverage) == "Step back: no picture shows your legs."


@pytest.mark.parametrize(
    ("parts", "side", "sentence"),
    [
        (arm("left"), "under", "Raise your left arm: the underside was never seen."),
        (arm("right"), "back", "Turn until the back of your right arm has been seen."),
        (("left thigh", "left shin"), "right",
         "Stand with your legs apart: the inner side was never seen."),
        (("head",), "back", "Turn until the back of your head has been seen."),
        (("head",), "front", "Look at the camera: your face was never seen."),
    ],
)  # fmt: skip
def test_a_piece_on_one_limb_is_named_by_limb_and_side(coverage, parts, side, sentence):
    assert coverage_advice(without(coverage, here(coverage, *parts, side=side))) == sentence


def test_small_pieces_are_one_sentence_however_many_are_left(coverage, rng):
    order = rng.permutation(len(coverage.patches.points))
    said = {
        coverage_advice(without(coverage, order < share * len(order)))
        for share in (0.08, 0.12, 0.17)
    }
    assert len(said) == 1
    assert SEEN_COMPLETELY not in said


def test_every_sentence_is_one(coverage, rng):
    """Any ball of unseen skin, for any reason, makes a sentence without a hole in it."""
    points = coverage.patches.points
    for center in points[rng.integers(0, len(points), 60)]:
        near = np.linalg.norm(points - center, axis=1) < rng.uniform(0.1, 0.5)
        said = coverage_advice(without(coverage, near, VisibilityStage(int(rng.integers(0, 4)))))
        assert said[0].isupper()
        assert said.endswith(".")
        assert "{" not in said
        assert "  " not in said
