"""The worst word of four counts, and comes with its cure."""

import pytest

from avatar.evaluation.all_round_verdict import AllRoundVerdict

GOOD = {"seen": 0.98, "mean_cosine": 0.9, "half_transparent": 0.08, "player_psnr": 43.0}


def judge(held_out="sharp", **changes):
    return AllRoundVerdict.of(held_out, film_advice="Turn round.", **{**GOOD, **changes})


def test_an_avatar_that_is_good_from_all_sides_is_sharp_and_needs_nothing():
    found = judge()
    assert found.verdict == "sharp"
    assert found.limit is None
    assert found.advice is None


@pytest.mark.parametrize(
    ("changes", "verdict", "limit", "said"),
    [
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
    assert said in found.advice


def test_a_failed_avatar_gets_no_advice_for_sharper_faces():
    found = judge("failed", seen=0.3, mean_cosine=0.2)
    assert (found.verdict, found.limit, found.advice) == ("failed", "held_out", None)


def test_what_was_not_measured_does_not_count():
    assert judge(**dict.fromkeys(GOOD)).verdict == "sharp"
    assert judge(player_psnr=float("nan")).verdict == "sharp"
    assert judge(held_out=None).verdict is None
