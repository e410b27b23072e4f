"""What every decoder of videos gives: one picture after the other."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from capture.errors import InputError

MAX_DECODE_FAILURES = 16
"""How many failures in a row are the end: one damaged packet is none."""


class DecoderFrame(NamedTuple):
    """A picture at which the decoder stands.

    Attributes:
        time_s: The container's timestamp, from the first picture on.
        after_gap: Whether pictures before it could not be decoded.
        corrupt: Whether the decoder has patched it up.
        rgb: Decodes it, upright; None if that fails. To be called before the next shot is taken.
    """

    time_s: float
    after_gap: bool
    corrupt: bool
    rgb: Callable[[], UInt8[np.ndarray, "height width 3"] | None]


@runtime_checkable
class VideoDecoder(Protocol):
    """An open video.

    Attributes:
        rate: EvaluationFrames a second, as the container claims; 0 if it does not.
        claimed: How many frames there are, as the container claims; 0 or less if it does not.
        quarter_turns: How often its pictures are turned by 90° against the clock to stand upright.
        deep: Whether its pictures have more than 8 bits.
        knows_hdr: Whether HDR's highlights are kept.
        leaves_alpha: Whether its pictures have an alpha channel, as far as is known one that is not
            opaque; it is not read.
    """

    rate: float
    claimed: int
    quarter_turns: int
    deep: bool
    knows_hdr: bool
    leaves_alpha: bool

    def decode(self) -> Iterator[DecoderFrame]:
        """The pictures in order; every call starts anew."""
        ...


def unreadable_video_error(path: Path) -> InputError:
    """What is said of a file that no decoder opens."""
    return InputError(
        f"{path} is no video that can be opened; does it hold pictures, or sound "
        "alone? A recording that was cut off before "
        "it was finished has no index and cannot be read: copy it again from the camera."
    )
