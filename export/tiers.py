"""The qualities in which one set of tables is drawn."""

from export.rules import DrawingRules

TIERS = {
    "hq": DrawingRules(),
    "lite": DrawingRules(
        samples=5,
        block=2,
        steady=1,
        blocks=2,
        nodes_per_step=1,
        lead_m=0.001,
        ended=0.05,
        lengthened=4.0,
        transmitted=0.15,
    ),
}
"""How each is drawn; "hq" comes first."""
