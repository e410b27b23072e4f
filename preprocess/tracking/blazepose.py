"""BlazePose in use: one person followed through a video, and masks where poses are given.

The detector finds persons in a frame. From then on the square for the next frame comes from the key
points of this one, and the detector is needed only when the person is lost. Where the places of two
persons do not tell them apart, the colors of their clothes do.

Given poses say which person it is, and where to look: all that is far from the posed body is
background. The rest is as for tracked masks (`MaskRefiner`).
"""

from dataclasses import dataclass, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import AlphaMask, Frame, RgbImage
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import NEAR_PLANE_M, SkinPoints
from preprocess.body.parametric_body import ShapedBody
from preprocess.masks.color_models import DarkFilmBrightener
from preprocess.masks.mask_refinement import MaskRefiner
from preprocess.tracking.blazepose_networks import (
    SAME_PERSON_DISTANCE,
    BlazePoseDetector,
    BlazePoseLandmarks,
    FoundLandmarks,
    PersonDetection,
    PersonSquare,
    parts_of_frame,
)
from preprocess.tracking.keypoints import HIPS, MIN_PRESENCE, CroppedMask, PersonKeypoints

QUANTILES = (0.15, 0.5, 0.85)
"""Quantiles of the colors that are compared: stripes differ from one color of the same mean."""
MAX_CLOTHING_M = 0.2
"""Distance from the posed body beyond which all is background, metres: hair, wide clothes and
errors of poses are within."""


class PersonLooks:
    """Remembers the colors of one person's chest and thighs, and how far they vary."""

    def __init__(self) -> None:
        """Knows no person yet."""
        self._colors = np.zeros(2 * len(QUANTILES) * 3)
        self._variation = 0.0
        self._pictures = 0

    @property
    def is_known(self) -> bool:
        """True if there is anything to compare with."""
        return self._pictures > 0

    def distance(self, colors: Float[np.ndarray, "numbers"]) -> float:
        """Mean difference between colors and the person's, in units of CIELAB."""
        return float(np.abs(colors - self._colors).mean())

    def is_like(self, other: "PersonLooks") -> bool:
        """True if another's colors are no farther away than these vary, as those in a mirror."""
        return other.is_known and self.distance(other._colors) < self._variation

    def learn(self, colors: Float[np.ndarray, "numbers"]) -> None:
        """Remember the colors of an image that shows the person."""
        away = self.distance(colors) if self.is_known else 0.0
        self._pictures += 1
        rate = max(0.15, 1 / self._pictures)
        self._colors += rate * (colors - self._colors)
        self._variation += rate * (away - self._variation)


def colors_of(rgb: RgbImage, found: PersonKeypoints) -> Float[np.ndarray, "numbers"]:
    """Quantiles of the colors of a person's chest and thighs in a frame, CIELAB."""
    points = found.image_px
    height, width = rgb.shape[:2]
    colors = []
    for upper, lower in (((11, 12), HIPS), (HIPS, (25, 26))):  # shoulders to hips to knees
        along = np.linspace(0.1, 0.9, 12)[:, None]
        rows = [
            points[a] + along * (points[b] - points[a]) for a, b in zip(upper, lower, strict=True)
        ]
        across = np.linspace(0.2, 0.8, 8)[:, None, None]
        grid = (rows[0] + across * (rows[1] - rows[0])).reshape(-1, 2)
        columns, lines = np.clip(grid.astype(int), 0, (width - 1, height - 1)).T
        lab = cv2.cvtColor(rgb[lines, columns][None].astype(np.float32) / 255, cv2.COLOR_RGB2LAB)
        colors.append(np.quantile(lab[0], QUANTILES, axis=0).ravel())
    return np.concatenate(colors).astype(np.float64)


MAX_STEP = 0.2
"""Farthest that a person moves in one frame, in sides of the square; farther is someone else."""
WATCH_INTERVAL = 5
"""Frames from one look for other persons to the next."""
NEAR = 0.6
"""Distance of another person, in sides of the square, within which the two may be mixed up."""
OVERLAPPING = 0.3
"""Distance within which two persons hide each other."""
REACHING = 1.0
"""Distance of another person within which its limbs may reach into the person's square."""
CROWD_MEMORY = 20
"""Frames for which colors tell persons apart after another one was near."""
SEEN_AGO = WATCH_INTERVAL + 1
"""Frames for which another person who was seen near may still be in the person's mask."""


