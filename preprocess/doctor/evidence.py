"""A few frames' masks, small, against which every guess is held."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.errors import BadInput
from capture.frame import Frame
from capture.images import list_images, read_image
from capture.source import Source
from preprocess.doctor.claim import Claim
from preprocess.masks.files import Masks
from preprocess.observe import own_alpha
from preprocess.pose import Motion
from preprocess.silhouette import PERSON_PX, SkinPoints, agreement, silhouette

FRAMES = 16
"""How many frames are looked at."""
FIRST_LOOK_PX = 256.0
"""Longer side of the masks in which the person's height is measured."""
BOX = 0.95
"""Share of its bounding box that no person's outline fills."""
PART = 0.1
"""Fraction of a mask's connected part that the body must cover to be of the same person."""
MOST_KEPT = 256
"""Posed skins that are kept: 25 MB."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Witness:
    """One frame's mask.

    Attributes:
        index: The frame's number.
        camera_row: Which camera is its.
        alpha: How far each pixel is person, small.
    """

    index: int
    camera_row: int
    alpha: Float32[np.ndarray, "height width"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """The masks of a few frames, spread over the capture.

    Attributes:
        witnesses: In the frames' order; all masks are of one size.
        skin: The person whose silhouette is held against them.
        refused: Why masks that were looked at cannot be used.
    """

    witnesses: tuple[Witness, ...]
    skin: SkinPoints
    refused: tuple[str, ...] = ()
    _posed: dict[tuple[Motion, int], Float32[np.ndarray, "points 3"]] = field(default_factory=dict)

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the small masks."""
        height, width = self.witnesses[0].alpha.shape
        return int(width), int(height)

    @property
    def boxes(self) -> bool:
        """Whether the masks are boxes around the person, which say nothing of its size."""
        return float(np.median([_filled(w.alpha > 0.5) for w in self.witnesses])) > BOX

    def some(self, count: int) -> "Evidence":
        """Every so many-th of the frames."""
        rows = spread(len(self.witnesses), count)
        return replace(self, witnesses=tuple(self.witnesses[r] for r in rows))

    def scores(self, claim: Claim) -> Float[np.ndarray, "witnesses"]:
        """Agreement of each frame in [0, 1]; NaN where the claim has no pose for it."""
        return np.array([self.score(claim, witness) for witness in self.witnesses])

    def score(self, claim: Claim, witness: Witness) -> float:
        """Agreement of one frame."""
        row = claim.row_of(witness.index)
        if row is None:
            return float("nan")
        camera = claim.camera(witness.camera_row, self.size_px)
        alpha = np.float32(1.0) - witness.alpha if claim.inverted else witness.alpha
        drawn = silhouette(self.posed(claim.motion, row), camera)
        return agreement(drawn, touched(alpha, drawn) if claim.alone else alpha)

    def person_of(
        self, claim: Claim, frame: int, alpha: Float32[np.ndarray, "height width"]
    ) -> Float32[np.ndarray, "height width"]:
        """Those parts of a frame's mask, of any size, that the posed body touches.

        Unchanged where the claim has no pose for the frame.
        """
        row = claim.row_of(frame)
        if row is None:
            return alpha
        camera = claim.camera(int(claim.camera_rows()[row]), self.size_px)
        drawn = silhouette(self.posed(claim.motion, row), camera).astype(np.uint8)
        large = cv2.resize(drawn, alpha.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        return touched(alpha, large > 0)

    def areas(self, claim: Claim) -> Float[np.ndarray, "witnesses"]:
        """Area of each mask over that of the posed body; NaN where there is no body."""
        found = []
        for witness in self.witnesses:
            row = claim.row_of(witness.index)
            alpha = np.float32(1.0) - witness.alpha if claim.inverted else witness.alpha
            if row is None:
                found.append(np.nan)
                continue
            camera = claim.camera(witness.camera_row, self.size_px)
            drawn = int(silhouette(self.posed(claim.motion, row), camera).sum())
            found.append(float(alpha.sum()) / drawn if drawn else np.nan)
        return np.array(found)

    def posed(self, motion: Motion, row: int) -> Float32[np.ndarray, "points 3"]:
        """The skin in one of a motion's poses; the last ones are kept, as guesses share them."""
        if (motion, row) not in self._posed:
            if len(self._posed) >= MOST_KEPT:
                self._posed.clear()
            self._posed[motion, row] = self.skin.posed(motion[row])
        return self._posed[motion, row]


def touched(
    alpha: Float32[np.ndarray, "height width"], body: Bool[np.ndarray, "height width"]
) -> Float32[np.ndarray, "height width"]:
    """The connected parts of a mask that a body covers in part; the others become 0.

    Unchanged where the body touches none.
    """
    count, labels = cv2.connectedComponents((alpha > 0.1).astype(np.uint8), connectivity=8)
    covered = np.bincount(labels[body], minlength=count)
    areas = np.bincount(labels.ravel(), minlength=count)
    own = covered > PART * areas
    own[0] = False
    if not own.any():
        return alpha
    return np.where(np.isin(labels, np.flatnonzero(own)), alpha, np.float32(0.0))


def _filled(alpha: Bool[np.ndarray, "height width"]) -> float:
    """Share of its bounding box that a mask covers."""
    rows, columns = np.flatnonzero(alpha.any(axis=1)), np.flatnonzero(alpha.any(axis=0))
    if not len(rows):
        return 0.0
    return float(alpha[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].mean())


def spread(total: int, count: int) -> list[int]:
    """At most `count` numbers below `total`, evenly spread, the ends left out."""
    places = (np.arange(min(count, total)) + 0.5) / min(count, total) * total
    return [int(place) for place in places]


def gather(
    source: Source,
    masks: Masks | None,
    mask_row: Callable[[int], int],
    camera_row: Callable[[int], int],
    skin: SkinPoints,
    *,
    count: int = FRAMES,
    without: frozenset[int] = frozenset(),
) -> Evidence:
    """Reads a few masks; pictures are decoded only where the masks are in them.

    Args:
        source: Says which frames there are.
        masks: The masks; None if the pictures have an alpha channel.
        mask_row: From a frame's number to its mask.
        camera_row: From a frame's number to its camera.
        skin: The person.
        count: How many frames are looked at.
        without: Frames that cannot be used.

    Raises:
        BadInput: If no mask shows anybody.
    """
    start, step = source.selection.start, source.selection.step
    usable = [start + step * n for n in range(source.frame_count or 1)]
    usable = [frame for frame in usable if frame not in without] or usable
    frames = [usable[n] for n in spread(len(usable), count)]
    full = source.size_px
    size_px = _fitted(full, FIRST_LOOK_PX)
    if masks is None:
        found, refused = _from_pictures(source, frames, size_px), []
    else:
        found, refused = _from_masks(masks, frames, mask_row, size_px)
    found = [(index, alpha) for index, alpha in found if (alpha > 0.5).any()]
    if not found:
        raise BadInput(f"None of the masks of {len(frames)} frames of {source.path} shows anybody.")
    heights = [_height(alpha) for _, alpha in found]
    longer = max(size_px) * PERSON_PX / max(float(np.median(heights)), 1.0)
    small = _fitted(full, min(longer, 4.0 * PERSON_PX))
    return Evidence(
        witnesses=tuple(
            Witness(index=index, camera_row=camera_row(index), alpha=_resized(alpha, small))
            for index, alpha in found
        ),
        skin=skin,
        refused=tuple(refused),
    )


def _from_masks(
    masks: Masks, frames: Sequence[int], row: Callable[[int], int], size_px: tuple[int, int]
) -> tuple[list[tuple[int, Float32[np.ndarray, "_ _"]]], list[str]]:
    """Those of the masks that can be used, and why others cannot."""
    found, refused = [], []
    for index in frames:
        try:
            found.append((index, masks.alpha(row(index), size_px)))
        except BadInput as cause:
            refused.append(str(cause))
    return found, refused


def _from_pictures(
    source: Source, frames: Sequence[int], size_px: tuple[int, int]
) -> list[tuple[int, Float32[np.ndarray, "_ _"]]]:
    found, pictures = [], list_images(source.path)  # only pictures have alpha channels
    for index in frames:
        try:
            rgb, alpha = read_image(pictures[index])
            if rgb.shape[1::-1] == source.size_px:
                frame = Frame(index=index, time_s=0.0, rgb=rgb, alpha=alpha)
                found.append((index, own_alpha(frame, size_px)))
        except (BadInput, OSError):  # one of many; that it is damaged is said elsewhere
            continue
    return found


def _fitted(size_px: tuple[int, int], longer: float) -> tuple[int, int]:
    scale = min(1.0, longer / max(size_px))
    return max(8, round(size_px[0] * scale)), max(8, round(size_px[1] * scale))


def _height(alpha: Float32[np.ndarray, "height width"]) -> int:
    rows = np.flatnonzero((alpha > 0.5).any(axis=1))
    return int(rows[-1] - rows[0] + 1)


def _resized(
    alpha: Float32[np.ndarray, "_ _"], size_px: tuple[int, int]
) -> Float32[np.ndarray, "height width"]:
    shrinks = alpha.shape[1] >= size_px[0]
    return np.asarray(
        cv2.resize(alpha, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR),
        dtype=np.float32,
    )
