"""Settings of ia-sample's films, as a record that is read without loading what films it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

from capture.input_error import InputError


@dataclass(frozen=True, kw_only=True)
class ShootConfig:
    """What is filmed, and how well the poses and masks are known."""

    frames: int = 120
    """Frames of the video."""
    fps: float = 30.0
    """Frames per second of the video."""
    size: int = 270
    """Width and height of the pictures in pixels; a walkaround's are so wide, and 16:9."""
    turns: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """How often the actor turns round; if not given 2, in a walkaround -0.75 (against the walk)."""
    seed: int = 0
    """Of the swaying, the clutter and the noise; from 1 on it varies the actor's looks, too."""
    subject: Literal[1, 2, 3] = 1
    """Which of the three actors."""
    motion: Literal["turn", "dance", "walkaround"] = "turn"
    """What happens: the actor turns with arms held off the body, or dances; or gestures while a
    phone is carried around (poses.npz is then in the camera of each frame, with K; the cameras lie
    in truth/cameras.npz)."""
    track: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Pose file whose motion is filmed instead of a turn of the studio's own, such as a track of
    PeopleSnapshot; `frames` of its poses, evenly spread, on the spot."""
    background: Annotated[
        Literal["plain", "clutter", "room", "tiles"] | None,
        arg(metavar="{plain,clutter,room,tiles}", help_behavior_hint=""),
    ] = None
    """What stands behind the actor: a bare wall, a painted room full of things (if not given), a
    real room with furniture (a walkaround's, if not given), or one where every pattern repeats."""
    pose_noise_deg: float = 0.0
    """Noise of the poses: standard deviation of each rotation component, in degrees."""
    pose_noise_cm: float = 0.0
    """Noise of the poses: standard deviation of each component of the place, in centimetres."""
    mask_noise_px: float = 0.0
    """Noise of the masks: standard deviation of their border, in pixels."""
    like_a_phone: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = False
    """Film as a user does: a portrait by a phone (`size` wide, 9:16) whose exposure drifts, in a
    room with a window; the person's proportions are not the body model's; poses err as a
    tracker's do, masks as a segmenter's, the focal length is off by about 10 %. What is exact
    lies in truth/."""
    tracker_error: float = 1.0
    """With --like-a-phone: factor of the errors of poses and focal length; 0: only the body and
    the masks are wrong."""

    @property
    def camera_moves(self) -> bool:
        """Tell whether the camera moves."""
        return self.motion == "walkaround"

    @property
    def effective_background(self) -> Literal["plain", "clutter", "room", "tiles"]:
        """Background, with the default of the motion."""
        return self.background or ("room" if self.camera_moves else "clutter")

    def validate(self) -> None:
        """Refuse numbers out of their range and contradictory options (`InputError`)."""
        ranges = {
            "frames": (1, 100_000), "fps": (0.1, 1000.0), "size": (16, 4096),
            "turns": (-100.0, 100.0), "seed": (0, 2**31 - 1), "pose_noise_deg": (0.0, 90.0),
            "pose_noise_cm": (0.0, 100.0), "mask_noise_px": (0.0, 50.0),
            "tracker_error": (0.0, 5.0),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                option = "--" + name.replace("_", "-")
                raise InputError(f"{option} is {value}, but must lie between {low} and {high}.")
        if self.track is not None and self.motion != "turn":
            raise InputError("--track replaces the turn: leave out --motion, or leave out --track.")
        if self.like_a_phone:
            self._validate_phone()
        if self.camera_moves and self.effective_background in ("plain", "clutter"):
            raise InputError(
                f"--background {self.effective_background} is painted for a static camera; with "
                "--motion walkaround use room or tiles."
            )

    def _validate_phone(self) -> None:
        own_noise = self.pose_noise_deg or self.pose_noise_cm or self.mask_noise_px
        if self.camera_moves or self.background in ("room", "tiles") or own_noise:
            raise InputError(
                "--like-a-phone films --motion turn or dance before --background plain or clutter, "
                "and has noise of its own: leave out --motion walkaround and the noise."
            )