@dataclass(frozen=True, kw_only=True)
class LastPlace:
    """The person's square when it was seen last, and the number of frames since then."""

    square: PersonSquare
    frames_ago: int = 1

    def strangeness(self, square: PersonSquare) -> float:
        """Improbability that a square shows the same person; above 1 it does not."""
        reach = MAX_STEP + 0.1 * (self.frames_ago - 1)
        step = distance_in_sides(self.square, square)
        growth = abs(np.log(square.side / self.square.side)) / np.log(1.4)
        return max(step / reach, float(growth) * MAX_STEP / reach)


class BlazePoseTracker:
    """Follows one person through the frames of a video."""

    def __init__(self, person: int | None = None) -> None:
        """Loads the networks.

        `person` is counted from left to right from 1, in the first frame with that many persons;
        None follows the largest one.
        """
        if person is not None and person < 1:
            raise InputError(f"--person {person}: persons are counted from 1, the leftmost one.")
        self._brighten, self._detect = DarkFilmBrightener(), BlazePoseDetector()
        self._find_landmarks = BlazePoseLandmarks()
        self._person = person
        self._last: LastPlace | None = None
        self._looks, self._company = PersonLooks(), PersonLooks()
        self._frames_to_watch, self._watched = 0, 0
        self._crowded_frames = 0
        self._has_company = False
        self._beside: FoundLandmarks | None = None
        self._mask_px = 0.0
        self._is_replaced = False  # by another person at the same place

    def __call__(self, rgb: RgbImage) -> PersonKeypoints | None:
        """Find the person in the next frame; None where there is none."""
        rgb = self._brighten(rgb)
        found = self._follow(rgb) or self._find(rgb)
        mask_px = 0.0 if found is None else found.keypoints.mask.person_px()
        # of persons who turn and dance the mask changes by 1.15: another one, or the film is cut
        jumps = self._mask_px and abs(np.log(max(mask_px, 1.0) / self._mask_px)) > np.log(1.2)
        self._mask_px = mask_px
        if found is None or (jumps and self._is_strange(rgb, found)):
            self._look_for_who_hides(rgb)
            return None
        self._is_replaced = False
        if jumps:
            self._frames_to_watch = 0
        self._last = LastPlace(square=found.square)
        self._watch(rgb, found)
        return self._separated(found.keypoints)

    def _separated(self, person: PersonKeypoints) -> PersonKeypoints:
        """The person without the limbs of another one, and whether the two may be mixed up."""
        if self._beside is None:
            return replace(person, crowded=self._crowded_frames > CROWD_MEMORY - SEEN_AGO)
        mask, mixed = separate_mask(person, self._beside.keypoints)
        is_alike = self._looks.is_like(self._company)
        return replace(person, mask=mask, crowded=is_alike or mixed > 0.1)  # an arm is 0.06

    def _follow(self, rgb: RgbImage) -> FoundLandmarks | None:
        """The person, where the last frame's key points say; None if it is not there."""
        if self._last is None or self._last.frames_ago > 1:
            return None
        found = self._accept(rgb, self._find_landmarks(rgb, self._last.square))
        return None if found is None or self._is_a_thing(rgb, found) else found

    def _is_strange(self, rgb: RgbImage, found: FoundLandmarks) -> bool:
        """True if the colors are another one's."""
        distance = self._looks.distance(colors_of(rgb, found.keypoints))
        return self._looks.is_known and distance > 12.0  # in CIELAB, as below

    def _look_for_who_hides(self, rgb: RgbImage) -> None:
        """Look for another person where the person was, who is not there now."""
        last = self._last
        if last is None:
            return
        for detection in self._detect(rgb) if last.frames_ago == 1 else ():
            found = self._find_landmarks(rgb, detection.square)
            is_near = distance_in_sides(last.square, found.square) < NEAR
            if (
                found.keypoints.presence >= MIN_PRESENCE
                and is_near
                and self._is_strange(rgb, found)
            ):
                self._company.learn(colors_of(rgb, found.keypoints))
                self._crowded_frames, self._is_replaced = CROWD_MEMORY, not self._has_company
        if last.frames_ago > CROWD_MEMORY and self._is_replaced:  # the film was cut
            self._crowded_frames, self._has_company, self._is_replaced = 0, False, False
        self._last = replace(last, frames_ago=last.frames_ago + 1)

    def _is_a_thing(self, rgb: RgbImage, found: FoundLandmarks) -> bool:
        """True if the colors are strange, and the detector finds no person there."""
        return self._is_strange(rgb, found) and not any(
            distance_in_sides(found.square, each.square) < NEAR for each in self._detect(rgb)
        )

    def _accept(self, rgb: RgbImage, found: FoundLandmarks) -> FoundLandmarks | None:
        """The landmarks, if they are of a person, and of the same one as before."""
        if found.keypoints.presence < MIN_PRESENCE:
            return None
        if self._last is None:
            return found
        if self._last.strangeness(found.square) > 1:
            return None
        # Clothes change their looks with light, so they decide only where places do not.
        if self._crowded_frames > 0 or (self._has_company and self._last.frames_ago > 1):
            return found if self._looks_right(colors_of(rgb, found.keypoints)) else None
        return found

    def _find(self, rgb: RgbImage) -> FoundLandmarks | None:
        """The person, found by the detector; None if it is nowhere."""
        for detection in self._candidates(rgb):
            # The detector's square is rough; the key points found in it give a better one.
            rough = self._find_landmarks(rgb, detection.square)
            if rough.keypoints.presence < MIN_PRESENCE:
                continue
            found = self._accept(rgb, self._find_landmarks(rgb, rough.square))
            if found is not None:
                return found
        return None

    def _candidates(self, rgb: RgbImage) -> list[PersonDetection]:
        """Detections that may be the person, the most likely one first."""
        last = self._last
        if last is None:
            return self._choose(rgb)
        around = replace(last.square, side=1.5 * last.square.side, angle=0.0)
        for area in (None, around):
            detections = self._detect(rgb, area)
            likely = [each for each in detections if last.strangeness(each.square) <= 1]
            self._has_company |= len(likely) < len(detections)
            if likely:
                return sorted(likely, key=lambda each: last.strangeness(each.square))
        return []

    def _choose(self, rgb: RgbImage) -> list[PersonDetection]:
        """The person to follow, of those in the first frame; none if it is not there yet."""
        if self._person is None:
            return sorted(self._detect.find_all(rgb), key=lambda each: -each.square.side)
        persons = find_persons(rgb, self._detect, self._find_landmarks)
        from_left = sorted(persons, key=lambda each: each.square.x)
        return from_left[self._person - 1 : self._person]

    def _watch(self, rgb: RgbImage, found: FoundLandmarks) -> None:
        """Look for other persons every few frames; while there are none, learn this one's looks."""
        self._crowded_frames = max(0, self._crowded_frames - 1)
        if self._beside is not None:  # it is where it was in the last frame
            self._see_beside(found.square, self._find_landmarks(rgb, self._beside.square))
        self._frames_to_watch -= 1
        if self._frames_to_watch > 0:
            return
        self._frames_to_watch = WATCH_INTERVAL
        nearest = 1.0
        for other in self._detect_some(rgb):
            apart = distance_in_sides(found.square, other.square)
            if apart > SAME_PERSON_DISTANCE and self._is_another(rgb, found.square, other.square):
                self._has_company = True
                nearest = min(nearest, apart)
        if nearest < NEAR:
            self._crowded_frames = CROWD_MEMORY
        is_clear = nearest > OVERLAPPING and self._crowded_frames in (0, CROWD_MEMORY)
        if is_clear or not self._looks.is_known:
            self._looks.learn(colors_of(rgb, found.keypoints))

    def _detect_some(self, rgb: RgbImage) -> list[PersonDetection]:
        """The persons of all parts of the first frame, later of one part after the other."""
        if not self._looks.is_known:
            return self._detect.find_all(rgb, in_parts=True)
        areas = (None, *parts_of_frame(rgb))
        self._watched += 1
        return self._detect(rgb, areas[self._watched % len(areas)])

    def _see_beside(self, person: PersonSquare, other: FoundLandmarks) -> None:
        """Remember the other one, unless it is the person itself or far away."""
        apart = distance_in_sides(person, other.square)
        is_beside = other.keypoints.presence >= MIN_PRESENCE and OVERLAPPING < apart < REACHING
        self._beside = other if is_beside else None
        if is_beside and apart < NEAR:
            self._crowded_frames = CROWD_MEMORY

    def _is_another(self, rgb: RgbImage, person: PersonSquare, other: PersonSquare) -> bool:
        """Check whether a detection is another person; remember the looks of one who is near.

        The detector's squares around small persons lie beside them, and it takes a sleeve near the
        camera for a person; key points do neither.
        """
        apart = distance_in_sides(person, other)
        if apart >= REACHING:
            return True
        found = self._find_landmarks(rgb, other)
        if (
            found.keypoints.presence < MIN_PRESENCE
            or distance_in_sides(person, found.square) <= OVERLAPPING
        ):
            return False
        if self._beside is None or apart < distance_in_sides(person, self._beside.square):
            self._see_beside(person, found)
        if apart < NEAR:
            self._company.learn(colors_of(rgb, found.keypoints))
        return True

    def _looks_right(self, colors: Float[np.ndarray, "numbers"]) -> bool:
        """True if colors are rather the person's than those of another one."""
        distance = self._looks.distance(colors)
        if self._company.is_known:
            return distance < self._company.distance(colors)
        return distance < 8.0


