"""The qualities in which one set of tables is drawn."""

from export.rules import DrawingRules

TIERS = {
    "hq": DrawingRules(),
    "lite": DrawingRules(samples=4, steady=1, blocks=3, lead_m=0.001, ended=0.05, transmitted=0.15),
}
"""How each is drawn; "hq" comes first."""
