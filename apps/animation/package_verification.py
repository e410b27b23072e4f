"""Whether a package looks here as it did where it was written."""

import json
from dataclasses import dataclass
from pathlib import Path

import onnxruntime

from export.package.manifest import Manifest
from export.picture_difference import (
    MAX_CLOSE_DIFFERENCE,
    MIN_CLOSE_FRACTION,
    PictureDifference,
)
from export.player import find_provider
from export.player import verify_package as draw_golden_frames


@dataclass(frozen=True, kw_only=True)
class VerificationResult:
    """What became of the golden frames.

    Attributes:
        frames: For each of them, how far it is from the stored one.
        provider: onnxruntime's execution provider.
    """

    frames: tuple[PictureDifference, ...]
    provider: str

    @property
    def matches(self) -> bool:
        """Whether all of them look the same; a package without any proves nothing."""
        return bool(self.frames) and all(frame.matches for frame in self.frames)

    def to_lines(self) -> list[str]:
        """For the user."""
        said = [
            f"golden frame {number}: {'same' if frame.matches else 'DIFFERENT'} "
            f"({frame.close_fraction:.2%} within {MAX_CLOSE_DIFFERENCE}/255, largest difference {frame.largest_difference:.0f}/255)"
            for number, frame in enumerate(self.frames)
        ]
        where = f"{self.provider}, onnxruntime {onnxruntime.__version__}"
        if not self.frames:
            return [f"verdict: none; the package holds no golden frames ({where})."]
        worst = max(frame.largest_difference for frame in self.frames)
        if self.matches:
            return [
                *said,
                f"verdict: same; {len(self.frames)} golden frames, worst difference "
                f"{worst:.0f}/255 ({where})",
            ]
        bad = sum(not frame.matches for frame in self.frames)
        return [
            *said,
            f"verdict: DIFFERENT; {bad} of {len(self.frames)} golden frames are not within "
            f"{MAX_CLOSE_DIFFERENCE}/255 on {MIN_CLOSE_FRACTION:.1%} of the pixels, worst difference {worst:.0f}/255 "
            f"({where}). Update onnxruntime, try --provider cpu, or report it with these lines.",
        ]

    def to_json(self) -> str:
        """For machines."""
        content = {
            "format": 1,
            "verdict": "same" if self.matches else "different",
            "provider": self.provider,
            "onnxruntime": onnxruntime.__version__,
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
    """What was found wrong with an avatar when its package was written, a sentence each."""
    notes = [str(warning) for warning in manifest.metrics.get("warnings") or ()]
    mark = manifest.metrics.get("held_out")
    if isinstance(mark, dict) and mark.get("verdict") == "failed":
        notes.append(
            "This is no usable avatar of its person: when it was learnt, frames held out for "
            f"scoring were drawn at {mark.get('psnr') or float('nan'):.1f} dB (failed)."
        )
    return notes


def verify_package(package: Path, *, provider: str) -> VerificationResult:
    """Draws the golden frames of a package.

    Raises:
        InputError: If the file is no sound package, or there is no such provider.
    """
    frames = tuple(draw_golden_frames(package, provider=provider))
    return VerificationResult(frames=frames, provider=find_provider(provider))