def find_persons(
    rgb: RgbImage, detect: BlazePoseDetector, find_landmarks: BlazePoseLandmarks
) -> list[PersonDetection]:
    """All persons in a frame, each once, in the squares that their key points give."""
    persons: list[PersonDetection] = []
    for each in detect.find_all(rgb, in_parts=True):
        found = find_landmarks(rgb, each.square)
        if found.keypoints.presence >= MIN_PRESENCE and not any(
            distance_in_sides(other.square, found.square) < OVERLAPPING for other in persons
        ):
            persons.append(replace(each, square=found.square))
    return persons


def distance_in_sides(a: PersonSquare, b: PersonSquare) -> float:
    """Distance of the middles of two squares, in sides of the first."""
    return float(np.hypot(a.x - b.x, a.y - b.y) / a.side)


@final
class PosedPersonFinder:
    """Finds key points and the coarse mask of a person where a pose puts the body."""

    def __init__(self, shaped: ShapedBody) -> None:
        """Loads the network."""
        self._shaped, self._skin = shaped, SkinPoints.of(shaped)
        self._brighten, self._find_landmarks = DarkFilmBrightener(), BlazePoseLandmarks()

    def __call__(
        self, rgb: RgbImage, pose: BodyPose, camera: Camera
    ) -> tuple[PersonKeypoints, float]:
        """Look at the square around the posed body; the mask holds nothing far from it.

        Returns the person, and the IoU of its mask with the body; an InputError outside the image.
        """
        points = self._skin.posed(pose).astype(np.float64)
        depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        pixels = camera.project(points) if depth.min() > NEAR_PLANE_M else np.full((1, 2), -1.0)
        if not ((pixels >= 0.0) & (pixels < camera.size_px)).all(axis=1).any():
            raise InputError("the posed body is not in the image")
        joints = camera.project(self._shaped.with_pose(pose).joints())
        square = _square_around(pixels, joints)
        px_per_m = max(camera.focal_px) / float(np.median(depth))
        person = self._find_landmarks(self._brighten(rgb), square).keypoints
        mask, agreement = _limit_to_body(person.mask, pixels, px_per_m)
        return replace(person, mask=mask), agreement


