"""What was seen: a body before a camera, in known poses; and the coach's sentence about it."""

import numpy as np
import pytest

from avatar.evaluation.coverage import (
    PART_NAMES,
    SEEN_COMPLETELY,
    SIDE_NAMES,
    Coverage,
    VisibilityStage,
    coverage_advice,
    pose_patches,
)

L_SHOULDER, R_SHOULDER = 15, 16


@pytest.fixture
def coverage(shaped) -> Coverage:
    return Coverage(shaped)


def test_patches_hold_the_whole_skin_but_soles_and_mouth(shaped, coverage):
    patches = coverage.patches
    a, b, c = (shaped.vertices[shaped.body.faces[:, k]] for k in range(3))
    skin = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    assert 0.95 * skin < patches.areas.sum() < skin
    soles = np.isin(patches.parts, [5, 6]) & (patches.normals[:, 1] < -0.5)
    assert not soles.any()
    assert np.allclose(patches.weights.sum(axis=1), 1.0, atol=1e-5)


def test_the_left_side_is_the_persons_left(coverage):
    patches = coverage.patches
    for side, axis, sign in (("left", 0, 1), ("right", 0, -1), ("front", 2, 1), ("back", 2, -1)):
        here = patches.sides == SIDE_NAMES.index(side)
        assert np.all(sign * patches.normals[here, axis] > 0.0)
    left_hand = patches.parts == PART_NAMES.index("left hand")
    assert patches.points[left_hand, 0].min() > 0.0


def test_who_is_seen_from_the_front_has_an_unseen_back(shaped, observed, coverage):
    coverage.add(observed())
    parts, patches = coverage.by_part(), coverage.patches
    for name in ("torso", "head", "left thigh", "right shin", "left upper arm"):
        assert parts[name]["front"] > 0.8
        assert parts[name]["back"] == 0.0
    assert 0.3 < coverage.seen_share < 0.5
    areas = [float(patches.areas[patches.parts == k].sum()) for k in range(len(PART_NAMES))]
    whole = np.average([parts[name]["seen"] for name in PART_NAMES], weights=areas)
    assert whole == pytest.approx(coverage.seen_share, rel=1e-5)
    _, normals = pose_patches(patches, shaped.with_pose(observed().pose).world_from_rest())
    # no skin is seen at more than 72°, and the body spans 15° of the camera's view to each side
    assert not (coverage.cosines[normals[:, 2] < np.cos(np.radians(72 + 15))] > 0.0).any()


def test_patches_are_seen_as_squarely_as_they_face_the_camera(shaped, observed, coverage):
    far = observed(distance_m=1000.0)
    coverage.add(far)
    _, normals = pose_patches(coverage.patches, shaped.with_pose(far.pose).world_from_rest())
    seen = coverage.stages == VisibilityStage.SEEN
    assert np.allclose(coverage.cosines[seen], normals[seen, 2], atol=0.01)


def test_turning_once_shows_all_around(observed, coverage):
    for turned in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        coverage.add(observed(turned=turned))
    # what is left: crown, shoulders from above, chin, armpits
    assert coverage.seen_share > 0.93
    for name in ("torso", "left thigh", "right shin", "left forearm"):
        assert min(coverage.by_part()[name].values()) > 0.9
    assert coverage_advice(coverage) == SEEN_COMPLETELY


def test_an_arm_before_the_chest_hides_it(shaped, observed):
    def chest(lowered_forward: float) -> float:
        coverage, view = Coverage(shaped), observed()
        view.pose.joint_rotations[L_SHOULDER] = 0.0, -lowered_forward, 0.0
        view.pose.joint_rotations[R_SHOULDER] = 0.0, lowered_forward, 0.0
        coverage.add(view)
        return coverage.by_part()["torso"]["front"]

    assert chest(0.0) > 0.95
    assert chest(2.2) < chest(0.0) - 0.05


def test_what_is_outside_the_picture_is_not_seen(observed, coverage):
    coverage.add(observed(up_m=1.6))
    for foot in ("left foot", "right foot"):
        assert coverage.by_part()[foot]["seen"] == 0.0
    here = coverage.patches.parts == PART_NAMES.index("left foot")
    unseen = {VisibilityStage.FACING_AWAY, VisibilityStage.OUTSIDE_IMAGE}
    assert set(coverage.stages[here].tolist()) == unseen
    assert coverage.by_part()["head"]["seen"] > 0.2


def test_what_the_mask_leaves_out_is_not_seen(observed, coverage):
    alpha = np.ones((200, 200), dtype=np.float32)
    alpha[:, :100] = 0.4  # the person's right half, seen from the front
    coverage.add(observed(alpha=alpha))
    parts = coverage.by_part()
    assert parts["right thigh"]["seen"] == 0.0
    assert parts["left thigh"]["front"] > 0.9
    here = coverage.patches.parts == PART_NAMES.index("right thigh")
    assert VisibilityStage.OUTSIDE_IMAGE not in coverage.stages[here]


def test_what_was_seen_survives_a_checkpoint(shaped, observed, coverage):
    coverage.add(observed())
    again = Coverage(shaped)
    again.merge_state(coverage.to_state())
    assert np.array_equal(again.stages, coverage.stages)
    assert np.abs(again.cosines - coverage.cosines).max() < 0.5 / 255.0 + 1e-6
    assert again.seen_share == coverage.seen_share
    of_another_body = Coverage(shaped)
    of_another_body.merge_state(coverage.to_state() | {"stages": "BAQE"})
    assert of_another_body.seen_share == 0.0


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
