"""SMPL's poses on a body that is not SMPL's: distance and place are solved anew from masks.

Without SMPL's file nobody knows how tall SMPL's betas make the person. In pictures only the ratio
of size and distance shows, so the person is moved instead of scaled: by one distance and one shift
of the pelvis for the whole motion, so that the body covers the masks. Rotations stay.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from preprocess.body import ShapedBody
from preprocess.doctor.claim import Claim
from preprocess.doctor.diagnosis import mean
from preprocess.doctor.evidence import Evidence, Witness
from preprocess.kinematics import rotation_matrices
from preprocess.pose import Motion
from preprocess.silhouette import agreement, silhouette

FRAMES = 8
STEPS = 110
FIRST_LOG, FIRST_SHIFT_M = 0.08, 0.03
"""First steps of the search: of the distance's logarithm, and of the pelvis's shift."""
SHY = 4.0
"""What a shift costs, in agreement per square metre: seen from one side alone, a body is nearer or
was moved towards the camera, and nothing else tells."""
LEAST, GAIN = 0.6, 0.01
"""A refit is taken if body and masks then agree by so much, and by more than before."""
EDGES = 1.6
"""Without masks edges must be so many times as strong across the body's outline as beside it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Refit:
    """What the search found.

    Attributes:
        motion: Poses for the body that is used.
        before, after: Mean agreement of body and masks, in [0, 1].
        nearer: By what distances from the camera were divided.
        shift_m: How the pelvis was moved, in the root's own axes.
        edges: Where masks were found around the body itself (`preprocess.fit.unmasked`): how many
            times as strong the pictures' edges are across its outline as beside it, before and
            after; None where masks were given.
    """

    motion: Motion
    before: float
    after: float
    nearer: float
    shift_m: Float[np.ndarray, "3"]
    edges: tuple[float, float] | None = None

    @property
    def worth_it(self) -> bool:
        """Whether the poses fit so much better that they are to be taken."""
        return self.believed and self.after > self.before + GAIN

    @property
    def believed(self) -> bool:
        """Whether body and pictures agree, in the end, so much as no chance makes them."""
        if self.edges is not None and self.edges[1] < EDGES:
            return False
        return self.after >= LEAST

    def in_words(self) -> str:
        """What was done, for people."""
        if not self.believed:
            return self._not_found()
        agreed = f"agreement {self.before:.2f} before, {self.after:.2f} after"
        if self.edges is None:
            with_what = "masks"
        else:
            with_what = "pictures, in which masks were estimated around it"
            agreed += (
                f"; edges across its outline are {self.edges[1]:.1f} times as strong as beside "
                f"it, before {self.edges[0]:.1f} times"
            )
        if not self.worth_it:
            return f"Distances fit the {with_what}, as they are ({agreed})."
        return (
            f"Distances were divided by {self.nearer:.3f} and the pelvis moved by "
            f"{100.0 * float(np.linalg.norm(self.shift_m)):.1f} cm to fit the {with_what}: "
            f"{agreed}."
        )

    def _not_found(self) -> str:
        """What is said of a search that found nothing."""
        if self.edges is None:
            return (
                f"Their distances could not be fitted to the masks ({self.before:.2f} before, "
                f"{self.after:.2f} after); they stay as they are."
            )
        return (
            "There are no masks, and where the poses put the body no person was found in the "
            f"pictures (edges across its outline are {self.edges[1]:.1f} times as strong as beside "
            "it, 2 to 5 times is usual); distances stay as they are. Do poses and video belong "
            "together? Give --masks, with which ia-check can tell what is wrong, or your own SMPL "
            "file (--body)."
        )

    def as_json(self) -> dict[str, float | bool]:
        """The same for the report."""
        told: dict[str, float | bool] = {
            "taken": self.worth_it,
            "agreement_before": round(self.before, 4),
            "agreement_after": round(self.after, 4),
            "distances_divided_by": round(self.nearer, 4),
            "pelvis_moved_cm": round(100.0 * float(np.linalg.norm(self.shift_m)), 2),
        }
        if self.edges is not None:
            told |= {
                "edges_before": round(self.edges[0], 2), "edges_after": round(self.edges[1], 2),
            }  # fmt: skip
        return told


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
        scores = [scene.score(float(np.exp(x[0])), x[1:]) for scene in scenes]
        return float(np.mean(scores)) - SHY * float(x[1:] @ x[1:])

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
        there = moved_pelvis(self.pelvis, camera.center_world, self.root, nearer, shift)
        points = self.points + (there - self.pelvis).astype(np.float32)
        return agreement(silhouette(points, camera), self.witness.alpha)


def moved_pelvis(
    pelvis: Float[np.ndarray, "*poses 3"],
    eye: Float[np.ndarray, "*poses 3"],
    root: Float[np.ndarray, "*poses 3 3"],
    nearer: float,
    shift_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "*poses 3"]:
    """Where a pelvis is after a refit: nearer to the camera's eye, then shifted in its own axes."""
    return eye + (pelvis - eye) / nearer + root @ shift_m


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
    roots = rotation_matrices(claim.motion.root_rotations)
    moved = moved_pelvis(pelves, eyes, roots, nearer, shift)
    return replace(claim.motion, root_translations=moved - shaped.joints[0])
