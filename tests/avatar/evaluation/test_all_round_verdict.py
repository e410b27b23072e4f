"""The worst word of four counts, and comes with its cure; views that no film shows."""

import numpy as np
import pytest

from avatar.evaluation.all_round_verdict import AllRoundVerdict
from avatar.evaluation.unfilmed_views import VIEW_PX, half_transparent_share, unfilmed_views

GOOD = {"seen": 0.98, "mean_cosine": 0.9, "half_transparent": 0.08, "player_psnr": 43.0}


def judge(held_out="sharp", **changes):
    return AllRoundVerdict.of(held_out, film_advice="Turn round.", **{**GOOD, **changes})


@pytest.mark.parametrize(
    ("changes", "verdict", "limit", "said"),
    [
        ({}, "sharp", None, None),  # from all sides
        ({"held_out": "failed", "seen": 0.3, "mean_cosine": 0.2}, "failed", "held_out", None),
        ({"seen": 0.8, "mean_cosine": 0.65}, "soft", "filmed", "Turn round."),
        ({"mean_cosine": 0.83}, "soft", "filmed", "angle of 32 degrees"),
        ({"seen": 0.45, "mean_cosine": 0.35}, "blurred", "filmed", "55% of the skin"),
        ({"half_transparent": 0.17}, "soft", "surface", "17% of its pixels"),
        ({"half_transparent": 0.36}, "blurred", "surface", "train longer"),
        ({"player_psnr": 31.0}, "soft", "player", "31 dB"),
        ({"player_psnr": 26.0}, "blurred", "player", "train longer"),
        ({"held_out": "soft"}, "soft", "held_out", "step nearer"),
        ({"mean_cosine": 0.35, "half_transparent": 0.36}, "blurred", "filmed", "Turn round."),
    ],
)
def test_the_worst_word_counts_with_its_cure(changes, verdict, limit, said):
    found = judge(**changes)
    assert (found.verdict, found.limit) == (verdict, limit)
    assert (said or "None") in str(found.advice)  # for sharper faces a failed one gets no advice


def test_what_was_not_measured_does_not_count():
    assert judge(**dict.fromkeys(GOOD)).verdict == "sharp"
    assert judge(player_psnr=float("nan")).verdict == "sharp"
    assert judge(held_out=None).verdict is None


def picture(*alphas):
    out = np.zeros((2, len(alphas), 4), dtype=np.float32)
    out[..., 3] = alphas
    return out


def test_pixels_are_half_transparent_between_empty_and_opaque():
    assert half_transparent_share([picture(0.0, 0.05, 1.0, 0.95)]) == 0.0
    assert half_transparent_share([picture(0.5, 1.0)]) == pytest.approx(0.5)
    assert half_transparent_share([picture(0.0, 0.5), picture(1.0, 1.0)]) == pytest.approx(1 / 3)


def test_an_avatar_of_which_nothing_is_seen_is_wholly_transparent():
    assert half_transparent_share([picture(0.0, 0.02)]) == 1.0


def test_the_person_is_whole_and_upright_in_every_view(rig, shaped):
    width, height = VIEW_PX
    views = list(unfilmed_views(rig))
    for pose, camera in views:
        place = camera.project(shaped.with_pose(pose).vertices())
        assert (place >= 0.0).all()
        assert (place <= [width, height]).all()
        head, pelvis = camera.project(shaped.with_pose(pose).joints())[[15, 0]]
        assert pelvis[1] - head[1] > 0.25 * height
    facing = [camera.center_world[2] > 0.0 for _, camera in views]
    assert 1 < sum(facing) < len(views)
