"""Masks without a segmenter: GrabCut, seeded by the posed body, with what was seen behind it.

GrabCut (Rother et al. 2004) tells person from background by two mixtures of colours and by edges.
The posed body says where to look: well inside it is person, well outside background. If the camera
stands still, pixels that were background in earlier frames also say what lies behind the person.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.camera import Camera
from capture.errors import BadInput
from capture.frame import Frame
from preprocess.body import ShapedBody
from preprocess.matte import softened
from preprocess.outline import Outline
from preprocess.pose import BodyPose

WORK_PX = 320
"""Longer side of the pictures in which masks are found."""

SMALL_PX = 200
"""Smaller pictures are enlarged twice: masks then know parts of a pixel."""

SURE = (0.01, 0.045)
UNSURE = (0.02, 0.07)
"""How far inside and outside the body's outline pixels are in doubt, in heights of the person:
where poses are right, and where they are off."""

RIGHT, OFF = 0.03, 0.08
"""Share of the body outside the masks of right poses, and of poses that are off by 2° and 1 cm."""

AROUND = 0.15
"""How much of the background is looked at, in heights of the person."""

ROUNDS = 2

LIKE_BEHIND, UNLIKE_BEHIND = 10.0, 40.0
"""Colours nearer to what was seen behind the person are background, farther ones are person."""

TRUSTED = 2.0
"""How often a pixel must have been background before it says anything."""

REMEMBERED = 20.0
"""Over how many frames the background is averaged; light changes."""

MOVED_PX = 0.5
"""A camera that moved more than this in the picture sees another background."""

LEAST_AGREEMENT = 0.4
"""Masks that agree less with the body's outline (intersection over union) are not used."""


class _Seeds(NamedTuple):
    """What the body says about a picture."""

    body: Bool[np.ndarray, "height width"]
    inside: Bool[np.ndarray, "height width"]
    doubtful: Bool[np.ndarray, "height width"]
    box: tuple[slice, slice]


