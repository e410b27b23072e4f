"""SMPL's poses on a body that is not SMPL's: distance and place are solved anew from masks.

Without SMPL's file nobody knows how tall SMPL's betas make the person. In pictures only the ratio
of size and distance shows, so the person is moved instead of scaled: by one distance and one shift
of the pelvis for the whole motion, so that the body covers the masks. Rotations stay.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from capture.errors import BadInput
from capture.source import Source
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.doctor.diagnosis import mean
from preprocess.doctor.evidence import Evidence, Witness, gather
from preprocess.kinematics import rotation_matrices
from preprocess.masks import Masks
from preprocess.observe import check_cameras, check_masks
from preprocess.pose import Motion
from preprocess.silhouette import SkinPoints, agreement, silhouette

FRAMES = 8
STEPS = 110
FIRST_LOG, FIRST_SHIFT_M = 0.08, 0.03
"""First steps of the search: of the distance's logarithm, and of the pelvis's shift."""
BETTER = 0.02
LEAST, GAIN = 0.6, 0.01
"""A refit is taken if body and masks then agree by so much, and by more than before."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Refit:
    """What the search found.

    Attributes:
        motion: Poses for the body that is used.
        before, after: Mean agreement of body and masks, in [0, 1].
        nearer: By what distances from the camera were divided.
        shift_m: How the pelvis was moved, in the root's own axes.
    """

    motion: Motion
    before: float
    after: float
    nearer: float
    shift_m: Float[np.ndarray, "3"]

    @property
    def worth_it(self) -> bool:
        """Whether the poses fit so much better that they are to be taken."""
        return self.after >= LEAST and self.after > self.before + GAIN


def refitted(claim: Claim, evidence: Evidence) -> Refit:
    """Fits SMPL's poses to another body with the masks of a few frames.

    Args:
        claim: Poses of SMPL's family, and cameras.
        evidence: Masks, and the body.
    """
    from scipy.optimize import minimize  # 0.1 s that a capture in order does not need

    shaped, some = evidence.skin.shaped, evidence.some(FRAMES)
    scenes = [scene for witness in some.witnesses if (scene := _scene(claim, some, witness))]

    def agreed(x: Float[np.ndarray, "4"]) -> float:
        return float(np.mean([scene.score(float(np.exp(x[0])), x[1:]) for scene in scenes]))

    found = np.zeros(4)
    if scenes:
        simplex = np.vstack([np.zeros(4), np.diag([FIRST_LOG, *[FIRST_SHIFT_M] * 3])])
        found = minimize(
            lambda x: -agreed(x), found, method="Nelder-Mead",
            options={"maxfev": STEPS, "initial_simplex": simplex},
        ).x  # fmt: skip
    nearer = float(np.exp(found[0]))
    motion = _applied(claim, shaped, nearer, found[1:])
    return Refit(
        motion=motion,
        before=mean(evidence.scores(claim)),
        after=mean(evidence.scores(replace(claim, motion=motion))),
        nearer=nearer,
        shift_m=found[1:],
    )


def refit_to_masks(
    motion: Motion,
    shaped: ShapedBody,
    cameras: CameraTrack,
    source: Source,
    masks: Masks | None,
) -> tuple[ShapedBody, Motion, str]:
    """Body and motion as they fit the masks, if the tracker had another body in mind.

    The body's own mean proportions are tried beside SMPL's; they are taken if they fit better by
    `BETTER`: files say SMPL of poses that were fitted to something else.

    Args:
        motion: In the cameras' world.
        shaped: The body that is used, with SMPL's mean joints (`shaped_for`).
        cameras: Of the frames' size.
        source: The frames; none is decoded.
        masks: The masks; None if the pictures have an alpha channel, and then nothing is done.

    Returns:
        The body, its motion, and what was done, in words.
    """
    if masks is None or shaped.body.family in ("smpl", motion.model):
        return shaped, motion, ""
    claim = Claim.of(motion, cameras, source)
    try:
        rows = check_masks(masks, source), check_cameras(cameras, source)
        evidence = gather(
            source, masks, *rows, SkinPoints.of(shaped), count=FRAMES, without=cameras.missing
        )
    except BadInput:  # parts that do not fit, or nobody in these masks: that is said elsewhere
        return shaped, motion, ""
    refit = refitted(claim, evidence)
    own = shaped.body.with_shape()
    other = refitted(claim, Evidence(witnesses=evidence.witnesses, skin=SkinPoints.of(own)))
    if other.worth_it and other.after > refit.after + BETTER:
        return own, other.motion, f"{_in_words(other)} Its own proportions fit better than SMPL's."
    return shaped, (refit.motion if refit.worth_it else motion), _in_words(refit)


def _in_words(refit: Refit) -> str:
    """What was done, for people."""
    if not refit.worth_it and refit.before >= LEAST:
        return f"Distances fit the masks as they are (agreement {refit.before:.2f})."
    if not refit.worth_it:
        return (
            f"Their distances could not be fitted to the masks ({refit.before:.2f} before, "
            f"{refit.after:.2f} after); they stay as they are."
        )
    return (
        f"Distances were divided by {refit.nearer:.3f} and the pelvis moved by "
        f"{100.0 * float(np.linalg.norm(refit.shift_m)):.1f} cm to fit the masks: agreement "
        f"{refit.before:.2f} before, {refit.after:.2f} after."
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scene:
    """One frame: the posed skin, and what a distance and a shift make of it."""

    points: Float32[np.ndarray, "points 3"]
    pelvis: Float[np.ndarray, "3"]
    root: Float[np.ndarray, "3 3"]
    claim: Claim
    witness: Witness
    size_px: tuple[int, int]

    def score(self, nearer: float, shift: Float[np.ndarray, "3"]) -> float:
        """Agreement after both; a camera in the world's middle sees no difference."""
        camera = self.claim.camera(self.witness.camera_row, self.size_px)
        eye = camera.center_world
        there = eye + (self.pelvis - eye) / nearer + self.root @ shift
        points = self.points + (there - self.pelvis).astype(np.float32)
        return agreement(silhouette(points, camera), self.witness.alpha)


def _scene(claim: Claim, evidence: Evidence, witness: Witness) -> _Scene | None:
    row = claim.row_of(witness.index)
    if row is None:
        return None
    pose = claim.motion[row]
    return _Scene(
        points=evidence.posed(claim.motion, row),
        pelvis=evidence.skin.shaped.joints[0] + pose.root_translation,
        root=rotation_matrices(pose.root_rotation),
        claim=claim,
        witness=witness,
        size_px=evidence.size_px,
    )


def _applied(
    claim: Claim, shaped: ShapedBody, nearer: float, shift: Float[np.ndarray, "3"]
) -> Motion:
    """The whole motion with distances divided, each from its own camera, and the pelvis shifted."""
    eyes = claim.eyes()[claim.camera_rows()]
    pelves = shaped.joints[0] + claim.motion.root_translations
    moved = eyes + (pelves - eyes) / nearer
    moved += rotation_matrices(claim.motion.root_rotations) @ shift
    return replace(claim.motion, root_translations=moved - shaped.joints[0])
