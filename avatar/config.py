"""The training configuration, and how it follows from the time budget and the image size."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

COARSEST_M = 0.13
"""Cell size of the coarsest hash level, metres: 16 cells along a two-metre box."""
HEAD_SIDE_M = 0.32
"""Side of the square that holds the head, metres."""
MAX_HEAD_PX = 256
"""Longest side of an image of the head, pixels; a larger one is reduced."""
ESTIMATED_POSE_PRIORS: Mapping[str, float] = {
    "double_well_weight": 0.2, "interior_weight": 0.0125, "density_slope_weight": 0.02,
    "color_tv_weight": 0.025, "min_occupied_density": 150.0, "off_skin_weight": 0.1,
    "head_interior_weight": 0.03,
}  # fmt: skip
"""Priors of firm and smooth surfaces where poses are estimates; they grow with the uncertainty. Fog
imitates views in poses that are off: together they cost an exact actor 0.8 to 1.4 dB in new poses,
and give phone-like ones 0.1 to 0.6 dB, half of the samples and whole surfaces."""
NOMINAL_STEPS_PER_S = 50.0
"""Training steps that stand for one second where steps are counted; two cores make about these."""
HELD_OUT_STRIDE = 10
"""Default stride between held-out frames."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Configuration of a training run; report.json stores it as `recipe`."""

    seconds: float = 60.0
    """Wall time from the first frame to the last step, seconds."""
    steps: int | None = None
    """Number of training steps, at least one a frame; replaces the time budget and gives the same
    result on any machine. `seconds` is then `steps / NOMINAL_STEPS_PER_S`."""
    rays: int = 1024
    """Rays per step."""
    faint_gradient_share: float = 0.2
    """Strength of a sample's gradient, as a share of the mean, below which it is propagated by
    chance, and divided by that chance; 0: all are propagated."""
    sample_step_m: float = 0.01
    """Distance between samples along a ray, metres."""
    initial_step_factor: float = 3.0
    """Factor of that distance at the beginning, when the field is fog; it falls to 1."""
    opaque_margin_m: float = 0.06
    """Distance that a ray is marched past the depth at which it is opaque, metres."""
    max_samples: int = 128
    """Largest number of samples on a ray."""
    levels: int = 8
    """Number of levels of the hash grid."""
    table_size: int = 1 << 17
    """Number of entries of a hashed level."""
    finest_m: float = 0.008
    """Cell size of the finest level, metres."""
    learning_rate: float = 2.5e-2
    """Learning rate of the hash table; the network's is `NETWORK_RATE_FACTOR` times it."""
    alpha_weight: float = 0.2
    """Weight of the L1 loss on alpha; 0 turns it off."""
    hard_surface_weight: float = 0.02
    """Weight of the hard-surface loss; 0 turns it off."""
    empty_space_weight: float = 1.0
    """Weight of the opacity in unoccupied cells; 0 turns the term off."""
    empty_space_points: int = 256
    """Points per step at which that opacity is penalised."""
    density_tv_weight: float = 0.025
    """Weight of the total variation of opacity; 0 turns the term off."""
    double_well_weight: float = 0.0
    """Final weight of the double well of opacity, which grows as the learning rate falls; it makes
    surfaces firm from all sides, at a small loss in the filmed views."""
    interior_weight: float = 0.0
    """Weight of the loss that makes the body's interior opaque; 0 turns the term off."""
    head_interior_weight: float = 0.0
    """Initial weight of the same loss in the head, which falls as surfaces become firm; without it
    a face that is filmed from one side alone is a shell at any depth."""
    density_slope_weight: float = 0.0
    """Final weight of density slopes above `max_log_density_slope_per_m` and of excess density; it
    grows as the learning rate falls. No image resolves edges sharper than the finest cells."""
    color_tv_weight: float = 0.0
    """Final weight of the color variation between close points; it grows in the same way."""
    smoothness_pairs: int = 256
    """Pairs of close points per step at which slope and color variation are penalised."""
    min_occupied_density: float = 0.0
    """Density below which a cell counts as empty at the end, 1/m; removes haze."""
    off_skin_weight: float = 0.0
    """Weight of log density off the skin, which vanishes where no ray needs it; 0: off."""
    off_skin_points: int = 128
    """Points per step at which that log density is penalised."""
    interior_points: int = 128
    """Points per step at which the interior's opacity is measured."""
    head_interior_points: int = 64
    """Points per step at which the opacity of the head's interior is measured."""
    density_tv_pairs: int = 128
    """Pairs of points per step at which the total variation is measured."""
    unseen_weight: float = 0.12
    """Weight of the loss that draws unseen skin to its source (`avatar.training.unseen_skin`)."""
    unseen_points: int = 512
    """Points per step at which skin is drawn to its source if all of it is unseen; fewer, as strong
    each, the more was seen."""
    occupancy_interval: int = 16
    """Steps between updates of the occupancy grid."""
    refine_poses: bool = True
    """Whether the frames' poses are corrected during training."""
    pose_uncertainty: float = 0.0
    """How far the poses are estimates, in [0, 1]. The priors that keep a surface firm and smooth
    grow with it: fog imitates views in poses that are off, and exact poses need none."""
    estimate_shading: bool = True
    """Whether the light of the room is separated from the colors of the person who turns in it."""
    estimate_exposures: bool = True
    """Whether a gain of each color channel is estimated for each frame."""
    replay_capacity: int = 200
    """Frames that the replay buffer holds."""
    held_out_stride: int = HELD_OUT_STRIDE
    """Stride between held-out frames; 0 for none."""
    seed: int = 0
    """Seed of all random numbers."""

    def __post_init__(self) -> None:
        """Derives the seconds of the schedule from the steps, where steps are counted."""
        if self.steps:
            object.__setattr__(self, "seconds", self.steps / NOMINAL_STEPS_PER_S)

    @property
    def poses_may_be_exact(self) -> bool:
        """True if a pose is corrected only where its rays agree that it is wrong."""
        return self.pose_uncertainty < 0.5

    @property
    def max_log_density_slope_per_m(self) -> float:
        """Largest unpenalised slope of the log density, 1/m: 4 across a finest cell."""
        return 4.0 / self.finest_m

    def sample_step_at(self, detail_share: float) -> float:
        """Distance between samples along a ray at a progress from fog to detail, in [0, 1], m."""
        factor = 1.0 + (self.initial_step_factor - 1.0) * (1.0 - detail_share)
        # at most 1.5 cm: limbs are five times as thick
        return max(min(factor * self.sample_step_m, 0.015), self.sample_step_m)

    @classmethod
    def for_budget(
        cls,
        seconds: float | None = None,
        *,
        steps: int | None = None,
        footprint_m: float,
        filmed_footprint_m: float | None = None,
        pose_uncertainty: float = 0.0,
        seed: int = 0,
        held_out_stride: int = HELD_OUT_STRIDE,
    ) -> "TrainConfig":
        """Derives the configuration from a budget and the size of a pixel on the body.

        `filmed_footprint_m` is that size before the video is reduced; None where it is not. The
        budget is 60 s without `seconds` and `steps`.
        """
        if seconds is None:
            seconds = 60.0 if steps is None else steps / NOMINAL_STEPS_PER_S
        head_m = max(filmed_footprint_m or footprint_m, min(footprint_m, HEAD_SIDE_M / MAX_HEAD_PX))
        # Frames agree on no smaller detail, metres, where poses are estimates. Cells below 6 mm
        # neither gain nor lose in new poses, but eyes and mouth become readable; samples cost time.
        detail_m = math.hypot(head_m, 0.003 * pose_uncertainty)
        sampling_m = math.hypot(footprint_m, 0.0045 * pose_uncertainty)
        finest_m = min(max(detail_m, 0.002), COARSEST_M / 2)
        # about four times as many entries as the skin has cells, within what a cache can hold
        entries = 4.0 * 2.0 / finest_m**2
        config = cls(
            seconds=seconds,
            steps=steps,
            # metres: samples farther apart leave stripes, seen from sides that were not filmed
            sample_step_m=min(max(1.2 * sampling_m, 0.004), 0.01),
            finest_m=finest_m,
            table_size=1 << min(max(round(math.log2(entries)), 15), 19 if seconds > 120 else 17),
            pose_uncertainty=pose_uncertainty,
            seed=seed,
            held_out_stride=held_out_stride,
        )
        priors = {name: pose_uncertainty * full for name, full in ESTIMATED_POSE_PRIORS.items()}
        return replace(config, **priors)