@final
class GrabCut:
    """Masks of one person, frame by frame.

    Attributes:
        name: How the report calls it.
        found: How many masks were made.
        agreement: Their mean intersection over union with the body's outline; 0 of none.
    """

    name = "GrabCut"

    def __init__(self, shaped: ShapedBody) -> None:
        """Nothing is known about the background yet."""
        self._outline = Outline(shaped)
        self._behind: Float32[np.ndarray, "height width 3"] | None = None
        self._times: Float32[np.ndarray, "height width"] | None = None
        self._camera: Camera | None = None
        self._spilt = RIGHT
        self.found, self.agreement = 0, 0.0

    def __call__(
        self, frame: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "height width"]:
        """The mask of a picture; see `Segmenter`.

        Raises:
            BadInput: If the body is not in the picture, or nothing that agrees with it is found.
        """
        longer = max(frame.size_px)
        scale = min(1.0, WORK_PX / longer) if longer >= SMALL_PX else 2.0
        size_px = (max(1, round(frame.size_px[0] * scale)), max(1, round(frame.size_px[1] * scale)))
        small = camera.resized(size_px)
        rgb = frame.rgb
        if size_px != frame.size_px:
            way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
            rgb = cv2.resize(rgb, size_px, interpolation=way)
        seeds = self._seeds(pose, small)
        self._remember_only_if_still(small)
        person = self._cut(rgb, seeds)
        agreement = float((person & seeds.body).sum() / max((person | seeds.body).sum(), 1))
        if agreement < LEAST_AGREEMENT:
            raise BadInput(f"the estimated mask agrees by {agreement:.0%} only with the posed body")
        self._learn_background(rgb, person | seeds.body)
        spilt = float((seeds.body & ~person).sum() / seeds.body.sum())
        self._spilt += 0.3 * (spilt - self._spilt)
        self.found += 1
        self.agreement += (agreement - self.agreement) / self.found
        alpha = softened(rgb, person)
        if size_px != frame.size_px:
            way = cv2.INTER_LINEAR if scale < 1.0 else cv2.INTER_AREA
            alpha = cv2.resize(alpha, frame.size_px, interpolation=way)
        return alpha

    def _seeds(self, pose: BodyPose, camera: Camera) -> _Seeds:
        body = self._outline.drawn(pose, camera)
        rows, columns = np.nonzero(body)
        if len(rows) < 16:
            raise BadInput("the posed body is not in the picture")
        tall = max(int(rows.max() - rows.min()), int(columns.max() - columns.min()), 8)
        drawn = body.astype(np.uint8)
        doubt = float(np.clip((self._spilt - RIGHT) / (OFF - RIGHT), 0.0, 1.0))
        inwards, outwards = (1.0 - doubt) * np.array(SURE) + doubt * np.array(UNSURE)
        inside = cv2.erode(drawn, _disc(float(inwards * tall))) > 0
        reach = max(2, round(outwards * tall))
        near = cv2.dilate(drawn, _disc(float(reach))) > 0
        margin = reach + max(8, round(AROUND * tall))
        box = (
            slice(max(0, int(rows.min()) - margin), int(rows.max()) + margin + 1),
            slice(max(0, int(columns.min()) - margin), int(columns.max()) + margin + 1),
        )
        return _Seeds(body=body, inside=inside, doubtful=near & ~inside, box=box)

    def _cut(
        self, rgb: UInt8[np.ndarray, "height width 3"], seeds: _Seeds
    ) -> Bool[np.ndarray, "height width"]:
        labels = np.full(seeds.body.shape, cv2.GC_BGD, np.uint8)
        labels[seeds.doubtful] = cv2.GC_PR_BGD
        labels[seeds.doubtful & seeds.body] = cv2.GC_PR_FGD
        like, unlike = self._compared(rgb, seeds.doubtful)
        labels[like], labels[unlike] = cv2.GC_PR_BGD, cv2.GC_PR_FGD
        labels[seeds.inside] = cv2.GC_FGD
        part = np.ascontiguousarray(labels[seeds.box])
        models = np.zeros((1, 65)), np.zeros((1, 65))
        if (part & 1).any() and not (part & 1).all():
            cv2.setRNGSeed(0)
            bgr = np.ascontiguousarray(rgb[seeds.box][..., ::-1])
            cv2.grabCut(bgr, part, (0, 0, 1, 1), *models, ROUNDS, cv2.GC_INIT_WITH_MASK)
        person = np.zeros(seeds.body.shape, dtype=bool)
        person[seeds.box] = (part & 1) > 0
        return (person & ~like) | unlike

    def _compared(
        self, rgb: UInt8[np.ndarray, "height width 3"], doubtful: Bool[np.ndarray, "height width"]
    ) -> tuple[Bool[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
        """Doubtful pixels that look like what was seen there before, and those that do not."""
        if self._behind is None or self._times is None:
            nothing = np.zeros(doubtful.shape, dtype=bool)
            return nothing, nothing
        known = doubtful & (self._times >= TRUSTED)
        off = np.abs(rgb.astype(np.float32) - self._behind).max(axis=-1)
        return known & (off < LIKE_BEHIND), known & (off > UNLIKE_BEHIND)

    def _remember_only_if_still(self, camera: Camera) -> None:
        """Forgets the background if the camera looks elsewhere."""
        before, self._camera = self._camera, camera
        if before is None or self._behind is None:
            return
        width, height = camera.size_px
        corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
        same = before.size_px == camera.size_px
        if same and not np.array_equal(before.camera_from_world, camera.camera_from_world):
            far = camera.center_world + 5.0 * camera.directions(corners)
            same = bool((np.abs(before.project(far) - corners) < MOVED_PX).all())
        if not same:
            self._behind = self._times = None

    def _learn_background(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        person: Bool[np.ndarray, "height width"],
    ) -> None:
        if self._behind is None or self._times is None:
            self._behind = np.zeros(rgb.shape, np.float32)
            self._times = np.zeros(person.shape, np.float32)
        margin = _disc(max(2.0, 0.02 * max(person.shape)))
        free = cv2.dilate(person.astype(np.uint8), margin) == 0
        self._times[free] += 1.0
        share = 1.0 / np.minimum(self._times[free], REMEMBERED)
        self._behind[free] += (rgb[free] - self._behind[free]) * share[:, None]


def _disc(radius: float) -> UInt8[np.ndarray, "side side"]:
    whole = max(1, round(radius))
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * whole + 1, 2 * whole + 1))
    return np.asarray(shape, dtype=np.uint8)
