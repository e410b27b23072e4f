"""The qualities in which one set of tables is drawn."""

from dataclasses import replace

from export.rules import DrawingRules

HQ = DrawingRules(squash_limit=1.0, fold_setback_m=0.02)
TIERS = {
    "hq": HQ,
    "lite": replace(
        HQ,
        samples=5,
        block=2,
        steady=1,
        blocks=3,
        nodes_per_step=1,
        lead_m=0.001,
        ended=0.05,
        lengthened=4.0,
        transmitted=0.15,
    ),
}
"""How each is drawn; "hq" comes first."""
