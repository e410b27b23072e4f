"""How far clothes and hair stand off the body, learnt frame by frame from where masks end.

The shell is a thickness for each vertex of the skin. Where a vertex is on the body's rim, seen from
the camera, the mask along its normal tells how far out the person reaches there. These votes are
kept in layers at rest, so that what one picture leaves in doubt, others settle: backgrounds change
behind a person who turns or a camera that walks, clothes do not.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.sparse import coo_matrix, csr_matrix, diags, identity

from capture.camera import Camera
from preprocess.body import ShapedBody
from preprocess.masks.outline import NEAR_M, Outline
from preprocess.pose import BodyPose

LAYERS_M = np.arange(-0.015, 0.0901, 0.0075)
"""Heights over the skin at which votes are kept."""

GUESS_M = 0.01
"""How thick clothes are, as long as nobody has voted."""
GUESS_WIDTH_M = 0.015
GUESS_VOTES, LIMB_VOTES, LIMB_SHARE = 1.0, 0.5, 0.02
"""A limb's mean thickness is worth so many votes of a vertex; a vote of a vertex is worth so much
of one of its limb, where the guess has one."""

KNOWN_VOTES = 4.0
"""A vertex with so many votes is known."""

TANGENT = 0.15
"""Vertices whose normal is so nearly across the ray are on the rim (the cosine)."""

CLEAR = 25.0
"""Colours on both sides of the mask's border less far apart than this vote less."""
AT_LIMIT_M, AT_LIMIT_VOTE = 0.006, 0.1
"""A border so near to the limit of what was in doubt was not found but cut off; its vote is so much
worth."""

FEET = 7, 8, 10, 11
SOLES_SHARE = 0.35
"""A vertex is as thick as half of its votes say. Soles are dark in their own shadow, and cuts more
often miss them than add to them; so at the ankles' and feet's joints fewer are enough, where a
vertex is known."""

FOLLOWED = 0.4
"""From so much of the rim known, the thickness makes up for how far the drawn outline stands beyond
the vertices. Before, the shell stays too large rather: what is too much GrabCut takes away, but it
does not look for what is not in doubt."""
BEYOND_M, BEYOND_PX = 0.01, 1.5
"""A vertex farther than this from the drawn outline is not on it."""

FINE = 3
"""The shell is drawn so many times finer than the picture in which masks are found."""
EDGE_PX = 0.25
"""So much too large are shapes that are filled with all pixels that they touch."""


class Around(NamedTuple):
    """The shell around a posed body, as a camera sees it.

    Attributes:
        skin, normals: Of each vertex, in the world.
        thickness: Of each vertex, metres.
        rim: The vertices on the body's rim.
        known: How much of the rim is known, in [0, 1].
        px_per_m: What a metre is in the picture, at the body.
    """

    skin: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    thickness: Float[np.ndarray, "vertices"]
    rim: Int[np.ndarray, "rim"]
    known: float
    px_per_m: float


