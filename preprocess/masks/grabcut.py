"""Masks without a segmenter: GrabCut, seeded by the posed body and by what it was seen to wear.

GrabCut (Rother et al. 2004) tells person from background by two mixtures of colours and by edges.
Alone it leaks into backgrounds of the person's colours; so the posed body, with the clothes that
earlier frames have shown on it (`Shell`), says where to look: only a narrow band around that shape
is in doubt. If the camera stands still, pixels that were background in earlier frames also say what
lies behind the person (`Behind`). The mask is the mean of cut and shape, weighted by how far they
were found to be off; where they are far apart though the poses are good, the cut has leaked. Last,
where it is known what lies behind, border pixels are split by colours (`unmixed`).
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.camera import Camera
from capture.errors import BadInput
from capture.frame import Frame
from preprocess.body import ShapedBody
from preprocess.masks.behind import Behind
from preprocess.masks.colours import Colours, Sight
from preprocess.masks.hair import HAIR_M, HEAD, knots, near_head
from preprocess.masks.matte import softened
from preprocess.masks.mixture import outside_px, unmixed
from preprocess.masks.outline import away_px
from preprocess.masks.scale import Scale
from preprocess.masks.shell import FOLLOWED, Around, Shell
from preprocess.pose import BodyPose

UNKNOWN_M, KNOWN_M, LEAST_OUTSIDE_M = 0.02, 0.008, 0.012
"""How far inside and outside the shell pixels are in doubt, where nothing is known of it and where
everything is; outside at least the last, or nothing would ever grow."""

TOO_DEEP = 0.1
"""Where more of the cut than this runs along the inner limit of what is in doubt, the pose is off
and the limits must be wider."""
WIDER_M, NARROWER_M, WIDEST_M = 0.012, 0.002, 0.05
OUTSIDE_WIDER = 1.5
"""By how much the limits follow from frame to frame; outside it counts so much more."""

AROUND_M = 0.25
"""How much of the background is looked at."""

MARGIN_M, MARGIN_PX = 0.015, 2.0
"""Background is what is at least so far from the person, by both measures."""

ROUNDS, FEWER_ROUNDS = 2, 1
"""Rounds of GrabCut; the fewer where the shell, and what lies behind it, are known."""

CUT_OFF_M = 0.006
"""How far the cut's border is off, for whatever reason, where it has not leaked."""
SHELL_OFF_M, UNKNOWN_OFF_M = 0.002, 0.012
"""How far the shell is off at the least, and how far as long as nothing is known of it."""

LEAST_AGREEMENT = 0.4
"""Masks that agree less with the shell's shape (intersection over union) are not used."""


class _Shape(NamedTuple):
    """The shell in a picture.

    Attributes:
        fine: Its shape, finer than the picture.
        covered: How much of each pixel it covers.
        away: How far each pixel is outside of it, in pixels; inside negative.
        hair: Which pixels may be hair.
    """

    fine: Float32[np.ndarray, "rows columns"]
    covered: Float32[np.ndarray, "height width"]
    away: Float32[np.ndarray, "height width"]
    hair: Bool[np.ndarray, "height width"]


class _Cut(NamedTuple):
    """What GrabCut says about a picture.

    Attributes:
        person: Who is.
        away: How far each pixel is outside of the person, in pixels; inside negative.
        sure: Where what lies behind decided, 1, else 0.
        doubt_m: How far inside and outside the shell pixels were in doubt.
    """

    person: Bool[np.ndarray, "height width"]
    away: Float32[np.ndarray, "height width"]
    sure: Float32[np.ndarray, "height width"]
    doubt_m: tuple[float, float]


