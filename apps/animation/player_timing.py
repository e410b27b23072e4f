"""Benchmark of the player, with a fixed reference graph that measures the machine."""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import onnxruntime

from capture.camera import Camera
from export.player import Player
from preprocess.body.body_pose import BodyPose

REFERENCE_GRAPH = Path(__file__).with_name("reference.onnx")
"""Written by tests/apps/animation/test_player_timing.py, which compares it with onnx's."""
WARM_UP_IMAGES = 3
"""Images rendered before timing, per worker."""
MIN_IMAGES = 10
"""Least number of timed images; short motions are repeated."""


@dataclass(frozen=True, kw_only=True)
class PlayerTiming:
    """Cost of an image: kinematics, graph and 8-bit output, without encoding.

    Attributes:
        tier: Quality tier of the package.
        size: Longer side, pixels.
        frames: Number of timed images.
        pixels_covered: Mean fraction of pixels with any alpha.
        cpu_ms_per_frame: Mean CPU time per image.
        wall_ms_per_frame: Mean wall time per image.
        load_ms: Wall time of opening the package.
        reference_ms: Median CPU time of the reference graph.
        provider: onnxruntime's execution provider.
        workers: Images rendered in parallel.
        pictures_per_second: Images per second of wall time.
        format: Version of this record.
    """

    tier: str
    size: int
    frames: int
    pixels_covered: float
    cpu_ms_per_frame: float
    wall_ms_per_frame: float
    load_ms: float
    reference_ms: float
    provider: str = "CPUExecutionProvider"
    workers: int = 1
    pictures_per_second: float = 0.0
    format: int = 1

    def to_json(self) -> str:
        """Return the rounded values as JSON."""
        content = {k: round(v, 4) if isinstance(v, float) else v for k, v in asdict(self).items()}
        return json.dumps({"format": content.pop("format"), **content}, indent=1) + "\n"


def benchmark_player(
    player: Player,
    sequence: Sequence[tuple[BodyPose, Camera]],
    *,
    load_ms: float,
    tier: str = "hq",
    workers: int = 1,
    samples: int | None = None,
) -> PlayerTiming:
    """Render a sequence after a warm-up and time it."""
    sequence = list(sequence) * -(-MIN_IMAGES // len(sequence))
    list(player.render_all(sequence[: WARM_UP_IMAGES * workers], workers=workers, samples=samples))
    covered = 0.0
    wall, cpu = time.perf_counter(), time.process_time()
    for picture in player.render_all(sequence, workers=workers, samples=samples):
        covered += float(np.count_nonzero(picture[..., 3])) / picture[..., 3].size
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return PlayerTiming(
        tier=tier,
        size=max(sequence[0][1].size_px),
        frames=len(sequence),
        pixels_covered=covered / len(sequence),
        cpu_ms_per_frame=1000.0 * cpu / len(sequence),
        wall_ms_per_frame=1000.0 * wall / len(sequence),
        load_ms=load_ms,
        reference_ms=_reference_ms(_reference_graph()),
        provider=player.provider,
        workers=workers,
        pictures_per_second=len(sequence) / wall,
    )


def _reference_graph() -> onnxruntime.InferenceSession:
    """Load the reference graph: GatherElements, MatMul and ScatterElements of fixed sizes.

    It is a file, so that the player does not need the `onnx` package.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(
        REFERENCE_GRAPH.read_bytes(), options, providers=["CPUExecutionProvider"]
    )


def _reference_ms(session: onnxruntime.InferenceSession, runs: int = 9) -> float:
    rng = np.random.default_rng(0)
    inputs = {
        "table": rng.standard_normal((1 << 15, 16)).astype(np.float32),
        "matrix": rng.standard_normal((16, 16)).astype(np.float32),
        "places": rng.integers(0, 1 << 15, (1 << 15, 16)),
    }
    times = []
    for _ in range(runs + 1):
        started = time.process_time()
        session.run(None, inputs)
        times.append(time.process_time() - started)
    return 1000.0 * float(np.median(times[1:]))  # the first run warms up
