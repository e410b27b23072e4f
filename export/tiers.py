"""The qualities in which one set of tables is drawn."""

from dataclasses import replace

from export.rules import RenderSettings

HQ_SETTINGS = RenderSettings(max_compression=1.0, fold_depth_offset_m=0.02)
QUALITY_TIERS = {
    "hq": HQ_SETTINGS,
    "lite": replace(
        HQ_SETTINGS,
        samples=5,
        block_samples=2,
        uniform_blocks=1,
        max_blocks=3,
        skinning_subdivision=1,
        entry_margin_m=0.001,
        min_transmittance=0.05,
        max_lengthening=4.0,
        layer_min_transmittance=0.15,
    ),
}
"""How each is drawn; "hq" comes first."""
