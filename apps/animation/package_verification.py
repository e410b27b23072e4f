"""Verification of a package on this machine: its golden frames, and the warnings it carries."""

import json
from dataclasses import dataclass
from pathlib import Path

import onnxruntime

from export.package.manifest import Manifest
from export.package.package_file import read_package
from export.player import (
    MAX_CLOSE_DIFFERENCE,
    MIN_CLOSE_FRACTION,
    PictureDifference,
    compare_golden_frames,
    find_provider,
)


@dataclass(frozen=True, kw_only=True)
class VerificationResult:
    """Outcome of drawing a package's golden frames again.

    Attributes:
        frames: Difference of each from the stored picture.
        provider: onnxruntime's execution provider.
        warnings: Weaknesses that the package was written with.
    """

    frames: tuple[PictureDifference, ...]
    provider: str
    warnings: tuple[str, ...] = ()

    @property
    def matches(self) -> bool:
        """Whether all frames match; a package without any proves nothing."""
        return bool(self.frames) and all(frame.matches for frame in self.frames)

    def to_lines(self) -> list[str]:
        """Return a line for each frame, and the verdict."""
        lines = [
            f"golden frame {number}: {'same' if frame.matches else 'DIFFERENT'} "
            f"({frame.close_fraction:.2%} within {MAX_CLOSE_DIFFERENCE}/255, "
            f"largest difference {frame.largest_difference:.0f}/255)"
            for number, frame in enumerate(self.frames)
        ]
        where = f"{self.provider}, onnxruntime {onnxruntime.__version__}"
        if not self.frames:
            return [f"verdict: none; the package holds no golden frames ({where})."]
        count, worst = len(self.frames), max(frame.largest_difference for frame in self.frames)
        if self.matches:
            verdict = f"same; {count} golden frames, worst difference {worst:.0f}/255 ({where})"
        else:
            bad = sum(not frame.matches for frame in self.frames)
            verdict = (
                f"DIFFERENT; {bad} of {count} golden frames are not within "
                f"{MAX_CLOSE_DIFFERENCE}/255 on {MIN_CLOSE_FRACTION:.1%} of the pixels, worst "
                f"difference {worst:.0f}/255 ({where}). Update onnxruntime, try --provider cpu, or "
                "report it with these lines."
            )
        return [*lines, f"verdict: {verdict}"]

    def to_json(self) -> str:
        """Serialize for scripts."""
        content = {
            "format": 1,
            "verdict": "same" if self.matches else "different",
            "provider": self.provider,
            "onnxruntime": onnxruntime.__version__,
            "warnings": list(self.warnings),
            "frames": [
                {
                    "largest": round(frame.largest_difference, 3),
                    "close": round(frame.close_fraction, 6),
                }
                for frame in self.frames
            ],
        }
        return json.dumps(content, indent=1) + "\n"


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


def verify_package(path: Path, *, provider: str) -> VerificationResult:
    """Read a package, checking every entry, and draw its golden frames again.

    Raises:
        InputError: If the file is not a sound package, or the provider is unknown.
    """
    package = read_package(path, tier=None)
    return VerificationResult(
        frames=tuple(compare_golden_frames(package, provider=provider)),
        provider=find_provider(provider),
        warnings=tuple(package_warnings(package.manifest)),
    )
