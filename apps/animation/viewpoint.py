"""Viewpoint of the camera relative to the person: orbit, elevation, distance, zoom, turntable."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from capture.input_error import InputError
from preprocess.body.kinematics import JOINT_NAMES, rotation_matrices

CLOSE_UP_ZOOM = 3.5
"""Default --zoom with --close-up."""
MIN_DISTANCE_M, MAX_DISTANCE_M = 0.3, 100.0
"""Limits of --distance, meters."""
MAX_ZOOM = 50.0
"""Limit of --zoom, and of its inverse."""


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Position of the camera relative to the person, who faces it at 0°.

    Attributes:
        orbit_deg: Azimuth around the person; 90° is at the person's left hand.
        elevation_deg: Elevation above the person's center; 90° looks straight down.
        zoom: Magnification relative to a view of the whole person.
        distance_m: Distance to the target; None for 3.5 heights of the person. The focal length is
            kept, so that a closer camera shows the person larger.
        joint: Target of the camera (see `JOINT_NAMES`); None for the person's center.
        turn_period_s: Seconds per turn around the person; negative for the other direction, None
            for no turntable.
    """

    orbit_deg: float = 0.0
    elevation_deg: float = 0.0
    zoom: float = 1.0
    distance_m: float | None = None
    joint: str | None = None
    turn_period_s: float | None = None

    def __post_init__(self) -> None:
        """Check ranges.

        Raises:
            InputError: If a value is out of its range.
        """
        if not np.isfinite(self.orbit_deg):
            raise InputError(f"--orbit is {self.orbit_deg}, but must be an angle in degrees.")
        if not -90.0 <= self.elevation_deg <= 90.0:
            raise InputError(
                f"--elevation is {self.elevation_deg:g}, but must lie between -90 (from below) and "
                "90 degrees (from above)."
            )
        if not 1.0 / MAX_ZOOM <= self.zoom <= MAX_ZOOM:
            raise InputError(f"--zoom is {self.zoom:g}, but must be at most {MAX_ZOOM:g}.")
        if self.distance_m is not None and not MIN_DISTANCE_M <= self.distance_m <= MAX_DISTANCE_M:
            raise InputError(
                f"--distance is {self.distance_m:g}, but must lie between {MIN_DISTANCE_M} and "
                f"{MAX_DISTANCE_M:g} m. For a closer view use --zoom."
            )
        if self.joint is not None and self.joint not in JOINT_NAMES:
            raise InputError(
                f"--close-up is {self.joint}, but must be one of {', '.join(JOINT_NAMES)}."
            )
        if self.turn_period_s is not None and not 0.1 <= abs(self.turn_period_s) <= 3600.0:
            raise InputError(
                f"--turntable is {self.turn_period_s:g}, but must lie between 0.1 and 3600 seconds "
                "(negative reverses)."
            )

    def rotation_at(self, seconds: float) -> Float[np.ndarray, "3 3"]:
        """Return the rotation from a level camera in front of the person to this viewpoint.

        Args:
            seconds: Time since the first frame.
        """
        turns = 0.0 if self.turn_period_s is None else seconds / self.turn_period_s
        round_it = np.array([0.0, np.deg2rad(self.orbit_deg) + 2.0 * np.pi * turns, 0.0])
        above = np.array([np.deg2rad(self.elevation_deg), 0.0, 0.0])
        return rotation_matrices(above) @ rotation_matrices(round_it)
