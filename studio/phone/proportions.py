"""Proportions of a person that betas do not describe: lengths, girths and sizes of body parts."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from preprocess.body.kinematics import PARENTS

THIGHS_AND_SHINS, FEET = (1, 2, 4, 5), (7, 8, 10, 11)
COLLARS, ARMS, HANDS = (13, 14), (16, 17, 18, 19), (20, 21, 22, 23)
TRUNK, NECK, HEAD = (0, 3, 6, 9), 12, 15
CHILD_ALONG = {1: 4, 2: 5, 4: 7, 5: 8, 13: 16, 14: 17, 16: 18, 17: 19, 18: 20, 19: 21}
"""The joint towards which a limb is stretched."""


@dataclass(frozen=True, kw_only=True)
class BodyProportions:
    """Sizes of body parts as factors of the body model's.

    Attributes:
        height: Of everything.
        legs, arms: Lengths.
        trunk: Length from the pelvis to the neck.
        shoulders: Width.
        girth: Of the trunk, across its length.
        leg_girth, arm_girth: Across their lengths.
        head, hands, feet: Sizes.
        looseness: Of the garments: how far they stand off the body.
    """

    height: float = 1.0
    legs: float = 1.0
    arms: float = 1.0
    trunk: float = 1.0
    shoulders: float = 1.0
    girth: float = 1.0
    leg_girth: float = 1.0
    arm_girth: float = 1.0
    head: float = 1.0
    hands: float = 1.0
    feet: float = 1.0
    looseness: float = 1.0

    def stretches(self, joints: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "24 3 3"]:
        """How the part that hangs from each joint is stretched, in the rest pose's axes."""
        stretch = np.stack([np.eye(3)] * 24)
        for joint in TRUNK:
            stretch[joint] = np.diag([self.girth, self.trunk, self.girth])
        for group, along, across in (
            (THIGHS_AND_SHINS, self.legs, self.leg_girth),
            (COLLARS, self.shoulders, 1.0),
            (ARMS, self.arms, self.arm_girth),
        ):
            for joint in group:
                bone = joints[CHILD_ALONG[joint]] - joints[joint]
                bone = bone / np.linalg.norm(bone)
                stretch[joint] = across * np.eye(3) + (along - across) * np.outer(bone, bone)
        stretch[NECK] *= 0.5 * (1.0 + self.head)
        stretch[HEAD] *= self.head
        stretch[list(HANDS)] *= self.hands
        stretch[list(FEET)] *= self.feet
        return self.height * stretch

    def move_joints(self, joints: Float[np.ndarray, "24 3"]) -> Float[np.ndarray, "24 3"]:
        """Rest joints of the person, metres; the pelvis stays."""
        stretch, moved = self.stretches(joints), joints.copy()
        for joint, parent in enumerate(PARENTS):
            if parent >= 0:
                moved[joint] = moved[parent] + stretch[parent] @ (joints[joint] - joints[parent])
        return moved

    def move_vertices(
        self,
        vertices: Float[np.ndarray, "vertices 3"],
        weights: Float[np.ndarray, "vertices 24"],
        joints: Float[np.ndarray, "24 3"],
    ) -> Float[np.ndarray, "vertices 3"]:
        """Rest vertices of the person, metres: each blends the stretches of its joints.

        Args:
            vertices: Of the body or of what it wears, at rest.
            weights: Their skinning weights.
            joints: Rest joints of the body before it is stretched.
        """
        stretch, moved = self.stretches(joints), self.move_joints(joints)
        shift = moved - np.einsum("jab,jb->ja", stretch, joints)
        blended = np.einsum("vj,jab->vab", weights, stretch)
        return np.einsum("vab,vb->va", blended, vertices) + weights @ shift


SUBJECT_PROPORTIONS = {
    1: BodyProportions(
        height=1.04, legs=1.04, arms=1.03, trunk=0.97, shoulders=1.10, girth=1.02,
        leg_girth=0.98, arm_girth=0.98, head=0.93, hands=1.02, feet=1.04, looseness=0.5,
    ),
    2: BodyProportions(
        height=0.93, legs=0.96, arms=0.95, trunk=1.03, shoulders=0.95, girth=1.02,
        leg_girth=1.02, arm_girth=1.03, head=1.08, hands=0.95, feet=0.95, looseness=0.4,
    ),
    3: BodyProportions(
        height=1.01, legs=1.03, arms=1.04, trunk=0.96, shoulders=1.05, girth=0.97,
        leg_girth=0.95, arm_girth=0.94, head=0.98, hands=1.04, feet=1.02, looseness=0.5,
    ),
}  # fmt: skip
"""What each subject's body is like, filmed by a phone."""
