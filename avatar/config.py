"""How an avatar is learnt: the recipe, and what follows from how long the user will wait."""

import math
from dataclasses import dataclass

COARSEST_M = 0.13
"""Cells of the coarsest hash level: 16 along a two-metre box."""
FULL_DETAIL_FRAMES = 24
"""So many frames, all round, determine the detail that their pixels show."""
FEW_FRAMES = 12
"""Fewer do not tell a pose's error from the body's shape: what they leave open becomes fog, unless
surfaces are asked to be firm. Asked of twelve frames in exact poses it cost 0.5 dB."""
MAX_DETAIL_SHORTAGE, MAX_FRAME_SHORTAGE = 4.0, 1.5
"""Both count no further than to a quarter, and to two thirds."""
FEW_FRAMES_DOUBLE_WELL_WEIGHT, FEW_FRAMES_INTERIOR_WEIGHT = 1.5, 0.15
FEW_FRAMES_SLOPE_WEIGHT, FEW_FRAMES_COLOR_TV_WEIGHT, FEW_FRAMES_MIN_DENSITY = 0.15, 0.3, 180.0
FEW_FRAMES_INNER_LEG_WEIGHT = 0.1
"""Of all six, times the share by which frames are fewer than `FEW_FRAMES`."""
MAX_LOG_DENSITY_STEP = 4.0
"""Logarithm of the density may change by so much along a finest cell, where that is asked."""
NOMINAL_STEPS_PER_S = 50.0
"""Training steps that count as one second where steps are counted instead: what two cores make."""
HELD_OUT_STRIDE = 10
"""Every so manieth frame is held out, unless somebody says otherwise."""


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """The recipe. It stands in report.json as it was used."""

    seconds: float = 60.0
    """Wall time from the first frame to the last step."""
    steps: int | None = None
    """Number of steps that training takes instead, at least one a frame: the same result on any
    machine. `seconds` is then `steps / NOMINAL_STEPS_PER_S`."""
    rays: int = 1024
    """Rays per step."""
    sample_step_m: float = 0.01
    """Distance between samples along a ray, metres."""
    opaque_margin_m: float = 0.06
    """How far a ray is followed once its cached optical depth says it is opaque, metres."""
    max_samples: int = 128
    """Samples a ray may have."""
    levels: int = 8
    """Levels of the hash grid."""
    table_size: int = 1 << 17
    """Entries of a hashed level."""
    finest_m: float = 0.008
    """Cells of the finest level, metres."""
    learning_rate: float = 2.5e-2
    """Of the table; the network's is 0.3 of it."""
    alpha_weight: float = 0.1
    """Of the L1 loss on alpha; 0 turns it off."""
    hard_surface_weight: float = 0.02
    """Of the hard-surface loss; 0 turns it off."""
    empty_space_weight: float = 1.0
    """Of the opacity in cells that should be empty; 0 turns the term off."""
    empty_space_points: int = 256
    """Points at which that opacity is measured in each step."""
    density_tv_weight: float = 0.025
    """Of the total variation of opacity; 0 turns the term off."""
    initial_density_tv_factor: float = 1.0
    """So many times that weight at first: it falls to it as the learning rate falls."""
    double_well_weight: float = 0.0
    """Of the double well of opacity, at the end; it grows as the learning rate falls. Where total
    variation is asked for strongly, it keeps surfaces from becoming fog."""
    interior_weight: float = 0.0
    """Of the opacity deep under the body's skin, which must be solid; 0 turns the term off."""
    density_slope_weight: float = 0.0
    """Of edges steeper than `steepest_per_m`, and of needless density, at the end; it grows as the
    learning rate falls. What is sharper than the finest cells no picture has shown."""
    color_tv_weight: float = 0.0
    """Of the variation of colour between points as close; it grows the same way."""
    smoothness_pairs: int = 256
    """Pairs of close points at which both are measured in each step."""
    min_occupied_density: float = 0.0
    """Cells less dense than this, in 1/m, count as empty in the end: haze that no surface needs."""
    inner_leg_weight: float = 0.0
    """Of log density off the skin between the legs, where no ray may tell; 0 turns it off."""
    inner_leg_points: int = 128
    """Points at which that is measured in each step."""
    interior_points: int = 128
    """Points at which that opacity is measured in each step."""
    density_tv_pairs: int = 128
    """Pairs of points at which that variation is measured in each step."""
    occupancy_interval: int = 16
    """Steps between updates of the occupancy."""
    refine_poses: bool = True
    """Whether the frames' poses are corrected while they are learnt from."""
    replay_capacity: int = 200
    """Frames that stay for replay."""
    held_out_stride: int = HELD_OUT_STRIDE
    """Every so manieth frame is held out; 0 for none."""
    seed: int = 0
    """Of everything random."""

    def __post_init__(self) -> None:
        """Derives the seconds of the schedule from the steps, where steps are counted."""
        if self.steps:
            object.__setattr__(self, "seconds", self.steps / NOMINAL_STEPS_PER_S)

    @property
    def max_log_density_slope_per_m(self) -> float:
        """By how much the logarithm of the density may change along a metre."""
        return MAX_LOG_DENSITY_STEP / self.finest_m

    def density_tv_weight_at(self, surface_share: float) -> float:
        """The weight of total variation when surfaces have become firm so far, in [0, 1]."""
        return self.density_tv_weight * self.initial_density_tv_factor ** (1.0 - surface_share)

    @classmethod
    def for_budget(
        cls,
        seconds: float | None = None,
        *,
        steps: int | None = None,
        footprint_m: float,
        frames: int | None = None,
        seed: int = 0,
        held_out_stride: int = HELD_OUT_STRIDE,
    ) -> "TrainConfig":
        """The recipe for a waiting time, or a number of steps, and a picture size.

        Args:
            seconds: How long the user will wait.
            steps: Number of training steps instead of `seconds`.
            footprint_m: What one pixel covers on the body, metres.
            frames: How many frames there are, if that is known. Few of them, seen in poses that
                are a little off, do not determine the finest detail: what they leave open would
                be noise, in which no pose can be refined. So detail is coarser; surfaces are asked
                to be smoother. Of fewer than a dozen they are, most of all at first, while poses
                are found; the body is solid inside; and what poses do not agree upon is no fog in
                the end, but firm; no edge is sharper than the finest cells; haze and webs between
                the legs are gone.
            seed: Of everything random.
            hold_every: Every so manieth frame is held out.
        """
        if seconds is None:
            seconds = 60.0 if steps is None else steps / NOMINAL_STEPS_PER_S
        too_few = 1.0 if frames is None else max(1.0, FULL_DETAIL_FRAMES / max(frames, 1))
        footprint_m *= too_few**0.5
        few = min(too_few, MAX_DETAIL_SHORTAGE)
        scant = 1.0 if frames is None else FEW_FRAMES / max(frames, 1)
        scant = min(max(scant, 1.0), MAX_FRAME_SHORTAGE)
        finest_m = min(max(footprint_m, 0.002), COARSEST_M / 2)
        # about four times as many entries as the skin has cells, within what a cache can hold
        wanted = 4.0 * 2.0 / finest_m**2
        size = 1 << min(max(round(math.log2(wanted)), 15), 19 if seconds > 120 else 17)
        return cls(
            seconds=seconds,
            steps=steps,
            sample_step_m=min(max(1.2 * footprint_m, 0.004), 0.015),
            finest_m=finest_m,
            table_size=size,
            density_tv_weight=cls.density_tv_weight * few * scant**3,
            initial_density_tv_factor=scant**3,
            double_well_weight=FEW_FRAMES_DOUBLE_WELL_WEIGHT * (1.0 - 1.0 / scant),
            interior_weight=FEW_FRAMES_INTERIOR_WEIGHT * (1.0 - 1.0 / scant),
            density_slope_weight=FEW_FRAMES_SLOPE_WEIGHT * (1.0 - 1.0 / scant),
            color_tv_weight=FEW_FRAMES_COLOR_TV_WEIGHT * (1.0 - 1.0 / scant),
            min_occupied_density=FEW_FRAMES_MIN_DENSITY * (1.0 - 1.0 / scant),
            inner_leg_weight=FEW_FRAMES_INNER_LEG_WEIGHT * (1.0 - 1.0 / scant),
            seed=seed,
            held_out_stride=held_out_stride,
        )
