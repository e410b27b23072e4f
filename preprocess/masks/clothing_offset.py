"""Offset of clothes and hair from the body, per vertex, learnt from where masks end.

Where a vertex is on the body's rim as the camera sees it, the mask along its normal shows how far
the person extends there. These votes are kept per vertex in layers of height over the skin, so that
later images settle what one leaves uncertain: behind a person who turns or a camera that moves the
background changes, clothes do not. Hair protrudes further than the layers: around the head a wider
region is uncertain, and solid regions in it are hair rather than segmentation leaks.
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
"""SMPL's head joint."""

HEAD_RADIUS_M = 0.3
"""Radius around the center of the head in which pixels may be hair, metres."""
HAIR_BAND_M = 0.06
"""Least width of the uncertain band outside the clothed shape within that radius, metres."""

MIN_HAIR_WIDTH_M = 0.025
"""Least width of a bun in all directions, metres; thinner regions may be segmentation leaks."""


def head_region(
    skin: Float[np.ndarray, "points 3"], camera: Camera, px_per_m: float
) -> Bool[np.ndarray, "height width"]:
    """The pixels that may be hair.

    Args:
        skin: Vertices of the head in the world, metres.
        camera: Camera of the image.
        px_per_m: Pixels per metre at the body.
    """
    x, y = camera.project(skin.mean(axis=0, keepdims=True))[0]
    width, height = camera.size_px
    across, down = np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y
    return across**2 + (down**2)[:, None] < (HEAD_RADIUS_M * px_per_m) ** 2


def solid_hair(
    protruding: Bool[np.ndarray, "height width"], px_per_m: float
) -> Bool[np.ndarray, "height width"]:
    """Hair that protrudes in one wide piece, dilated by a pixel.

    Args:
        protruding: Pixels of possible hair outside the clothed shape.
        px_per_m: Pixels per metre at the body.
    """
    wide = np.ones((max(3, int(MIN_HAIR_WIDTH_M * px_per_m) | 1),) * 2, np.uint8)
    solid = cv2.morphologyEx(protruding.astype(np.uint8), cv2.MORPH_OPEN, wide)
    return cv2.dilate(solid, np.ones((3, 3), np.uint8)) > 0


OFFSET_LAYERS_M = np.arange(-0.015, 0.0901, 0.0075)
"""Heights over the skin at which votes are kept, metres."""

PRIOR_OFFSET_M = 0.01
"""Prior mean of the clothing offset, metres."""
PRIOR_OFFSET_WIDTH_M = 0.015
"""Width of the prior's transition from person to background, metres."""
PRIOR_VOTES = 1.0
"""Weight of the prior, in votes of a limb."""
LIMB_MEAN_VOTES = 0.5
"""Weight of a limb's mean offset, in votes of a vertex."""
LIMB_VOTE_WEIGHT = 0.02
"""Weight of a vertex's vote in its limb's mean."""

KNOWN_VOTES = 4.0
"""Votes from which a vertex is known."""

RIM_COSINE = 0.15
"""Largest cosine between normal and ray of a vertex on the rim."""

CLEAR_CONTRAST = 25.0
"""Color difference across the mask's border, in levels, from which a vote has full weight."""
BAND_LIMIT_M = 0.006
"""Distance to the uncertain band's limit within which a border was cut off, not found, metres."""
BAND_LIMIT_WEIGHT = 0.1
"""Weight of a vote whose border was cut off."""

FOOT_JOINTS = 7, 8, 10, 11
"""SMPL's ankle and foot joints."""
SOLE_VOTE_FRACTION = 0.35
"""Fraction of person votes up to which a known vertex of a foot extends; elsewhere 0.5. Soles are
dark in their own shadow: segmentations miss them more often than they add to them."""

OVERSHOOT_KNOWN_FRACTION = 0.4
"""Known fraction of the rim from which offsets compensate for the drawn outline overshooting the
vertices. Until then the shape errs on the large side: GrabCut can remove pixels but never adds any
beyond the uncertain band."""
MAX_OVERSHOOT_M = 0.01
"""Largest overshoot to compensate, metres."""
MAX_OVERSHOOT_PX = 1.5
"""Distance from the drawn outline beyond which a vertex is not on it, px."""

SUPERSAMPLING = 3
"""Resolution of the drawn shape relative to the image."""
FILL_BIAS_PX = 0.25
"""`fillPoly` also fills pixels that it touches: shapes come out this many pixels too large."""


class ClothedBody(NamedTuple):
    """A posed body with its clothing offsets, as a camera sees it.

    Attributes:
        skin: Vertices in the world, metres.
        normals: Unit normals of the vertices in the world.
        offset_m: Clothing offset of each vertex, metres.
        rim_vertices: The vertices on the body's rim.
        known_fraction: Mean certainty of the rim's offsets, in [0, 1].
        px_per_m: Pixels per metre at the body.
    """

    skin: Float[np.ndarray, "vertices 3"]
    normals: Float[np.ndarray, "vertices 3"]
    offset_m: Float[np.ndarray, "vertices"]
    rim_vertices: Int[np.ndarray, "rim_vertices"]
    known_fraction: float
    px_per_m: float


