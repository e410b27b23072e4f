"""Checks of ia-play --verify and --bench: whether rendering is right here, and how fast it is."""

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from capture.camera import Camera
from export.package.manifest import Manifest
from export.package.package_file import read_package
from export.player import MIN_SAME_PSNR, Player, compare_golden_frames, find_provider
from preprocess.body.body_pose import BodyPose


def to_json_text(content: dict[str, Any]) -> str:
    """Serialize a result for scripts; floats keep four digits."""
    rounded = {k: round(v, 4) if isinstance(v, float) else v for k, v in content.items()}
    return json.dumps(rounded, indent=1) + "\n"


def package_warnings(manifest: Manifest) -> list[str]:
    """Return the weaknesses that a package was written with, a sentence each."""
    notes = [str(warning) for warning in manifest.metrics.get("warnings") or ()]
    mark = manifest.metrics.get("held_out")
    if isinstance(mark, dict) and mark.get("verdict") == "failed":
        notes.append(
            "This avatar failed validation: held-out PSNR was "
            f"{mark.get('psnr') or float('nan'):.1f} dB (failed) when it was trained."
        )
    return notes


def verify_package(path: Path, *, provider: str) -> dict[str, Any]:
    """Read a package, checking every entry, and draw its golden frames again.

    Returns:
        JSON: the verdict ("same" if all golden frames match, of which there is at least one), and
        for each frame the largest difference (in 1/255), the fraction of close pixels and the PSNR.
    """
    package = read_package(path, tier=None)
    frames = compare_golden_frames(package, provider=provider)
    matches = bool(frames) and all(frame.matches for frame in frames)
    return {
        "format": 1,
        "verdict": "same" if matches else "different",
        "provider": find_provider(provider),
        "onnxruntime": onnxruntime.__version__,
        "warnings": package_warnings(package.manifest),
        "frames": [
            {
                "largest": round(frame.largest_difference, 3),
                "close": round(frame.close_fraction, 6),
                "psnr": round(frame.psnr, 2),
            }
            for frame in frames
        ],
    }


def verdict_lines(result: dict[str, Any]) -> list[str]:
    """Return a line for each golden frame of a `verify_package`, and the verdict."""
    lines = [
        f"golden frame {number}: "
        f"{'same' if frame['psnr'] >= MIN_SAME_PSNR else 'DIFFERENT'} "
        f"({frame['psnr']:.1f} dB, largest difference {frame['largest']:.0f}/255)"
        for number, frame in enumerate(result["frames"])
    ]
    where = f"{result['provider']}, onnxruntime {result['onnxruntime']}"
    if result["verdict"] == "same":
        return [*lines, f"verdict: same ({where})"]
    different = sum(frame["psnr"] < MIN_SAME_PSNR for frame in result["frames"])
    verdict = (
        f"verdict: DIFFERENT; {different} of {len(lines)} golden frames ({where}). Update "
        "onnxruntime, try --provider cpu, or report it with these lines."
    )
    return [*lines, verdict]


REFERENCE_GRAPH = Path(__file__).with_name("reference.onnx")
"""Written by test_player_timing.py, which compares it with onnx's."""
MIN_IMAGES = 10
"""Least number of timed images; short motions are repeated."""


@dataclass(frozen=True, kw_only=True)
class PlayerTiming:
    """Cost of an image: kinematics, graph and 8-bit output, without encoding.

    Attributes:
        size: Longer side, pixels.
        pixels_covered: Mean fraction of pixels with any alpha.
        cpu_ms_per_frame: Mean CPU time per image.
        wall_ms_per_frame: Mean wall time per image.
        load_ms: Wall time of opening the package.
        reference_ms: Median CPU time of the reference graph.
    """

    format: int = 1
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

    def to_json(self) -> str:
        """Return the rounded values as JSON."""
        return to_json_text(asdict(self))


def benchmark_player(
    player: Player,
    sequence: Sequence[tuple[BodyPose, Camera]],
    *,
    load_ms: float,
    tier: str = "hq",
    workers: int = 1,
) -> PlayerTiming:
    """Render a sequence after a warm-up and time it."""
    sequence = list(sequence) * -(-MIN_IMAGES // len(sequence))
    list(player.render_all(sequence[: 3 * workers], workers=workers))
    covered = 0.0
    wall, cpu = time.perf_counter(), time.process_time()
    for picture in player.render_all(sequence, workers=workers):
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
        reference_ms=_reference_ms(),
        provider=player.provider,
        workers=workers,
        pictures_per_second=len(sequence) / wall,
    )


def _reference_ms() -> float:
    """Time the reference graph: GatherElements, MatMul and ScatterElements of fixed sizes.

    It is a file, so that the player does not need the `onnx` package.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    graph = REFERENCE_GRAPH.read_bytes()
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
    rng = np.random.default_rng(0)
    inputs = {
        "table": rng.standard_normal((1 << 15, 16)).astype(np.float32),
        "matrix": rng.standard_normal((16, 16)).astype(np.float32),
        "places": rng.integers(0, 1 << 15, (1 << 15, 16)),
    }
    times = []
    for _ in range(10):
        started = time.process_time()
        session.run(None, inputs)
        times.append(time.process_time() - started)
    return 1000.0 * float(np.median(times[1:]))  # the first run warms up