@final
class Shell:
    """The thickness of what one person wears."""

    def __init__(self, shaped: ShapedBody) -> None:
        """Nobody has voted yet."""
        self._shaped, self._outline = shaped, Outline(shaped)
        count = len(shaped.vertices)
        self._votes = np.zeros((count, 2 * len(LAYERS_M)))  # for person, and all
        self._smooth = _smoothing(shaped.body.faces, count)
        self._limb = shaped.body.weights.argmax(axis=1)
        self._foot = np.isin(self._limb, FEET)
        ones, vertices = np.ones(count), np.arange(count)
        self._limbs = csr_matrix(coo_matrix((ones, (self._limb, vertices)), shape=(24, count)))

    def around(self, pose: BodyPose, camera: Camera) -> Around | None:
        """The shell around a pose; None if the body comes too near or behind the camera."""
        skin = self._shaped.with_pose(pose).vertices()
        depth = skin @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        if depth.min() < NEAR_M:
            return None
        normals = _normals(skin, self._shaped.body.faces)
        rays = skin - camera.center_world
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rim = np.flatnonzero(np.abs(np.einsum("va,va->v", normals, rays)) < TANGENT)
        thickness, known = self._thickness()
        return Around(
            skin=skin,
            normals=normals,
            thickness=thickness,
            rim=rim,
            known=float(known[rim].mean()) if len(rim) else 0.0,
            px_per_m=max(camera.focal_px) / float(np.median(depth)),
        )

    def drawn(self, around: Around, camera: Camera) -> Float32[np.ndarray, "rows columns"]:
        """The shape of the shell, `FINE` times finer than the camera's picture: 1, else 0."""
        width, height = camera.size_px
        out = around.thickness - EDGE_PX / around.px_per_m
        outer = around.skin + around.normals * out[:, None]
        fine = camera.resized((width * FINE, height * FINE))
        return self._outline.filled(outer, fine).astype(np.float32)

    def vote(
        self,
        around: Around,
        camera: Camera,
        rgb: UInt8[np.ndarray, "height width 3"],
        alpha: Float32[np.ndarray, "height width"],
        away_px: Float32[np.ndarray, "height width"],
        doubt_m: tuple[float, float],
    ) -> None:
        """Lets a mask say how far out the person reaches.

        Args:
            around: The shell as it was when the mask was found.
            camera: Of the mask's size.
            rgb: The picture.
            alpha: The mask.
            away_px: How far each pixel is outside the shell's shape; inside negative.
            doubt_m: How far inside and outside the shell the mask was in doubt.
        """
        rim, count = around.rim, len(LAYERS_M)
        from_skin = LAYERS_M + self._beyond(around, camera, away_px)[:, None]
        points = around.skin[rim, None] + around.normals[rim, None] * from_skin[:, :, None]
        at = camera.project(points).astype(np.float32) - np.float32(0.5)
        x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        mask = cv2.remap(alpha, x, y, cv2.INTER_LINEAR, borderValue=-1.0)
        away = cv2.remap(away_px, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        over = LAYERS_M - around.thickness[rim, None]
        should = over * around.px_per_m
        # elsewhere another limb is nearer, or the same one is seen before or behind the point
        told = (np.abs(away - should) < 0.35 * np.abs(should) + 1.0) & (mask >= 0.0)
        inside = np.minimum.accumulate(np.where(told, mask, 1.0) > 0.5, axis=1).sum(axis=1)
        rows = np.arange(len(rim))
        border = over[rows, np.clip(inside - 1, 0, count - 1)]
        weight = np.ones(len(rim))
        inwards, outwards = doubt_m
        weight[(border > outwards - AT_LIMIT_M) | (border < AT_LIMIT_M - inwards)] = AT_LIMIT_VOTE
        colours = cv2.remap(rgb, x, y, cv2.INTER_LINEAR).astype(np.float32)
        before = colours[rows, np.clip(inside - 2, 0, count - 1)]
        behind = colours[rows, np.clip(inside + 1, 0, count - 1)]
        weight *= np.clip(np.abs(before - behind).max(axis=1) / CLEAR, 0.0, 1.0) ** 2
        self._votes[rim, :count] += np.where(told, mask, 0.0) * weight[:, None]
        self._votes[rim, count:] += told * weight[:, None]

    def _beyond(
        self, around: Around, camera: Camera, away_px: Float32[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "rim"]:
        """How far the outline was drawn beyond each vertex of the rim, metres.

        An outline is the envelope of all triangles: where vertices are dense and their thickness
        is noisy, as on the head, the farthest of them make it. By so much less a vertex must be
        lifted for the outline to lie where the mask ends.
        """
        rim = around.rim
        shell = around.skin[rim] + around.normals[rim] * around.thickness[rim, None]
        x, y = camera.project(shell).astype(np.float32).T - np.float32(0.5)
        away = cv2.remap(
            away_px, x.reshape(-1, 1), y.reshape(-1, 1), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1)  # fmt: skip
        beyond = np.clip(-away / around.px_per_m, -BEYOND_M, BEYOND_M)
        beyond[np.abs(away) > BEYOND_PX] = 0.0
        return min(1.0, around.known / FOLLOWED) * beyond

    def _thickness(
        self,
    ) -> tuple[Float[np.ndarray, "vertices"], Float[np.ndarray, "vertices"]]:
        """Of each vertex: where enough of the votes end, and how well that is known."""
        count = len(LAYERS_M)
        votes = self._smooth @ (self._smooth @ self._votes)
        of_limb = LIMB_SHARE * np.asarray(self._limbs @ self._votes)
        guess = np.clip(0.5 - (LAYERS_M - GUESS_M) / GUESS_WIDTH_M, 0.0, 1.0)
        limb = (of_limb[:, :count] + GUESS_VOTES * guess) / (of_limb[:, count:] + GUESS_VOTES)
        person = votes[:, :count] + LIMB_VOTES * limb[self._limb]
        person /= votes[:, count:] + LIMB_VOTES
        person = np.minimum.accumulate(person, axis=1)
        known = np.minimum(1.0, votes[:, count:].max(axis=1) / KNOWN_VOTES)
        enough = 0.5 - (0.5 - SOLES_SHARE) * known * self._foot
        beyond = person < enough[:, None]
        first = np.where(beyond.any(axis=1), beyond.argmax(axis=1), count - 1)
        rows, last = np.arange(len(person)), np.maximum(first - 1, 0)
        high, low = person[rows, last], person[rows, first]
        share = np.clip((high - enough) / np.maximum(high - low, 1e-6), 0.0, 1.0)
        thickness = LAYERS_M[last] + np.where(first > 0, share, 0.0) * (
            LAYERS_M[first] - LAYERS_M[last]
        )
        return thickness, known


def _smoothing(faces: Int[np.ndarray, "faces 3"], count: int) -> csr_matrix:
    """Half of each vertex and half of the mean of its neighbours."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    links = csr_matrix(coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count)))
    degree = np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)
    return csr_matrix(0.5 * identity(count) + 0.5 * (diags(1.0 / degree) @ links))


def _normals(
    points: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Unit normals, area-weighted over the triangles around each vertex."""
    a, b, c = points[faces[:, 0]], points[faces[:, 1]], points[faces[:, 2]]
    across = np.cross(b - a, c - a)
    flat, count = faces.ravel(), len(points)
    normals = np.column_stack(
        [np.bincount(flat, np.repeat(across[:, axis], 3), minlength=count) for axis in range(3)]
    )
    return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)
