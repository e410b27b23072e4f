"""Clothes and bodies of the three subjects.

All places are on the *template* (the mean body in T-pose, metres), so every person wears the same
cut; `x` is the body's left, `y` up, `z` out of the chest. Where each garment ends is decided per
subsample, from the place on the body at rest. Proportions are what betas do not describe: lengths,
girths and sizes of body parts.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from avatar.kernels.kernel_compiler import compile_kernel
from preprocess.body.kinematics import PARENTS

SKIN, SHIRT, TROUSERS, SHOE, HAIR, EYE = 0, 1, 2, 3, 4, 5

# The tailor's measures: what each entry of a `cut` array says.
SLEEVE, HEM, CUFF, NECK_DEPTH, NAPE, EARS_COVERED, FRINGE = 0, 1, 2, 3, 4, 5, 6

BELT_Y = -0.15
"""Trousers end here; the shirt hangs over it."""
Measures = Float32[np.ndarray, "cuts"]
"""The tailor's measures, in the order of `SLEEVE` and the others."""
Palette = Float32[np.ndarray, "colors 3"]
"""An outfit's colors, sRGB in [0, 1]."""
Vertices = Float[np.ndarray, "vertices 3"]
PerVertex = Float[np.ndarray, "vertices"]


@compile_kernel(nogil=True, forceinline=True)
def smoothstep(value: float, low: float, high: float) -> float:
    """0 below `low`, 1 above `high`, smooth between."""
    share = min(max((value - low) / (high - low), 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@compile_kernel(nogil=True, forceinline=True)
def neckline(x: float, z: float, measures: Measures) -> float:
    """Height of the collar's edge: a scoop, deeper in front, that ends on the shoulders."""
    front = smoothstep(z, 0.01, 0.09)
    side = abs(x + 0.002)
    return (
        0.350
        - measures[NECK_DEPTH] * front
        + 14.0 * max(side - 0.06, 0.0) ** 2
        + max(side - 0.1, 0.0)
    )


@compile_kernel(nogil=True, forceinline=True)
def height_above_hairline(x: float, y: float, z: float, measures: Measures) -> float:
    """Height of a place of the head above the hairline, metres (negative: bare)."""
    side = abs(x + 0.002)
    edge = measures[NAPE] + (0.478 - measures[NAPE]) * smoothstep(z, 0.02, 0.075)
    edge += 0.035 * smoothstep(z, 0.088, 0.104)
    edge += (measures[FRINGE] - 0.513) * smoothstep(z, 0.104, 0.142)
    height = y - edge + 0.002 * np.sin(side * 420.0 + y * 130.0)
    if measures[EARS_COVERED] < 0.5 and side > 0.06:
        ear = np.hypot((z - 0.066) / 0.026, (y - 0.478) / 0.034)
        height = min(height, 0.03 * (ear - 1.0))
    return height


@compile_kernel(nogil=True)
def is_visible(material: int, x: float, y: float, z: float, measures: Measures) -> bool:
    """Tell whether a place of a garment is there, or a place of the skin is bare."""
    side = abs(x)
    if material == SHIRT:
        hem = measures[HEM] + 0.006 * np.sin(x * 31.0 + z * 17.0)
        return side < measures[SLEEVE] and y > hem and y < neckline(x, z, measures)
    if material == TROUSERS:
        return y < BELT_Y and y > measures[CUFF]
    if material == HAIR:
        return height_above_hairline(x, y, z, measures) > 0.0
    if material == SKIN:
        under_shirt = side < measures[SLEEVE] - 0.03 and y > measures[HEM] + 0.03
        under_shirt = under_shirt and y < neckline(x, z, measures) - 0.02
        under_trousers = y < BELT_Y - 0.02 and y > measures[CUFF] + 0.02
        return not (under_shirt or under_trousers or y < -1.165)
    return True


@dataclass(frozen=True, eq=False, kw_only=True)
class Outfit:
    """One subject's looks; lengths in metres on the template.

    Attributes:
        sleeve: Distance of the sleeve's end from the middle of the body.
        hem, cuff: Heights of the shirt's hem and of the trousers' end.
        neck_depth: Drop of the collar in front.
        nape, fringe: Heights of the hairline at the back and above the face.
        ears_covered: Whether hair falls over the ears.
        bun: Whether the hair is tied up in a knot.
        checked: A checked shirt; else a striped one.
        palette: sRGB colors in [0, 1], in the order of `procedural_albedo.TONE` and the others.
        looseness: Factor of the distance between the body and shirt or trousers.
    """

    betas: tuple[float, ...]
    sleeve: float
    hem: float
    cuff: float
    neck_depth: float
    nape: float
    fringe: float
    ears_covered: bool
    bun: bool
    checked: bool
    palette: tuple[tuple[float, float, float], ...]
    looseness: float = 1.0

    @property
    def measures(self) -> Measures:
        """Measures in the order of `SLEEVE` and the others."""
        ears = float(self.ears_covered)
        measures = (self.sleeve, self.hem, self.cuff, self.neck_depth, self.nape, ears, self.fringe)
        return np.array(measures, dtype=np.float32)

    def shirt_thickness(self, place: Vertices) -> PerVertex:
        """Distance of the shirt from the body: small at the shoulders, 3-4 cm at hem and sleeve."""
        x, y, z = place.T
        side = np.abs(x)
        torso = 0.010 + 0.024 * _smoothstep_array(-y, -0.22, 0.20)
        sleeve = 0.009 + 0.020 * _smoothstep_array(side, 0.18, self.sleeve)
        on_sleeve = _smoothstep_array(side, 0.15, 0.22) * _smoothstep_array(y, 0.06, 0.12)
        folds = 0.0055 * np.sin(np.arctan2(z - 0.03, x) * 7.0 + 3.0 * np.sin(y * 9.0))
        folds = folds * _smoothstep_array(-y, -0.12, 0.25) * (1.0 - on_sleeve)
        creases = 0.003 * np.sin(side * 110.0 + 9.0 * z) * on_sleeve
        thickness = (1.0 - on_sleeve) * torso + on_sleeve * sleeve + folds + creases
        return self.looseness * thickness

    def trouser_thickness(self, place: Vertices) -> PerVertex:
        """Distance of the trousers from the body: 7 mm at the hip, 2 cm at the cuff."""
        x, y, z = place.T
        down = _smoothstep_array(-y, -BELT_Y, 1.1)
        knee = np.exp(-(((y + 0.70) / 0.10) ** 2)) + np.exp(-(((y + 1.08) / 0.07) ** 2))
        creases = 0.0035 * np.sin(y * 95.0 + 14.0 * np.abs(x) + 20.0 * z) * knee
        return self.looseness * (0.007 + 0.014 * down + creases)

    def hair_thickness(self, place: Vertices) -> PerVertex:
        """Thickness of the hair: fullest on the crown, thin at the nape."""
        _, y, z = place.T
        crown = _smoothstep_array(y, 0.45, 0.60)
        tuft = 0.010 * _smoothstep_array(z, 0.05, 0.14) * _smoothstep_array(y, 0.55, 0.60)
        full = 0.006 + (0.008 if self.bun else 0.014) * crown
        return full + (0.0 if self.bun else tuft)


def _smoothstep_array(value: PerVertex, low: float, high: float) -> PerVertex:
    share = np.clip((value - low) / (high - low), 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def _srgb_palette(*codes: str) -> tuple[tuple[float, float, float], ...]:
    return tuple(
        (int(c[0:2], 16) / 255, int(c[2:4], 16) / 255, int(c[4:6], 16) / 255) for c in codes
    )


OUTFITS = {
    1: Outfit(
        betas=(0.15, -0.4, 0.5, 0.3),
        sleeve=0.375,
        hem=-0.290,
        cuff=-1.150,
        neck_depth=0.055,
        nape=0.415,
        fringe=0.574,
        ears_covered=False,
        bun=False,
        checked=False,
        palette=_srgb_palette(
            *("e0ac8b", "b4605a", "4a2d1c", "4f7f86"),  # skin, lips, hair, iris
            *("f2ead8", "2f6f7e", "e2a23b"),  # shirt, its stripes, its trim
            *("35466e", "465a86", "c98a45"),  # trousers, their stripes, their thread
            *("efece4", "c8553d"),  # shoes, soles
        ),
    ),
    2: Outfit(
        betas=(-0.35, 0.6, -0.6, -0.4),
        sleeve=0.330,
        hem=-0.270,
        cuff=-1.125,
        neck_depth=0.085,
        nape=0.425,
        fringe=0.582,
        ears_covered=False,
        bun=True,
        checked=True,
        palette=_srgb_palette(
            *("8d5a3c", "7a3b36", "1d1512", "3a2416"),
            *("e46f51", "f3c9a0", "5b2a4d"),
            *("5f6b45", "717f54", "d9cf9a"),
            *("3b3f4a", "f0ede6"),
        ),
    ),
    3: Outfit(
        betas=(-0.1, 0.3, 0.2, -0.3),
        sleeve=0.420,
        hem=-0.330,
        cuff=-1.140,
        neck_depth=0.050,
        nape=0.385,
        fringe=0.566,
        ears_covered=True,
        bun=False,
        checked=True,
        palette=_srgb_palette(
            *("c98d68", "a5524c", "7a5230", "55703f"),
            *("7d8ea3", "dfe3e6", "a33b3b"),
            *("4a4440", "5b534d", "8f8677"),
            *("8c6f55", "e3ddd0"),
        ),
    ),
}


THIGHS_AND_SHINS, FEET = (1, 2, 4, 5), (7, 8, 10, 11)
COLLARS, ARMS, HANDS = (13, 14), (16, 17, 18, 19), (20, 21, 22, 23)
TRUNK, NECK, HEAD = (0, 3, 6, 9), 12, 15
CHILD_ALONG = {1: 4, 2: 5, 4: 7, 5: 8, 13: 16, 14: 17, 16: 18, 17: 19, 18: 20, 19: 21}
"""The joint towards which a limb is stretched."""


@dataclass(frozen=True, kw_only=True)
class BodyProportions:
    """Sizes of body parts as factors of the body model's.

    Attributes:
        height: Factor of everything.
        legs, arms: Lengths.
        trunk: Length from the pelvis to the neck.
        shoulders: Width.
        girth: Girth of the trunk, across its length.
        leg_girth, arm_girth: Across their lengths.
        looseness: Factor of the distance between garments and body.
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
        """Stretch of the part that hangs from each joint, in the rest pose's axes."""
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
        vertices: Vertices,
        weights: Float[np.ndarray, "vertices 24"],
        joints: Float[np.ndarray, "24 3"],
    ) -> Vertices:
        """Move rest vertices of the body or its clothes: each blends the stretches of its joints.

        `joints` are the body's before it is stretched, metres.
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
"""Body proportions of each subject, filmed by a phone."""