@final
class ClothingOffset:
    """Clothing offsets of one person, learnt from votes of masks."""

    def __init__(self, shaped: ShapedBody) -> None:
        """Start without votes."""
        self._shaped, self._outline = shaped, MeshSilhouette(shaped)
        count = len(shaped.vertices)
        self._votes = np.zeros(
            (count, 2 * len(OFFSET_LAYERS_M))
        )  # votes for person, then all votes
        self._smooth = _smoothing_matrix(shaped.body.faces, count)
        self._limb = shaped.body.weights.argmax(axis=1)
        self._foot = np.isin(self._limb, FOOT_JOINTS)
        ones, vertices = np.ones(count), np.arange(count)
        self._limbs = csr_matrix(coo_matrix((ones, (self._limb, vertices)), shape=(24, count)))

    def clothe(self, pose: BodyPose, camera: Camera) -> ClothedBody | None:
        """Dress a pose; None if the body comes too near or behind the camera."""
        skin = self._shaped.with_pose(pose).vertices()
        depth = skin @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        if depth.min() < NEAR_PLANE_M:
            return None
        normals = vertex_normals(skin, self._shaped.body.faces)
        rays = skin - camera.center_world
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rim = np.flatnonzero(np.abs(np.einsum("va,va->v", normals, rays)) < RIM_COSINE)
        offsets, known = self._offsets_m()
        return ClothedBody(
            skin=skin,
            normals=normals,
            offset_m=offsets,
            rim_vertices=rim,
            known_fraction=float(known[rim].mean()) if len(rim) else 0.0,
            px_per_m=max(camera.focal_px) / float(np.median(depth)),
        )

    def draw(self, clothed: ClothedBody, camera: Camera) -> Float32[np.ndarray, "rows columns"]:
        """Draw the clothed shape (1, else 0), `SUPERSAMPLING` times finer than the image."""
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
        """Add a mask's votes on how far the person extends beyond the skin.

        Args:
            clothed: The clothed body when the mask was estimated.
            camera: Camera of the mask's size.
            rgb: The image.
            alpha: The mask.
            signed_distance_px: Distance from the clothed shape's border, positive outside, px.
            band_m: Width of the uncertain band inside and outside the shape, metres.
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
        # Elsewhere another limb is nearer, or this one is seen in front of or behind the point.
        is_valid = (np.abs(away - should) < 0.35 * np.abs(should) + 1.0) & (mask >= 0.0)
        inside = np.minimum.accumulate(np.where(is_valid, mask, 1.0) > 0.5, axis=1).sum(axis=1)
        rows = np.arange(len(rim))
        border = over[rows, np.clip(inside - 1, 0, count - 1)]
        weight = np.ones(len(rim))
        inwards, outwards = band_m
        weight[(border > outwards - BAND_LIMIT_M) | (border < BAND_LIMIT_M - inwards)] = (
            BAND_LIMIT_WEIGHT
        )
        colors = cv2.remap(rgb, x, y, cv2.INTER_LINEAR).astype(np.float32)
        before = colors[rows, np.clip(inside - 2, 0, count - 1)]
        behind = colors[rows, np.clip(inside + 1, 0, count - 1)]
        weight *= np.clip(np.abs(before - behind).max(axis=1) / CLEAR_CONTRAST, 0.0, 1.0) ** 2
        self._votes[rim, :count] += np.where(is_valid, mask, 0.0) * weight[:, None]
        self._votes[rim, count:] += is_valid * weight[:, None]

    def _overshoot_m(
        self,
        clothed: ClothedBody,
        camera: Camera,
        signed_distance_px: Float32[np.ndarray, "height width"],
    ) -> Float[np.ndarray, "rim"]:
        """How far the outline was drawn beyond each vertex of the rim, metres.

        An outline is the envelope of all triangles: where vertices are dense and their offsets
        noisy, as on the head, the outermost vertices make it. Offsets are reduced by the overshoot
        so that the outline lies where the mask ends.
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
        """Offset of each vertex, metres, and its certainty in [0, 1]."""
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
        offsets = OFFSET_LAYERS_M[last] + np.where(first > 0, share, 0.0) * (
            OFFSET_LAYERS_M[first] - OFFSET_LAYERS_M[last]
        )
        return offsets, known


def _smoothing_matrix(faces: Int[np.ndarray, "faces 3"], count: int) -> csr_matrix:
    """Matrix that takes half of each vertex and half of the mean of its neighbors."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    links = csr_matrix(coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count)))
    degree = np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)
    return csr_matrix(0.5 * identity(count) + 0.5 * (diags(1.0 / degree) @ links))