@final
class BlazePoseSegmenter:
    """Segments one person, frame by frame.

    `agreement` is the mean IoU of the `mask_count` masks made with the posed body; 0 of none.
    """

    name = "BlazePose"

    def __init__(self, shaped: ShapedBody) -> None:
        """Loads the network."""
        self._find = PosedPersonFinder(shaped)
        self._refine: MaskRefiner | None = None
        self.mask_count, self.agreement = 0, 0.0

    def __call__(self, frame: Frame, pose: BodyPose, camera: Camera) -> AlphaMask:
        """Estimate the mask of a frame; an InputError where it disagrees with the body."""
        person, agreement = self._find(frame.rgb, pose, camera)
        if agreement < 0.4:
            raise InputError(
                f"the estimated mask agrees by {agreement:.0%} only with the posed body"
            )
        self.mask_count += 1
        self.agreement += (agreement - self.agreement) / self.mask_count
        self._refine = self._refine or MaskRefiner(frame.size_px)
        return self._refine(frame.rgb, person.mask)


def _square_around(
    pixels: Float[np.ndarray, "points 2"], joints: Float[np.ndarray, "24 2"]
) -> PersonSquare:
    """The square in which BlazePose expects a posed body, by its skin and joints in the frame."""
    hips = joints[[1, 2]].mean(axis=0)
    up = joints[12] - hips  # the neck
    radius = np.linalg.norm(pixels - hips, axis=1).max()
    return PersonSquare.around(hips, hips + radius * up / max(float(np.linalg.norm(up)), 1e-6))


