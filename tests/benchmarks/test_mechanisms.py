"""The table of what each mechanism buys."""

import avatar.training.trainer
from benchmarks.mechanisms import MECHANISMS, Mechanism


def test_every_mechanism_can_be_left_out_and_its_lines_counted():
    for row in MECHANISMS:
        assert row.lines >= 0
        with row.turned_off():
            pass
    off = Mechanism(name="mean", patched={"avatar.training.trainer.EMA_HORIZON_STEPS": 1})
    with off.turned_off():
        assert avatar.training.trainer.EMA_HORIZON_STEPS == 1
    assert avatar.training.trainer.EMA_HORIZON_STEPS != 1
