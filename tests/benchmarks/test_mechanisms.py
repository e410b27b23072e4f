"""The table of what each mechanism buys."""

import avatar.training.trainer
from benchmarks.ablation_page import mechanism_lines
from benchmarks.mechanisms import (
    FEW_FRAME_MECHANISMS,
    FULL,
    LONGER,
    MECHANISMS,
    CaptureScores,
    Mechanism,
    MechanismScore,
)


def scores_of(*rows: MechanismScore) -> CaptureScores:
    return CaptureScores("film", 0, 600, 270, "commit 1234567", list(rows))


def test_a_loss_is_positive_and_the_time_of_a_mechanism_is_compared_with_more_steps():
    captures = [
        scores_of(
            MechanismScore(FULL.name, 20.0, 30.0, 27.0),
            MechanismScore(LONGER.name, 20.0, 30.2, 27.2),
            MechanismScore("alpha loss", 18.0, 29.5, 27.1),
        ),
        scores_of(
            MechanismScore(FULL.name, 20.0, 30.0, None),
            MechanismScore("hard surface", 20.0, 30.1, None),
        ),
    ]
    lines = mechanism_lines(captures)
    assert "| alpha loss | 2.0 | -0.10 / +0.50 | - | +0.20 | +0.20 | few |" in lines
    assert "| hard surface | 0.0 | - | -0.10 | -0.10 | +0.00 | few |" in lines
    assert not any("Few-frame" in line for line in lines)


def test_every_mechanism_can_be_left_out_and_its_lines_counted():
    for row in [*MECHANISMS, *FEW_FRAME_MECHANISMS]:
        assert row.lines >= 0
        with row.turned_off():
            pass
    off = Mechanism(name="mean", patched={"avatar.training.trainer.EMA_HORIZON_STEPS": 1})
    with off.turned_off():
        assert avatar.training.trainer.EMA_HORIZON_STEPS == 1
    assert avatar.training.trainer.EMA_HORIZON_STEPS != 1
