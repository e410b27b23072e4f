"""Hair that stands off the head farther than clothes do: where it may be, and what is no leak.

How far clothes and hair stand off the body, learnt frame by frame from where masks end.

The shell is a thickness for each vertex of the skin. Where a vertex is on the body's rim, seen from
the camera, the mask along its normal tells how far out the person reaches there. These votes are
kept in layers at rest, so that what one picture leaves in doubt, others settle: backgrounds change
behind a person who turns or a camera that walks, clothes do not.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.sparse import coo_matrix, csr_matrix, diags, identity

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import vertex_normals
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.silhouette import NEAR_PLANE_M, MeshSilhouette

HEAD_JOINT = 15
"""The head's joint."""

HEAD_RADIUS_M, HAIR_BAND_M = 0.3, 0.06
"""So near to the head's middle, outside the shell at least so much is in doubt; what is found there
does not make a cut less trusted."""

MIN_HAIR_WIDTH_M = 0.025
"""What is so wide in all directions is a knot or a bun, however little the shell knows of it; what
is narrower may be a leak."""


def head_region(
    skin: Float[np.ndarray, "points 3"], camera: Camera, px_per_m: float
) -> Bool[np.ndarray, "height width"]:
    """The pixels that may be hair.

    Args:
        skin: The head's, in the world.
        camera: Of the picture.
        px_per_m: What a metre is in the picture, at the body.
    """
    x, y = camera.project(skin.mean(axis=0, keepdims=True))[0]
    width, height = camera.size_px
    across, down = np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y
    return across**2 + (down**2)[:, None] < (HEAD_RADIUS_M * px_per_m) ** 2


def solid_hair(
    protruding: Bool[np.ndarray, "height width"], px_per_m: float
) -> Bool[np.ndarray, "height width"]:
    """Of hair outside the shell what stands off in one piece, and the pixels beside it.

    Args:
        beyond: The pixels of hair outside the shell.
        px_per_m: What a metre is in the picture, at the body.
    """
    wide = np.ones((max(3, int(MIN_HAIR_WIDTH_M * px_per_m) | 1),) * 2, np.uint8)
    solid = cv2.morphologyEx(protruding.astype(np.uint8), cv2.MORPH_OPEN, wide)
    return cv2.dilate(solid, np.ones((3, 3), np.uint8)) > 0


OFFSET_LAYERS_M = np.arange(-0.015, 0.0901, 0.0075)
"""Heights over the skin at which votes are kept."""

PRIOR_OFFSET_M = 0.01
"""How thick clothes are, as long as nobody has voted."""
PRIOR_OFFSET_WIDTH_M = 0.015
PRIOR_VOTES, LIMB_MEAN_VOTES, LIMB_VOTE_WEIGHT = 1.0, 0.5, 0.02
"""A limb's mean thickness is worth so many votes of a vertex; a vote of a vertex is worth so much
of one of its limb, where the guess has one."""

KNOWN_VOTES = 4.0
"""A vertex with so many votes is known."""

RIM_COSINE = 0.15
"""Vertices whose normal is so nearly across the ray are on the rim (the cosine)."""

CLEAR_CONTRAST = 25.0
"""Colors on both sides of the mask's border less far apart than this vote less."""
BAND_LIMIT_M, BAND_LIMIT_WEIGHT = 0.006, 0.1
"""A border so near to the limit of what was in doubt was not found but cut off; its vote is so much
worth."""

FOOT_JOINTS = 7, 8, 10, 11
SOLE_VOTE_FRACTION = 0.35
"""A vertex is as thick as half of its votes say. Soles are dark in their own shadow, and cuts more
often miss them than add to them; so at the ankles' and feet's joints fewer are enough, where a
vertex is known."""

OVERSHOOT_KNOWN_FRACTION = 0.4
"""From so much of the rim known, the thickness makes up for how far the drawn outline stands beyond
the vertices. Before, the shell stays too large rather: what is too much GrabCutSegmenter takes away, but it
does not look for what is not in doubt."""
MAX_OVERSHOOT_M, MAX_OVERSHOOT_PX = 0.01, 1.5
"""A vertex farther than this from the drawn outline is not on it."""

