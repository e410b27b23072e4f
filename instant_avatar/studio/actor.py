"""The person in front of the camera: the embedded body, dressed, lit and drawn in any pose.

Clothes, hair and shoes are layers of triangles that hang from the body's own vertices.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree

from capture.camera import Camera
from capture.source import AlphaMask
from instant_avatar.studio.lighting import (
    LAMP_STRENGTH,
    ClothingCut,
    bake_light,
    fibonacci_directions,
    rasterize,
    shade_pixels,
)
from instant_avatar.studio.outfit import (
    EYE,
    HAIR,
    OUTFITS,
    SHIRT,
    SHOE,
    SKIN,
    TROUSERS,
    BodyProportions,
    Outfit,
    Palette,
    PerVertex,
    Vertices,
)
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import vertex_normals
from preprocess.body.parametric_body import BodyModel, ShapedBody, load_body_model

ThicknessFunction = Callable[[Vertices], PerVertex]


@dataclass(frozen=True, eq=False, kw_only=True)
class ClothingLayer:
    """One surface of the dressed person.

    Attributes:
        rest_vertices: Vertices on the template, metres.
        template_points: Position of each vertex on the undressed template, of which colors and
            borders are functions, so that they stick to the body.
        body_vertices: The body vertex of each vertex, from which it takes weights and shape.
    """

    material: int
    rest_vertices: Vertices
    template_points: Vertices
    body_vertices: Int32[np.ndarray, "vertices"]
    faces: Int32[np.ndarray, "faces 3"]


def build_layers(body: BodyModel, outfit: Outfit) -> list[ClothingLayer]:
    """All layers of the person in `outfit`, the skin first."""
    layers = [*_skin_and_eyes(body), _shirt(body, outfit), _trousers(body, outfit)]
    layers += [_hair(body, outfit), *(_shoe(body, side) for side in (1.0, -1.0))]
    if outfit.bun:
        layers.append(_bun(body))
    return layers


def _skin_and_eyes(body: BodyModel) -> list[ClothingLayer]:
    """The skin and the eyeballs; what lies inside the mouth is left out."""
    edges = np.concatenate([body.faces[:, :2], body.faces[:, 1:]])
    count = len(body.template)
    graph = coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    sizes = np.bincount(piece)
    heights = np.bincount(piece, weights=body.template[:, 1]) / sizes
    skin = int(sizes.argmax())
    eyes = [p for p in range(len(sizes)) if p != skin and heights[p] > 0.48]
    return [
        _submesh(body, SKIN, piece == skin),
        *(_submesh(body, EYE, piece == eye) for eye in eyes),
    ]


def _submesh(body: BodyModel, kind: int, chosen: Bool[np.ndarray, "vertices"]) -> ClothingLayer:
    faces = body.faces[chosen[body.faces].all(axis=1)]
    source, flat = np.unique(faces, return_inverse=True)
    place = body.template[source].astype(np.float64)
    return ClothingLayer(
        material=kind,
        rest_vertices=place,
        template_points=place,
        body_vertices=source.astype(np.int32),
        faces=flat.reshape(-1, 3).astype(np.int32),
    )


def _subdivide(layer: ClothingLayer) -> ClothingLayer:
    """Split every triangle in four; new vertices hang from an old one."""
    edges = np.sort(layer.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, which = np.unique(edges, axis=0, return_inverse=True)
    middle = len(layer.rest_vertices) + which.reshape(-1, 3)
    a, b, c = layer.faces.T
    ab, bc, ca = middle.T
    faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c))])
    return replace(
        layer,
        rest_vertices=np.concatenate(
            [layer.rest_vertices, layer.rest_vertices[unique].mean(axis=1)]
        ),
        template_points=np.concatenate(
            [layer.template_points, layer.template_points[unique].mean(axis=1)]
        ),
        body_vertices=np.concatenate([layer.body_vertices, layer.body_vertices[unique[:, 0]]]),
        faces=np.concatenate([faces, middle]).astype(np.int32),
    )


def _drape(
    layer: ClothingLayer, thickness: ThicknessFunction, *, smoothing: int, smooth_place: bool = True
) -> ClothingLayer:
    """Smooth a layer like cloth over the body and lift it off along its normals."""
    rest = layer.rest_vertices
    average, inner = _neighbor_mean_operator(layer)
    for _ in range(smoothing):
        rest = np.where(inner[:, None], 0.5 * rest + 0.5 * (average @ rest), rest)
    normals = vertex_normals(rest, layer.faces)
    for _ in range(4):
        normals = average @ normals
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    # Smoothing sinks a convex surface; cloth never lies under the skin.
    sunk = np.maximum(np.einsum("va,va->v", layer.rest_vertices - rest, normals), 0.0)
    for _ in range(3):
        sunk = np.maximum(sunk, average @ sunk)
    lifted = rest + normals * (thickness(layer.template_points) + sunk)[:, None]
    places = rest if smooth_place else layer.template_points
    return replace(layer, rest_vertices=lifted, template_points=places)


def _neighbor_mean_operator(
    layer: ClothingLayer,
) -> tuple[csr_matrix, Bool[np.ndarray, "vertices"]]:
    """Return the mean over neighbors as a matrix, and the vertices that are no border."""
    edges = np.sort(layer.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, used = np.unique(edges, axis=0, return_counts=True)
    count = len(layer.rest_vertices)
    both = np.concatenate([unique, unique[:, ::-1]])
    links = csr_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count))
    degree = np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1.0)
    inner = np.ones(count, dtype=bool)
    inner[unique[used == 1].ravel()] = False
    return csr_matrix(links.multiply(1.0 / degree[:, None])), inner


def _shirt(body: BodyModel, outfit: Outfit) -> ClothingLayer:
    x, y, _ = body.template.T
    torso = (y > -0.37) & (y < 0.42) & (np.abs(x) < outfit.sleeve + 0.07)
    return _drape(_subdivide(_submesh(body, SHIRT, torso)), outfit.shirt_thickness, smoothing=14)


def _trousers(body: BodyModel, outfit: Outfit) -> ClothingLayer:
    x, y, _ = body.template.T
    legs = (y < -0.06) & (y > -1.19) & (np.abs(x) < 0.4)
    return _drape(_subdivide(_submesh(body, TROUSERS, legs)), outfit.trouser_thickness, smoothing=8)


def _hair(body: BodyModel, outfit: Outfit) -> ClothingLayer:
    _, y, z = body.template.T
    scalp = (y > 0.36) & (z < 0.175) & (body.weights[:, 15] + body.weights[:, 12] > 0.9)
    return _drape(
        _submesh(body, HAIR, scalp), outfit.hair_thickness, smoothing=12, smooth_place=False
    )


def _shoe(body: BodyModel, side: float) -> ClothingLayer:
    """The hull of a foot, grown by 7 mm: no toes, a flat sole."""
    foot = np.flatnonzero((body.template[:, 1] < -1.115) & (body.template[:, 0] * side > 0))
    points = body.template[foot].astype(np.float64)
    hull = ConvexHull(points)
    corners, flat = np.unique(hull.simplices, return_inverse=True)
    faces = flat.reshape(-1, 3)
    a, b, c = (points[corners][faces[:, corner]] for corner in range(3))
    inward = np.einsum("fa,fa->f", np.cross(b - a, c - a), a - points.mean(axis=0)) < 0
    faces[inward] = faces[inward][:, ::-1]
    return _attach_to_body(body, SHOE, points[corners], faces, grown=0.007, refined=2, among=foot)


def _bun(body: BodyModel) -> ClothingLayer:
    """A knot of hair on the crown."""
    ball = fibonacci_directions(256)
    points = np.array([-0.002, 0.615, -0.035]) + ball * np.array([0.046, 0.042, 0.046])
    faces = ConvexHull(points).simplices
    scalp = np.flatnonzero(body.template[:, 1] > 0.56)
    return _attach_to_body(body, HAIR, points, faces, grown=0.0, refined=0, among=scalp)


def _attach_to_body(
    body: BodyModel,
    kind: int,
    points: Vertices,
    faces: Int[np.ndarray, "faces 3"],
    *,
    grown: float,
    refined: int,
    among: Int[np.ndarray, "chosen"],
) -> ClothingLayer:
    """Make a surface whose vertices hang from the nearest of the body vertices `among`."""
    layer = ClothingLayer(
        material=kind,
        rest_vertices=points,
        template_points=points,
        body_vertices=np.zeros(len(points), dtype=np.int32),
        faces=faces.astype(np.int32),
    )
    for _ in range(refined):
        layer = _subdivide(layer)
    average, _ = _neighbor_mean_operator(layer)
    rest = layer.rest_vertices
    for _ in range(refined):
        rest = 0.5 * rest + 0.5 * (average @ rest)
    rest = rest + grown * vertex_normals(rest, layer.faces)
    _, nearest = KDTree(body.template[among]).query(layer.rest_vertices)
    hung = among[nearest].astype(np.int32)
    return replace(layer, rest_vertices=rest, template_points=rest, body_vertices=hung)


A_POSE = np.zeros(69)
A_POSE[[2, 5, 47, 50]] = (0.2, -0.2, -0.8, 0.8)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Actor:
    """A dressed person who can be drawn in any pose.

    Attributes:
        shaped: The body underneath; `poses.npz` is about this one.
        rest_vertices: Vertices of all layers at rest, metres.
        template_points: Position of each vertex on the undressed template.
        body_vertices: The body vertex that each vertex hangs from.
        baked_light: Light on each vertex, as a factor of its color.
        palette: The outfit's colors, tinted by the seed.
    """

    betas: Float[np.ndarray, "10"]
    shaped: ShapedBody
    outfit: Outfit
    rest_vertices: Vertices
    template_points: Float32[np.ndarray, "vertices 3"]
    body_vertices: Int32[np.ndarray, "vertices"]
    faces: Int32[np.ndarray, "faces 3"]
    materials: Int32[np.ndarray, "faces"]
    baked_light: Float32[np.ndarray, "vertices 3"]
    palette: Palette

    @classmethod
    def of(
        cls, subject: int = 1, seed: int = 0, proportions: BodyProportions | None = None
    ) -> "Actor":
        """Dress one of the subjects of `OUTFITS`.

        The `seed` varies shape and colors a little (0: as designed); `proportions` are what betas
        do not describe.
        """
        body, outfit = load_body_model(), OUTFITS[subject]
        if proportions is not None:
            outfit = replace(outfit, looseness=proportions.looseness)
        generator = np.random.default_rng([seed, subject])
        spread = 0.0 if seed == 0 else 1.0
        betas = np.zeros(10)
        betas[:4] = np.array(outfit.betas) + 0.15 * spread * generator.standard_normal(4)
        tint = 1.0 + 0.05 * spread * generator.standard_normal((len(outfit.palette), 3))
        layers = build_layers(body, outfit)
        starts = np.cumsum([0] + [len(layer.rest_vertices) for layer in layers])
        source = np.concatenate([layer.body_vertices for layer in layers])
        shape = body.shape_directions[source] @ betas
        rest = np.concatenate([layer.rest_vertices for layer in layers]) + shape
        faces = np.concatenate(
            [layer.faces + start for layer, start in zip(layers, starts, strict=False)]
        )
        kinds = np.concatenate([np.full(len(layer.faces), layer.material) for layer in layers])
        shaped = body.with_shape(betas)
        if proportions is not None:
            rest = proportions.move_vertices(rest, body.weights[source], shaped.joints)
            shaped = replace(
                shaped,
                vertices=proportions.move_vertices(shaped.vertices, body.weights, shaped.joints),
                joints=proportions.move_joints(shaped.joints),
            )
        undone = cls(
            betas=betas,
            shaped=shaped,
            outfit=outfit,
            rest_vertices=rest,
            template_points=np.concatenate(
                [layer.template_points for layer in layers], dtype=np.float32
            ),
            body_vertices=source,
            faces=faces.astype(np.int32),
            materials=kinds.astype(np.int32),
            baked_light=np.ones((len(rest), 3), dtype=np.float32),
            palette=np.clip(np.array(outfit.palette) * tint, 0.0, 1.0).astype(np.float32),
        )
        return undone.with_baked_light()

    @cached_property
    def _weights(self) -> Float[np.ndarray, "vertices 24"]:
        """Skinning weights of all layers: those of the body vertices they hang from."""
        return self.shaped.body.weights[self.body_vertices].astype(np.float64)

    @property
    def cut(self) -> ClothingCut:
        """Where the garments end."""
        return ClothingCut(self.template_points, self.materials, self.outfit.measures)

    @cached_property
    def sole_vertices(self) -> Int[np.ndarray, "chosen"]:
        """Numbers of the vertices of the shoes."""
        return np.unique(self.faces[self.materials == SHOE])

    def vertices(
        self, pose: BodyPose, chosen: Int[np.ndarray, "chosen"] | slice = slice(None)
    ) -> Float[np.ndarray, "chosen 3"]:
        """Vertices of all layers in the world, metres, skinned with the body's own weights."""
        weights = self._weights[chosen]
        transforms = self.shaped.with_pose(pose).world_from_rest()[:, :3, :].reshape(24, 12)
        blended = (weights @ transforms).reshape(-1, 3, 4)
        return (
            np.einsum("vab,vb->va", blended[..., :3], self.rest_vertices[chosen]) + blended[..., 3]
        )

    def sole_height_m(self, pose: BodyPose) -> float:
        """Height of the lowest shoe in a pose, metres: where the floor is."""
        return float(self.vertices(pose, self.sole_vertices)[:, 1].min())

    def render_rgb_alpha(
        self, pose: BodyPose, camera: Camera, supersampling: int = 4
    ) -> tuple[Float32[np.ndarray, "height width 3"], AlphaMask]:
        """Return the color of each pixel's covered part, and the covered fraction, in [0, 1]."""
        seen = rasterize(
            self.vertices(pose), self.faces, camera, supersampling=supersampling, cut=self.cut
        )
        return shade_pixels(
            seen,
            faces=self.faces,
            cut=self.cut,
            light=self.baked_light,
            palette=self.palette,
            checked=self.outfit.checked,
        )

    def with_baked_light(self, lamp_strength: float = LAMP_STRENGTH) -> "Actor":
        """Paint on the light of the A-pose; without the lamp the sky's light remains."""
        pose = replace(BodyPose.rest(), joint_rotations=A_POSE.reshape(23, 3))
        points = self.vertices(pose)
        normals = vertex_normals(points, self.faces)
        light = bake_light(points, normals, self.faces, self.cut, lamp_strength=lamp_strength)
        return replace(self, baked_light=light)
