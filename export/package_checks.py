"""Checks of a package's player against its reference and against the volume renderer."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from avatar.evaluation.image_metrics import psnr
from export.bake.bake_tables import ExportRefused
from export.bake.render_targets import PosedView
from export.package.manifest import GoldenFrame
from export.package.package_file import AvatarPackage
from export.picture_difference import (
    MIN_CLOSE_FRACTION,
    PictureDifference,
    picture_on_white,
    premultiply,
)
from export.player import Player
from export.player_limits import fit_camera
from export.reference.reference_player import PlayerInputs, draw_reference

POOR_PSNR = 30.0
"""Player against volume renderer, dB: below this a package shows its avatar poorly."""
GOOD_PSNR = 38.0
"""Player against volume renderer, dB: from this on, both look the same."""
SIMPLIFIED_WARNING = (
    "The package simplifies fine detail or soft edges: what it draws is {score:.1f} dB from the "
    "avatar as trained ({good:.0f} dB and more look the same)."
)
"""Shown between `POOR_PSNR` and `GOOD_PSNR`."""
POOR_WARNING = (
    "The package shows the avatar poorly: what it draws is only {score:.1f} dB from the avatar as "
    "trained ({good:.0f} dB and more look the same). The avatar is still fog rather than a "
    "surface; train longer (ia-ingest with --resume and more --seconds)."
)
"""Shown below `POOR_PSNR`."""
CHECK_PX = 256
"""Longer side of the pictures that are compared with the volume renderer, pixels."""


def check_graph(
    player: Player, package: AvatarPackage, tier: str, frames: Sequence[GoldenFrame]
) -> float:
    """Compare a tier's graph with its reference.

    Returns:
        The largest difference over all frames, in 1/255.

    Raises:
        ExportRefused: If a picture does not match.
    """
    tables, settings = package.tables[tier], package.manifest.tiers[tier].settings
    worst = 0.0
    for number, frame in enumerate(frames):
        camera = frame.camera
        inputs = PlayerInputs(
            bones=player.bones(frame.pose, camera),
            focal=np.array(camera.focal_px, dtype=np.float32),
            center=np.array(camera.center_px, dtype=np.float32),
            size_px=camera.size_px,
            samples=settings.samples,
        )
        drawn = premultiply(player.render(frame.pose, camera))
        difference = PictureDifference.of(drawn, draw_reference(tables, settings, inputs))
        worst = max(worst, difference.largest_difference)
        if not difference.matches:
            raise ExportRefused(
                f"In view {number} the player's graph ({tier}) is within 2/255 of its reference "
                f"on only {difference.close_fraction:.2%} of the pixels; {MIN_CLOSE_FRACTION:.1%} "
                "are required. Nothing was written; the checkpoint is kept. This is a fault of the "
                "program: please report it with the version of onnxruntime."
            )
    return worst


def mean_psnr_to_renderer(
    player: Player,
    views: Sequence[PosedView],
    exact: Sequence[Float32[np.ndarray, "_ _ 3"]],
) -> float:
    """Return the mean PSNR of the player to the renderer's pictures on white, dB."""
    scores = []
    for (pose, camera), truth in zip(views, exact, strict=True):
        drawn = picture_on_white(premultiply(player.render(pose, fit_camera(camera, CHECK_PX))))
        scores.append(min(psnr(drawn, truth), 99.0))
    return float(np.mean(scores))


def quality_warnings(score: float) -> list[str]:
    """Return the warnings for a player with this mean PSNR to the renderer, dB."""
    if score >= GOOD_PSNR:
        return []
    text = POOR_WARNING if score < POOR_PSNR else SIMPLIFIED_WARNING
    return [text.format(score=score, good=GOOD_PSNR)]
