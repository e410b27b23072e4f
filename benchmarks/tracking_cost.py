"""A process of one thread that tracks a video and prints what each part costs a frame.

    python -m benchmarks.tracking_cost VIDEO

Costs are CPU time: other programs on the machine hardly count. Decoding is left out.
"""

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import cv2

from capture.source_opening import open_source
from instant_avatar.run.person_tracking import fit_tracked_video
from preprocess.capture_inputs import CaptureInputs
from preprocess.masks.mask_refinement import MaskRefiner
from preprocess.plugins import make_tracker
from preprocess.tracking.video_tracking import VideoTracking

WARM_FRAMES = slice(0, 12)
"""Frames that are tracked first, to load code and networks."""


@final
class CpuTimed:
    """A function that sums up the CPU time of the thread that calls it.

    Attributes:
        cpu_s: In all calls so far.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        """Nothing is called yet."""
        self._function, self.cpu_s = function, 0.0

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        """Call the function."""
        began = time.thread_time()
        result = self._function(*arguments, **named)
        self.cpu_s += time.thread_time() - began
        return result


def measure_costs(video: Path, frames: slice | None = None) -> dict[str, float]:
    """Core-milliseconds a frame of networks, masks (without encoding them), and lift and fit.

    Args:
        video: The recording.
        frames: Which of its frames; all if None.
    """
    source = open_source(video, frames=frames)
    networks, masks = CpuTimed(make_tracker()), CpuTimed(MaskRefiner(source.size_px))
    with TemporaryDirectory() as folder:
        tracking = VideoTracking(source, networks, masks, Path(folder))
        for _ in tracking.run():
            pass
        tracked = tracking.result()
        fit = CpuTimed(fit_tracked_video)
        inputs = CaptureInputs(
            video=video, frames=frames, poses=Path(folder) / "poses.npz", masks=Path(folder)
        )
        fit(source, tracked, inputs)
    count = len(tracked.frame_times_s)
    parts = {"networks": networks, "masks": masks, "fit": fit}
    each = {name: 1000.0 * part.cpu_s / count for name, part in parts.items()}
    return {"frames": float(count), **each}


def main() -> None:
    """Print the costs of the second of two runs."""
    cv2.setNumThreads(1)
    video = Path(sys.argv[1])
    measure_costs(video, WARM_FRAMES)
    print(json.dumps(measure_costs(video)))


if __name__ == "__main__":
    main()
