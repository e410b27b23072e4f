"""From where an avatar is looked at: round it, from above, near by, and turning."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from capture.input_error import InputError
from preprocess.body.kinematics import JOINT_NAMES, rotation_matrices

CLOSE_UP_ZOOM = 3.5
"""How much larger than the whole person a joint and what is about it are shown."""
MIN_DISTANCE_M, MAX_DISTANCE_M = 0.3, 100.0
MAX_ZOOM = 50.0


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Where the camera stands, seen from the person, who faces it at 0°.

    Attributes:
        orbit_deg: Round the person; at 90° it stands at the person's left hand.
        elevation_deg: Above the person's middle; 90° is straight down.
        zoom: How many times larger the person is than when all of it is shown.
        distance_m: How far it stands from what it looks at; None: 3.5 heights of the person.
            The lens stays, so that a nearer camera shows the person larger.
        joint: What it looks at (see `JOINT_NAMES`); None: the person's middle.
        turn_period_s: How long the camera takes for one turn about the person; negative: the other way;
            None: it does not turn.
    """

    orbit_deg: float = 0.0
    elevation_deg: float = 0.0
    zoom: float = 1.0
    distance_m: float | None = None
    joint: str | None = None
    turn_period_s: float | None = None

    def __post_init__(self) -> None:
        """Checks it.

        Raises:
            InputError: If one of them cannot be.
        """
        if not np.isfinite(self.orbit_deg):
            raise InputError(f"--orbit is {self.orbit_deg}; an angle in degrees was expected.")
        if not -90.0 <= self.elevation_deg <= 90.0:
            raise InputError(
                f"--elevation is {self.elevation_deg:g}; -90 (from below) to 90 degrees (from "
                "above) were expected."
            )
        if not 1.0 / MAX_ZOOM <= self.zoom <= MAX_ZOOM:
            raise InputError(f"--zoom is {self.zoom:g}; up to {MAX_ZOOM:g} times were expected.")
        if self.distance_m is not None and not MIN_DISTANCE_M <= self.distance_m <= MAX_DISTANCE_M:
            raise InputError(
                f"--distance is {self.distance_m:g}; {MIN_DISTANCE_M} to {MAX_DISTANCE_M:g} metres were "
                "expected. --zoom comes closer than that."
            )
        if self.joint is not None and self.joint not in JOINT_NAMES:
            raise InputError(
                f"--close-up {self.joint}: there is no such joint; there are "
                f"{', '.join(JOINT_NAMES)}."
            )
        if self.turn_period_s is not None and not 0.1 <= abs(self.turn_period_s) <= 3600.0:
            raise InputError(
                f"--turntable is {self.turn_period_s:g}; a turn takes 0.1 to 3600 seconds (negative: the "
                "other way)."
            )

    def rotation_at(self, seconds: float) -> Float[np.ndarray, "3 3"]:
        """Camera from a camera that stands in front, level; its axes are right, down, forward.

        Args:
            seconds: Since the first picture.
        """
        turns = 0.0 if self.turn_period_s is None else seconds / self.turn_period_s
        round_it = np.array([0.0, np.deg2rad(self.orbit_deg) + 2.0 * np.pi * turns, 0.0])
        above = np.array([np.deg2rad(self.elevation_deg), 0.0, 0.0])
        return rotation_matrices(above) @ rotation_matrices(round_it)
