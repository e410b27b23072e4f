"""One picture of the stream: when it was taken and what is wrong with it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """An upright RGB picture and its place in the stream.

    Attributes:
        index: Position in the source, counted from 0 (frames that were skipped keep their number).
        time_s: Container timestamp in seconds; never computed from an assumed rate.
        rgb: Picture, 8-bit RGB, upright.
        flags: What is wrong with it: "corrupt", "repeated", or both.
        alpha: The source's own alpha channel (RGBA pictures), else None.
        due_s: When it was there to be taken, on `time.perf_counter`'s clock: played or filmed at
            that moment. None for a recording that is read as fast as it is taken.
        name: Of the picture's file without its ending, where each picture has a file.
    """

    index: int
    time_s: float
    rgb: UInt8[np.ndarray, "height width 3"]
    flags: frozenset[str] = frozenset()
    alpha: UInt8[np.ndarray, "height width"] | None = None
    due_s: float | None = None
    name: str | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.rgb.shape[1], self.rgb.shape[0]
