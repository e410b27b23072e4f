"""Options that several commands share: which frames of a capture, and how to read its masks."""

import re

from capture.input_error import InputError


def parse_frame_range(text: str) -> slice | None:
    """Parse START:STOP:STEP as a slice; None for all frames.

    Raises:
        InputError: If the text has another form.
    """
    if not re.fullmatch(r"\d*(:\d*){0,2}", text) or ":" not in text:
        raise InputError(
            f"--frames is {text!r}, but must be START:STOP:STEP counted from 0, as in 0:120:2 or "
            "30:."
        )
    parts = [int(part) if part else None for part in text.split(":")]
    return None if not any(part is not None for part in parts) else slice(*parts)


def format_frame_range(frames: slice | None) -> str:
    """Return the text that `parse_frame_range` parses."""
    parts = (None, None) if frames is None else (frames.start, frames.stop, frames.step)
    return ":".join("" if part is None else str(part) for part in parts)


def mask_inversion(*, person_dark: bool, person_bright: bool) -> bool | None:
    """Return whether to invert masks; None to detect it.

    Args:
        person_dark: Whether --mask-invert was given.
        person_bright: Whether --no-mask-invert was given.

    Raises:
        InputError: If both were given.
    """
    if person_dark and person_bright:
        raise InputError("--mask-invert and --no-mask-invert are mutually exclusive.")
    return person_dark if person_dark or person_bright else None