def _limit_to_body(
    mask: CroppedMask, pixels: Float[np.ndarray, "points 2"], px_per_m: float
) -> tuple[CroppedMask, float]:
    """Clear a mask far from the skin's pixels; also its IoU with the posed body."""
    turn, offset = mask.image_from_crop[:, :2], mask.image_from_crop[:, 2]
    at = ((pixels - offset) @ np.linalg.inv(turn).T).astype(int)
    height, width = mask.values.shape
    column, row = at[((at >= 0) & (at < (width, height))).all(axis=1)].T
    free = np.ones(mask.values.shape, np.uint8)
    free[row, column] = 0
    away = cv2.distanceTransform(free, cv2.DIST_L2, 3)
    reach = MAX_CLOTHING_M * px_per_m / float(np.hypot(*turn[:, 0]))
    values = np.where(away < reach, mask.values, 0).astype(np.uint8)
    person, body = values > 127, away < 2.0
    iou = float((person & body).sum() / max(int((person | body).sum()), 1))
    return CroppedMask(values=values, image_from_crop=mask.image_from_crop), iou


TRUNK = (11, 12, 24, 23)
"""Key points around the trunk: shoulders and hips."""
LIMBS = (
    (11, 13), (13, 15), (15, 19), (12, 14), (14, 16), (16, 20), (7, 8), (0, 11), (0, 12),
    (23, 25), (25, 27), (27, 31), (27, 29), (24, 26), (26, 28), (28, 32), (28, 30),
)  # fmt: skip
"""Pairs of key points: arms with hands, head, and legs with feet."""


def separate_mask(person: PersonKeypoints, other: PersonKeypoints) -> tuple[CroppedMask, float]:
    """Remove from a person's mask what another one's limbs reach into it.

    Pixels that are nearer to the other's limbs go, unless they are within 5 cm of the person's: a
    hand may lie before the other's chest. Returns the mask, and the share of its area that is
    nearer to the other, in [0, 1].
    """
    mask = person.mask
    # a limb that is hardly seen may be a guess that lies across the person
    own, others = (
        _distance_to_limbs(mask, each.image_px, each.visibility >= least)
        for each, least in ((person, 0.0), (other, 0.5))
    )
    middles = person.image_px[list(TRUNK)].reshape(2, 2, 2).mean(axis=1)
    px_per_pixel = float(np.hypot(*mask.image_from_crop[:, 0]))
    # a tenth of the trunk, 5 cm: skin and clothes
    radius = 0.1 * float(np.hypot(*(middles[1] - middles[0]))) / px_per_pixel
    is_others, is_person = own > others, mask.values > 127
    kept = np.where(is_others & (own > radius), 0, mask.values).astype(np.uint8)
    share = float((is_others & is_person).sum() / max(1, is_person.sum()))
    return CroppedMask(values=kept, image_from_crop=mask.image_from_crop), share


def _distance_to_limbs(
    mask: CroppedMask, image_px: Float[np.ndarray, "33 2"], drawn: Bool[np.ndarray, "33"]
) -> Float[np.ndarray, "rows columns"]:
    """Distance of a mask's pixels to a person's trunk and limbs, in pixels of the mask."""
    crop_from_image = np.linalg.inv(np.vstack([mask.image_from_crop, [0.0, 0.0, 1.0]]))
    points = image_px @ crop_from_image[:2, :2].T + crop_from_image[:2, 2]
    points = np.clip(points, -4096, 4096).astype(np.int32)
    free = np.full(mask.values.shape, 255, np.uint8)
    if drawn[list(TRUNK)].all():
        cv2.fillConvexPoly(free, cv2.convexHull(points[list(TRUNK)]), (0,))
    for start, end in LIMBS:
        if drawn[start] and drawn[end]:
            cv2.line(free, points[start].tolist(), points[end].tolist(), (0,))
    if free.all():
        return np.full(free.shape, np.inf, np.float32)
    return cv2.distanceTransform(free, cv2.DIST_L2, 5)
