"""One metric scale for a whole capture, from where the person stands.

A camera-frame point q (metres) is X = R_iᵀ q + s c_i in the world, with s metres per unit of the
solved world: linear in s, so that each cue is a row a s = b of one least-squares problem.

* **ground**: the lowest foot stands on the floor, s h_i = sole - min_j n · (R_iᵀ f_ij), h_i being
  the camera's height above the floor. One value a frame; half of them agree, or it is no cue.
* **in place**: the person stays about where it is: s (c_i - c̄) = -(q_i - q̄), q_i = R_iᵀ p_i.

One scale for all frames: with one a frame the body would jitter in depth.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from preprocess.solve.floor import Floor

SIGMA_GROUND_M, SIGMA_PLACE_M = 0.06, 0.20
"""How far, as a rule, a sole is from the floor by a tracker's depth, and a person from its
place."""
ROUNDS = 5
HUBER = 1.345
MOST_APART = 0.10
"""Beyond this difference of both cues the person walks, and the ground is right."""
MOST_SPREAD = 0.25
"""Of the frames' own scales by ground contact (robust standard deviation)."""
MOST_WANDER_M = 0.35
"""How far the person may be from its place, r.m.s., if only that tells the scale."""
LEAST_FRAMES = 5
SOLE_M = 0.01
"""What is under a foot: nothing, or a shoe of two centimetres or three. Bodies are barefoot."""
LEAST_PATH_M = 0.3
"""Of the camera's path, for the second cue to say anything."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Standing:
    """The person in the cameras' own frames, one row for each frame with a pose and a camera.

    Attributes:
        world_from_camera: Rotations R_iᵀ.
        centers: Cameras in the solved world's unit.
        pelves: Pelvis in the camera, metres.
        soles: Skin of both feet in the camera, metres.
    """

    world_from_camera: Float[np.ndarray, "frames 3 3"]
    centers: Float[np.ndarray, "frames 3"]
    pelves: Float[np.ndarray, "frames 3"]
    soles: Float[np.ndarray, "frames soles 3"]


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Metres per unit of the solved world.

    Attributes:
        metres: The scale.
        cues: Which cues made it: "ground", "in place".
        ground, place: What each would say alone; None where it says nothing.
        spread: Of the frames' own values by ground contact, relative; NaN without ground.
        refused: Why it is not to be believed; None if it is.
    """

    metres: float
    cues: tuple[str, ...]
    ground: float | None
    place: float | None
    spread: float
    refused: str | None = None


def metric_scale(standing: Standing, floor: Floor | None) -> Scale:
    """The scale by all cues that hold.

    Args:
        standing: The person, and the cameras that see it.
        floor: The floor of the solved world; None if it was not seen.
    """
    contact = np.zeros(0)
    heights = np.zeros(0)
    if floor is not None and floor.points and len(standing.centers) >= LEAST_FRAMES:
        heights = floor.heights(standing.centers)
        turned = np.einsum("nab,nkb->nka", standing.world_from_camera, standing.soles)
        contact = SOLE_M - (turned @ floor.normal).min(axis=1)
    ground, spread = _by_ground(heights, contact)
    moves, stays = _in_place(standing)
    place, wander = _by_place(moves, stays)
    if ground is not None and spread <= MOST_SPREAD:
        if place is None or abs(place - ground) > MOST_APART * ground:
            return Scale(metres=ground, cues=("ground",), ground=ground, place=place, spread=spread)
        rows = np.concatenate([heights / SIGMA_GROUND_M, moves / SIGMA_PLACE_M])
        right = np.concatenate([contact / SIGMA_GROUND_M, stays / SIGMA_PLACE_M])
        both = _huber(rows, right, 0.5 * (ground + place))
        return Scale(
            metres=both, cues=("ground", "in place"), ground=ground, place=place, spread=spread
        )
    refused = None
    if place is None or wander > MOST_WANDER_M:
        refused = (
            "nothing tells how large the room is: "
            + ("the floor was not seen" if ground is None else "the feet are never on the floor")
            + ", and the person does not stay in one place. Film so that the floor shows some "
            "texture (a rug, planks), or give cameras with a size of their own (ARKit, Record3D)"
        )
    return Scale(
        metres=place or 1.0, cues=("in place",), ground=ground, place=place, spread=spread,
        refused=refused,
    )  # fmt: skip


def _by_ground(
    heights: Float[np.ndarray, "frames"], contact: Float[np.ndarray, "frames"]
) -> tuple[float | None, float]:
    """The median over frames, and its relative spread."""
    usable = (heights > 0.0) & (contact > 0.0)
    if usable.sum() < LEAST_FRAMES:
        return None, float("nan")
    each = contact[usable] / heights[usable]
    middle = float(np.median(each))
    return middle, 1.4826 * float(np.median(np.abs(each - middle))) / middle


def _in_place(
    standing: Standing,
) -> tuple[Float[np.ndarray, "rows"], Float[np.ndarray, "rows"]]:
    """Rows of the second cue: c_i - c̄ and -(q_i - q̄), flattened."""
    seen = np.einsum("nab,nb->na", standing.world_from_camera, standing.pelves)
    moves = standing.centers - standing.centers.mean(axis=0)
    return moves.ravel(), -(seen - seen.mean(axis=0)).ravel()


def _by_place(
    moves: Float[np.ndarray, "rows"], stays: Float[np.ndarray, "rows"]
) -> tuple[float | None, float]:
    """The scale for which the person moves least, and how far from its place it is (r.m.s.)."""
    square = float((moves**2).sum())
    if len(moves) < 3 * LEAST_FRAMES or square <= 0.0:
        return None, float("inf")
    scale = float((moves * stays).sum()) / square
    if scale <= 0.0 or scale * np.sqrt(3.0 * square / len(moves)) < LEAST_PATH_M:
        return None, float("inf")
    return scale, float(np.sqrt(3.0 * ((moves * scale - stays) ** 2).mean()))


def _huber(
    rows: Float[np.ndarray, "rows"], right: Float[np.ndarray, "rows"], start: float
) -> float:
    """Least squares of rows · s = right, far ones weighing less (Huber 1964)."""
    scale = start
    for _ in range(ROUNDS):
        off = np.abs(rows * scale - right)
        weights = np.minimum(1.0, HUBER / np.maximum(off, 1e-12))
        scale = float((weights * rows * right).sum() / (weights * rows**2).sum())
    return scale