@final
class GrabCut:
    """Masks of one person, frame by frame.

    Attributes:
        name: How the report calls it.
        found: How many masks were made.
        agreement: Their mean intersection over union with the shape of body and clothes that was
            expected; 0 of none.
    """

    name = "GrabCut"

    def __init__(self, shaped: ShapedBody) -> None:
        """Nothing is known about clothes and background yet."""
        self._shell, self._behind = Shell(shaped), Behind()
        self._colours = Colours(len(shaped.vertices))
        self._head = shaped.body.weights.argmax(axis=1) == HEAD
        self._scale = Scale(shaped)
        self._wider_m = 0.0
        self._off_m = 0.012
        self.found, self.agreement = 0, 0.0

    def __call__(
        self, frame: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "height width"]:
        """The mask of a picture; see `Segmenter`.

        Raises:
            BadInput: If the body is not in the picture, or nothing that agrees with it is found.
        """
        scale = self._scale.of(pose, camera)
        size_px = (max(1, round(frame.size_px[0] * scale)), max(1, round(frame.size_px[1] * scale)))
        small, rgb = camera.resized(size_px), frame.rgb
        if size_px != frame.size_px:
            way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
            rgb = cv2.resize(rgb, size_px, interpolation=way)
        around, shape = self._expected(pose, small)
        self._behind.seen_by(small, rgb, shape.away > 2.0 * UNKNOWN_M * around.px_per_m)
        cut = self._cut(rgb, around, shape)
        expected = shape.away < 0.0
        both, either = (cut.person & expected).sum(), (cut.person | expected).sum()
        agreement = float(both / max(either, 1))
        if agreement < LEAST_AGREEMENT:
            raise BadInput(f"the estimated mask agrees by {agreement:.0%} only with the posed body")
        alpha = softened(rgb, cut.person)
        self._learn(rgb, cut, alpha, small, around, shape)
        weight = self._weight_of_shell(cut, shape, around)
        mixed = _mixed(alpha, weight, shape, size_px)
        found = self._unmixed(rgb, mixed, around, small)
        self.found += 1
        self.agreement += (agreement - self.agreement) / self.found
        if size_px == frame.size_px:
            return found
        change = cv2.resize(found - mixed, frame.size_px, interpolation=cv2.INTER_LINEAR)
        return np.clip(_mixed(alpha, weight, shape, frame.size_px) + change, 0.0, 1.0)

    def _unmixed(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        alpha: Float32[np.ndarray, "height width"],
        around: Around,
        camera: Camera,
    ) -> Float32[np.ndarray, "height width"]:
        """The mask with its border where colours put it, if it is known what lies behind."""
        outside = outside_px(alpha)
        behind = self._behind.shown(rgb, outside > MARGIN_PX)
        if behind is None:
            return alpha
        sight = Sight.of(around, camera)
        self._colours.learn(sight, rgb, -outside)
        person = self._colours.along(sight, camera.size_px)
        return unmixed(rgb, alpha, behind, person)

    def _expected(self, pose: BodyPose, camera: Camera) -> tuple[Around, _Shape]:
        around = self._shell.around(pose, camera)
        if around is None:
            raise BadInput("the posed body is not in the picture")
        fine = self._shell.drawn(around, camera)
        covered = cv2.resize(fine, camera.size_px, interpolation=cv2.INTER_AREA)
        hair = near_head(around.skin[self._head], camera, around.px_per_m)
        shape = _Shape(fine=fine, covered=covered, away=away_px(covered > 0.5), hair=hair)
        if (shape.away < 0.0).sum() < 16:
            raise BadInput("the posed body is not in the picture")
        return around, shape

    def _cut(self, rgb: UInt8[np.ndarray, "height width 3"], around: Around, shape: _Shape) -> _Cut:
        """Who is person, among the pixels that the shell leaves in doubt."""
        inwards = around.known * KNOWN_M + (1.0 - around.known) * UNKNOWN_M + self._wider_m
        outwards = max(inwards, LEAST_OUTSIDE_M) + (OUTSIDE_WIDER - 1.0) * self._wider_m
        away = shape.away / around.px_per_m
        near = away < np.where(shape.hair, max(outwards, HAIR_M), outwards)
        doubtful = near & (away > -inwards)
        labels = np.full(away.shape, cv2.GC_BGD, np.uint8)
        labels[doubtful] = np.where(away[doubtful] < 0.0, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
        like, unlike = self._behind.compared(rgb, doubtful)
        labels[like], labels[unlike] = cv2.GC_PR_BGD, cv2.GC_PR_FGD
        labels[away <= -inwards] = cv2.GC_FGD
        settled = self._behind.known and around.known > FOLLOWED
        rounds = FEWER_ROUNDS if settled else ROUNDS
        margin = int(AROUND_M * around.px_per_m) + 1
        rows, columns = np.nonzero(near)
        box = (
            slice(max(0, int(rows.min()) - margin), int(rows.max()) + margin + 1),
            slice(max(0, int(columns.min()) - margin), int(columns.max()) + margin + 1),
        )
        part = np.ascontiguousarray(labels[box])
        models = np.zeros((1, 65)), np.zeros((1, 65))
        if (part & 1).any() and not (part & 1).all():
            cv2.setRNGSeed(0)
            bgr = np.ascontiguousarray(rgb[box][..., ::-1])
            cv2.grabCut(bgr, part, (0, 0, 1, 1), *models, rounds, cv2.GC_INIT_WITH_MASK)
        person = np.zeros(away.shape, dtype=bool)
        person[box] = (part & 1) > 0
        person = (person & ~like) | unlike
        return _Cut(
            person=person,
            away=away_px(person),
            sure=(like | unlike).astype(np.float32),
            doubt_m=(float(inwards), float(outwards)),
        )

    def _learn(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        cut: _Cut,
        alpha: Float32[np.ndarray, "height width"],
        camera: Camera,
        around: Around,
        shape: _Shape,
    ) -> None:
        """How far poses are off, what the person wears, and what lies behind."""
        from_cut, per_m = cut.away, around.px_per_m
        rim = (from_cut > 0.0) & (from_cut < 1.2)
        deep = rim & (shape.away < 1.5 - cut.doubt_m[0] * per_m)
        too_deep = deep.sum() > TOO_DEEP * max(rim.sum(), 1)
        wider = self._wider_m + (WIDER_M if too_deep else -NARROWER_M)
        self._wider_m = float(np.clip(wider, 0.0, WIDEST_M))
        near = (np.abs(from_cut) < 0.8) & (np.abs(shape.away) < (cut.doubt_m[0] + 0.005) * per_m)
        if near.any():
            # the standard deviation of a normal error is 1.25 times its mean
            off = 1.25 * float(np.abs(shape.away[near]).mean()) / per_m
            self._off_m += 0.2 * (off - self._off_m)
        self._shell.vote(around, camera, rgb, alpha, shape.away, cut.doubt_m)
        margin = max(MARGIN_PX, MARGIN_M * per_m)
        self._behind.learn(rgb, (from_cut > margin) & (shape.away > margin))

    def _weight_of_shell(
        self, cut: _Cut, shape: _Shape, around: Around
    ) -> Float32[np.ndarray, "height width"]:
        """The shell's share of the mask: both count with the inverse of their variance.

        Cut and shell are usually `_off_m` apart. What that is more than the cut's own error is the
        pose's, and so the shell's. Where they are farther apart than that, one of them is wrong:
        the cut, as far as the shell is known and the poses are good. Where what lies behind
        decided, and about hair that stands off in one piece, the shell has no say.
        """
        shell = max(self._off_m**2 - CUT_OFF_M**2, SHELL_OFF_M**2)
        shell += (UNKNOWN_OFF_M * (1.0 - around.known)) ** 2
        trusted = around.known * CUT_OFF_M**2 / (CUT_OFF_M**2 + shell)
        apart = (cut.away - shape.away) / np.float32(around.px_per_m)
        leaked = np.maximum(apart**2 - np.float32(self._off_m**2), np.float32(0.0))
        leaked[shape.hair & (apart < 0.0)] = 0.0
        beyond = cut.person & shape.hair & (shape.away > 0.0)
        shell = shell + (knots(beyond, around.px_per_m) * np.float32(HAIR_M)) ** 2
        cut_off = np.float32(CUT_OFF_M**2) + np.float32(trusted) * leaked
        return cut_off / (cut_off + np.float32(shell)) * (np.float32(1.0) - cut.sure)


def _mixed(
    alpha: Float32[np.ndarray, "height width"],
    weight: Float32[np.ndarray, "height width"],
    shape: _Shape,
    size_px: tuple[int, int],
) -> Float32[np.ndarray, "_ _"]:
    """The mean of the cut's alpha and what the shell covers, of so much weight, of a size."""
    covered = shape.covered
    if alpha.shape[::-1] != size_px:
        smaller = alpha.shape[1] > size_px[0]
        way = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
        alpha, weight = (cv2.resize(each, size_px, interpolation=way) for each in (alpha, weight))
        finer = shape.fine.shape[1] >= size_px[0]
        way = cv2.INTER_AREA if finer else cv2.INTER_LINEAR
        covered = cv2.resize(shape.fine, size_px, interpolation=way)
    return weight * covered + (np.float32(1.0) - weight) * alpha
