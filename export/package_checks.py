"""Whether a package's player draws what it should: its graph's meaning, the renderer's pictures."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from avatar.evaluation.held_out import composite_on_white
from avatar.evaluation.image_metrics import psnr
from capture.camera import Camera
from export.bake.bake_tables import ExportRefused
from export.bake.render_targets import PosedView, RgbaPicture
from export.package.manifest import GoldenFrame
from export.package.package_file import AvatarPackage
from export.player import MIN_CLOSE_FRACTION, PictureDifference, Player, premultiply
from export.reference.reference_player import PlayerInputs, draw_reference

POOR_PSNR, GOOD_PSNR = 30.0, 38.0
"""Player against volume renderer, dB: what is below the second, or the first, is warned of."""
SIMPLIFIED_WARNING = (
    "The package simplifies fine detail or soft edges: what it draws is {score:.1f} dB from the "
    "avatar as it was learnt ({good:.0f} dB and more look the same)."
)
POOR_WARNING = (
    "The package shows the avatar poorly: what it draws is only {score:.1f} dB from the avatar as "
    "it was learnt ({good:.0f} dB and more look the same). The avatar is still fog rather than a "
    "surface; learn longer (ia-ingest with --resume and more --seconds)."
)
CHECK_PX = 256
"""Longer side of the pictures that are compared with the volume renderer."""


def fit_camera(camera: Camera, longest_px: int) -> Camera:
    """The camera for a picture whose longer side is at most so long."""
    return camera.resize_longer_side(min(longest_px, max(camera.size_px)))


def picture_on_white(picture: RgbaPicture) -> Float32[np.ndarray, "height width 3"]:
    """A picture on white, in [0, 1]."""
    return np.clip(composite_on_white(picture), 0.0, 1.0)


def check_graph(
    player: Player, package: AvatarPackage, tier: str, frames: Sequence[GoldenFrame]
) -> float:
    """Refuses a graph that does not draw what its twin draws; returns the largest difference."""
    tables, rules = package.tables[tier], package.manifest.tiers[tier].settings
    worst = 0.0
    for number, frame in enumerate(frames):
        camera = frame.camera
        shot = PlayerInputs(
            bones=player.bones(frame.pose, camera),
            focal=np.array(camera.focal_px, dtype=np.float32),
            center=np.array(camera.center_px, dtype=np.float32),
            size_px=camera.size_px,
            samples=rules.samples,
        )
        drawn = premultiply(player.render(frame.pose, camera))
        likeness = PictureDifference.of(drawn, draw_reference(tables, rules, shot))
        worst = max(worst, likeness.largest_difference)
        if not likeness.matches:
            raise ExportRefused(
                f"In view {number} the player's graph ({tier}) is within 2/255 of its meaning on "
                f"only {likeness.close_fraction:.2%} of the pixels ({MIN_CLOSE_FRACTION:.1%} are wanted). Nothing was "
                "written; the checkpoint is kept. This is a fault of the program: please report "
                "it with the version of onnxruntime."
            )
    return worst


def mean_psnr_to_renderer(
    player: Player,
    views: Sequence[PosedView],
    exact: Sequence[Float32[np.ndarray, "_ _ 3"]],
) -> float:
    """Compares the player with the exact renderer's pictures on white; the mean PSNR, dB."""
    scores = []
    for (pose, camera), truth in zip(views, exact, strict=True):
        drawn = picture_on_white(premultiply(player.render(pose, fit_camera(camera, CHECK_PX))))
        scores.append(min(psnr(drawn, truth), 99.0))
    return float(np.mean(scores))


def quality_warnings(score: float) -> list[str]:
    """What a user should know of a package whose player has this PSNR to the renderer, dB."""
    if score >= GOOD_PSNR:
        return []
    text = POOR_WARNING if score < POOR_PSNR else SIMPLIFIED_WARNING
    return [text.format(score=score, good=GOOD_PSNR)]
