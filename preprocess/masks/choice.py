"""Which masks a capture is learnt with: one decision for recordings and for live sources."""

from dataclasses import dataclass
from pathlib import Path

from preprocess.masks.segmenter import OURS, segmenter_name


@dataclass(frozen=True, kw_only=True)
class MaskChoice:
    """Where the masks come from: a file or folder, a segmenter, or else the alpha channel.

    Attributes:
        path: The file or folder; None if there is none.
        segmenter: Name of the segmenter that estimates them; None if nothing is estimated.
        named: Whether the user named it.
    """

    path: Path | None = None
    segmenter: str | None = None
    named: bool = False

    @property
    def alpha(self) -> bool:
        """Whether the pictures' own alpha channel is the mask."""
        return self.path is None and self.segmenter is None

    @property
    def fallback(self) -> bool:
        """Whether masks are estimated only because there are no others."""
        return self.segmenter is not None and not self.named


def choose_masks(given: Path | None, found: Path | None, *, has_alpha: bool) -> MaskChoice:
    """Takes what the user named; else a file that was found, the alpha channel, or an estimate.

    Args:
        given: What --masks names: a file, a folder, or `segmenter:NAME`.
        found: Masks that lie in the capture folder or beside the video.
        has_alpha: Whether the pictures' alpha channel cuts the person out; an opaque one does not.
    """
    segmenter = segmenter_name(given)
    if segmenter is not None:
        return MaskChoice(segmenter=segmenter, named=True)
    if given is not None:
        return MaskChoice(path=given, named=True)
    if found is not None:
        return MaskChoice(path=found)
    return MaskChoice() if has_alpha else MaskChoice(segmenter=OURS)
