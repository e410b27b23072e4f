"""Which masks a capture is learnt with: one decision for recordings and for live sources."""

from dataclasses import dataclass
from pathlib import Path

from preprocess.masks.segmenter import DEFAULT_SEGMENTER, segmenter_name


@dataclass(frozen=True, kw_only=True)
class MaskOrigin:
    """Where the masks come from: a file or folder, a segmenter, or else the alpha channel.

    Attributes:
        path: The file or folder; None if there is none.
        segmenter: Name of the segmenter that estimates them; None if nothing is estimated.
        named: Whether the user named it.
    """

    path: Path | None = None
    segmenter: str | None = None
    is_explicit: bool = False

    @property
    def uses_alpha_channel(self) -> bool:
        """Whether the pictures' own alpha channel is the mask."""
        return self.path is None and self.segmenter is None

    @property
    def is_fallback(self) -> bool:
        """Whether masks are estimated only because there are no others."""
        return self.segmenter is not None and not self.is_explicit


def choose_mask_origin(requested: Path | None, found: Path | None, *, has_alpha: bool) -> MaskOrigin:
    """Takes what the user named; else a file that was found, the alpha channel, or an estimate.

    Args:
        given: What --masks names: a file, a folder, or `segmenter:NAME`.
        found: Masks that lie in the capture folder or beside the video.
        has_alpha: Whether the pictures' alpha channel cuts the person out; an opaque one does not.
    """
    segmenter = segmenter_name(requested)
    if segmenter is not None:
        return MaskOrigin(segmenter=segmenter, is_explicit=True)
    if requested is not None:
        return MaskOrigin(path=requested, is_explicit=True)
    if found is not None:
        return MaskOrigin(path=found)
    return MaskOrigin() if has_alpha else MaskOrigin(segmenter=DEFAULT_SEGMENTER)