SUPERSAMPLING = 3
"""The shell is drawn so many times finer than the picture in which masks are found."""
FILL_BIAS_PX = 0.25
"""So much too large are shapes that are filled with all pixels that they touch."""


class ClothedBody(NamedTuple):
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
    offset_m: Float[np.ndarray, "vertices"]
    rim_vertices: Int[np.ndarray, "rim_vertices"]
    known_fraction: float
    px_per_m: float


@final
class ClothingOffset:
    """The thickness of what one person wears."""

    def __init__(self, shaped: ShapedBody) -> None:
        """Nobody has voted yet."""
        self._shaped, self._outline = shaped, MeshSilhouette(shaped)
        count = len(shaped.vertices)
        self._votes = np.zeros((count, 2 * len(OFFSET_LAYERS_M)))  # for person, and all
        self._smooth = _smoothing_matrix(shaped.body.faces, count)
        self._limb = shaped.body.weights.argmax(axis=1)
        self._foot = np.isin(self._limb, FOOT_JOINTS)
        ones, vertices = np.ones(count), np.arange(count)
        self._limbs = csr_matrix(coo_matrix((ones, (self._limb, vertices)), shape=(24, count)))

    def clothe(self, pose: BodyPose, camera: Camera) -> ClothedBody | None:
        """The shell around a pose; None if the body comes too near or behind the camera."""
        skin = self._shaped.with_pose(pose).vertices()
        depth = skin @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        if depth.min() < NEAR_PLANE_M:
            return None
        normals = vertex_normals(skin, self._shaped.body.faces)
        rays = skin - camera.center_world
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rim = np.flatnonzero(np.abs(np.einsum("va,va->v", normals, rays)) < RIM_COSINE)
        thickness, known = self._offsets_m()
        return ClothedBody(
            skin=skin,
            normals=normals,
            offset_m=thickness,
            rim_vertices=rim,
            known_fraction=float(known[rim].mean()) if len(rim) else 0.0,
            px_per_m=max(camera.focal_px) / float(np.median(depth)),
        )

    def draw(self, clothed: ClothedBody, camera: Camera) -> Float32[np.ndarray, "rows columns"]:
        """The shape of the shell, `SUPERSAMPLING` times finer than the camera's picture: 1, else 0."""
        width, height = camera.size_px
        out = clothed.offset_m - FILL_BIAS_PX / clothed.px_per_m
        outer = clothed.skin + clothed.normals * out[:, None]
        fine = camera.resize((width * SUPERSAMPLING, height * SUPERSAMPLING))
        return self._outline.draw_vertices(outer, fine).astype(np.float32)

    def update(
        self,
        clothed: ClothedBody,
        camera: Camera,
        rgb: UInt8[np.ndarray, "height width 3"],
        alpha: Float32[np.ndarray, "height width"],
        signed_distance_px: Float32[np.ndarray, "height width"],
        band_m: tuple[float, float],
    ) -> None:
        """Lets a mask say how far out the person reaches.

        Args:
            around: The shell as it was when the mask was found.
            camera: Of the mask's size.
            rgb: The picture.
            alpha: The mask.
            signed_distance_px: How far each pixel is outside the shell's shape; inside negative.
            band_m: How far inside and outside the shell the mask was in doubt.
        """
        rim, count = clothed.rim_vertices, len(OFFSET_LAYERS_M)
        from_skin = (
            OFFSET_LAYERS_M + self._overshoot_m(clothed, camera, signed_distance_px)[:, None]
        )
        points = clothed.skin[rim, None] + clothed.normals[rim, None] * from_skin[:, :, None]
        at = camera.project(points).astype(np.float32) - np.float32(0.5)
        x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
        mask = cv2.remap(alpha, x, y, cv2.INTER_LINEAR, borderValue=-1.0)
        away = cv2.remap(
            signed_distance_px, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        over = OFFSET_LAYERS_M - clothed.offset_m[rim, None]
        should = over * clothed.px_per_m
        # elsewhere another limb is nearer, or the same one is seen before or behind the point
        told = (np.abs(away - should) < 0.35 * np.abs(should) + 1.0) & (mask >= 0.0)
        inside = np.minimum.accumulate(np.where(told, mask, 1.0) > 0.5, axis=1).sum(axis=1)
        rows = np.arange(len(rim))
        border = over[rows, np.clip(inside - 1, 0, count - 1)]
        weight = np.ones(len(rim))
        inwards, outwards = band_m
        weight[(border > outwards - BAND_LIMIT_M) | (border < BAND_LIMIT_M - inwards)] = (
            BAND_LIMIT_WEIGHT
        )
        colours = cv2.remap(rgb, x, y, cv2.INTER_LINEAR).astype(np.float32)
        before = colours[rows, np.clip(inside - 2, 0, count - 1)]
        behind = colours[rows, np.clip(inside + 1, 0, count - 1)]
        weight *= np.clip(np.abs(before - behind).max(axis=1) / CLEAR_CONTRAST, 0.0, 1.0) ** 2
        self._votes[rim, :count] += np.where(told, mask, 0.0) * weight[:, None]
        self._votes[rim, count:] += told * weight[:, None]

    def _overshoot_m(
        self,
        clothed: ClothedBody,
        camera: Camera,
        signed_distance_px: Float32[np.ndarray, "height width"],
    ) -> Float[np.ndarray, "rim"]:
        """How far the outline was drawn beyond each vertex of the rim, metres.

        An outline is the envelope of all triangles: where vertices are dense and their thickness
        is noisy, as on the head, the farthest of them make it. By so much less a vertex must be
        lifted for the outline to lie where the mask ends.
        """
        rim = clothed.rim_vertices
        shell = clothed.skin[rim] + clothed.normals[rim] * clothed.offset_m[rim, None]
        x, y = camera.project(shell).astype(np.float32).T - np.float32(0.5)
        away = cv2.remap(
            signed_distance_px, x.reshape(-1, 1), y.reshape(-1, 1), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1)  # fmt: skip
        beyond = np.clip(-away / clothed.px_per_m, -MAX_OVERSHOOT_M, MAX_OVERSHOOT_M)
        beyond[np.abs(away) > MAX_OVERSHOOT_PX] = 0.0
        return min(1.0, clothed.known_fraction / OVERSHOOT_KNOWN_FRACTION) * beyond

    def _offsets_m(
        self,
    ) -> tuple[Float[np.ndarray, "vertices"], Float[np.ndarray, "vertices"]]:
        """Of each vertex: where enough of the votes end, and how well that is known."""
        count = len(OFFSET_LAYERS_M)
        votes = self._smooth @ (self._smooth @ self._votes)
        of_limb = LIMB_VOTE_WEIGHT * np.asarray(self._limbs @ self._votes)
        guess = np.clip(0.5 - (OFFSET_LAYERS_M - PRIOR_OFFSET_M) / PRIOR_OFFSET_WIDTH_M, 0.0, 1.0)
        limb = (of_limb[:, :count] + PRIOR_VOTES * guess) / (of_limb[:, count:] + PRIOR_VOTES)
        person = votes[:, :count] + LIMB_MEAN_VOTES * limb[self._limb]
        person /= votes[:, count:] + LIMB_MEAN_VOTES
        person = np.minimum.accumulate(person, axis=1)
        known = np.minimum(1.0, votes[:, count:].max(axis=1) / KNOWN_VOTES)
        enough = 0.5 - (0.5 - SOLE_VOTE_FRACTION) * known * self._foot
        beyond = person < enough[:, None]
        first = np.where(beyond.any(axis=1), beyond.argmax(axis=1), count - 1)
        rows, last = np.arange(len(person)), np.maximum(first - 1, 0)
        high, low = person[rows, last], person[rows, first]
        share = np.clip((high - enough) / np.maximum(high - low, 1e-6), 0.0, 1.0)
        thickness = OFFSET_LAYERS_M[last] + np.where(first > 0, share, 0.0) * (
            OFFSET_LAYERS_M[first] - OFFSET_LAYERS_M[last]
        )
        return thickness, known


def _smoothing_matrix(faces: Int[np.ndarray, "faces 3"], count: int) -> csr_matrix:
    """Half of each vertex and half of the mean of its neighbours."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    links = csr_matrix(coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count)))
    degree = np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)
    return csr_matrix(0.5 * identity(count) + 0.5 * (diags(1.0 / degree) @ links))
