"""Clothes, hair and shoes as layers of triangles that hang from the body's own vertices."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree

from preprocess.body.body_surface import vertex_normals
from preprocess.body.parametric_body import BodyModel
from studio.outfit import EYE, HAIR, SHIRT, SHOE, SKIN, TROUSERS, Outfit

ThicknessFunction = Callable[[Float[np.ndarray, "vertices 3"]], Float[np.ndarray, "vertices"]]


@dataclass(frozen=True, eq=False, kw_only=True)
class ClothingLayer:
    """One surface of the dressed person.

    Attributes:
        material: Material of the layer (`outfit.SKIN` …).
        rest_vertices: Vertices on the template, metres.
        template_points: Position of each vertex on the undressed template, of which colors and
            borders are functions, so that they stick to the body.
        body_vertices: The body vertex of each vertex, from which it takes weights and shape.
        faces: Triangles.
    """

    material: int
    rest_vertices: Float[np.ndarray, "vertices 3"]
    template_points: Float[np.ndarray, "vertices 3"]
    body_vertices: Int32[np.ndarray, "vertices"]
    faces: Int32[np.ndarray, "faces 3"]


def build_layers(body: BodyModel, outfit: Outfit) -> list[ClothingLayer]:
    """All layers of the person in `outfit`, the skin first."""
    layers = [
        *_skin_and_eyes(body),
        _shirt(body, outfit),
        _trousers(body, outfit),
        _hair(body, outfit),
    ]
    layers += [_shoe(body, side) for side in (1.0, -1.0)]
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
    """The part of the body whose vertices are chosen."""
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
    """The same surface with every triangle split in four (new vertices hang from an old one)."""
    edges = np.sort(layer.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, which = np.unique(edges, axis=0, return_inverse=True)
    middle = len(layer.rest_vertices) + which.reshape(-1, 3)
    a, b, c = layer.faces.T
    ab, bc, ca = middle.T
    faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c))])
    return ClothingLayer(
        material=layer.material,
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
    """A layer smoothed like cloth over the body and lifted off it along its normals."""
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
    return ClothingLayer(
        material=layer.material,
        rest_vertices=lifted,
        template_points=rest if smooth_place else layer.template_points,
        body_vertices=layer.body_vertices,
        faces=layer.faces,
    )


def _neighbor_mean_operator(
    layer: ClothingLayer,
) -> tuple[csr_matrix, Bool[np.ndarray, "vertices"]]:
    """The mean over neighbours as a matrix, and which vertices are no border."""
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
    angles = np.arange(256) * (np.pi * (3.0 - np.sqrt(5.0)))
    height = 1.0 - (np.arange(256) + 0.5) / 128.0
    ring = np.sqrt(1.0 - height**2)
    ball = np.stack([ring * np.cos(angles), height, ring * np.sin(angles)], axis=1)
    points = np.array([-0.002, 0.615, -0.035]) + ball * np.array([0.046, 0.042, 0.046])
    faces = ConvexHull(points).simplices
    scalp = np.flatnonzero(body.template[:, 1] > 0.56)
    return _attach_to_body(body, HAIR, points, faces, grown=0.0, refined=0, among=scalp)


def _attach_to_body(
    body: BodyModel,
    kind: int,
    points: Float[np.ndarray, "vertices 3"],
    faces: Int[np.ndarray, "faces 3"],
    *,
    grown: float,
    refined: int,
    among: Int[np.ndarray, "chosen"],
) -> ClothingLayer:
    """A surface of its own, each vertex hung from the nearest of the body vertices `among`."""
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
    return ClothingLayer(
        material=kind,
        rest_vertices=rest,
        template_points=rest,
        body_vertices=among[nearest].astype(np.int32),
        faces=layer.faces,
    )


def all_template_points(layers: list[ClothingLayer]) -> Float32[np.ndarray, "vertices 3"]:
    """The places of all layers, one after the other."""
    return np.concatenate([layer.template_points for layer in layers]).astype(np.float32)
