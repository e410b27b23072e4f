"""The player's picture in numpy: the reference that the ONNX graph is checked against.

    traced = trace_picture(tables, codes, settings, inputs)         # rays, as segments of samples
    colors = composite_segments(traced.segments, settings, tables.bricks, codes)

It is written from the tables and the settings alone, with arrays of vectors, and shares no code
with the graph; its rays are composited as those that the graph traces are.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64

from baselines.reference_geometry import (
    EMPTY_PIXEL_KEY,
    CanonicalRays,
    SurfelFootprints,
    append_layer,
    compression_factor,
    fill_holes,
    first_layer_segments,
    further_layer_segments,
    invert_jacobians,
    surfel_of_key,
    z_buffer,
)
from baselines.reference_skinning import (
    MIN_VOLUME,
    PosedNodes,
    invert_matrices,
    skin_tetrahedral,
    skin_trilinear,
)
from capture.camera import Camera
from export.bake.compositor import VoxelCodes, composite_segments, draw_traced
from export.bake.traced_rays import TracedPicture
from export.package.player_tables import (
    DEPTH_CODES,
    HOLE_SPACINGS,
    MAX_TRUSTED_COMPRESSION,
    MIN_FOOTPRINT_PX,
    SURFEL_BITS,
    PlayerTables,
    RenderSettings,
)
from export.player_inputs import skinning_nodes


@dataclass(frozen=True, eq=False, kw_only=True)
class PlayerInputs:
    """Inputs of the graph besides the tables.

    Attributes:
        bones: Camera-from-canonical matrices.
        focal, center, size_px: Pixels, (x, y).
        samples: Density samples along `RenderSettings.sample_span_m` of each ray.
    """

    bones: Float32[np.ndarray, "24 3 4"]
    focal: Float32[np.ndarray, "2"]
    center: Float32[np.ndarray, "2"]
    size_px: tuple[int, int]
    samples: int

    @classmethod
    def of(
        cls, bones: Float32[np.ndarray, "24 3 4"], camera: Camera, samples: int
    ) -> "PlayerInputs":
        """The inputs for a camera's lens and size."""
        return cls(
            bones=bones,
            focal=np.array(camera.focal_px, dtype=np.float32),
            center=np.array(camera.center_px, dtype=np.float32),
            size_px=camera.size_px,
            samples=samples,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _PosedSurface:
    """Skinning nodes and, linear in tetrahedra, surfels in the camera's frame, metres.

    Attributes:
        facing: Canonical ray to each surfel times its normal; negative where it faces the camera.
    """

    nodes: PosedNodes
    positions: Float32[np.ndarray, "surfels 3"]
    facing: Float32[np.ndarray, "surfels"]


@dataclass(eq=False, kw_only=True)
class _FrontLayer:
    """State of covered pixels after the layers so far, which the next layer depends on.

    Attributes:
        depth: Depth at which the last ray entered the surface, metres.
        end: End of the last ray, metres along it.
    """

    transmittance: Float32[np.ndarray, "pixels"]
    depth: Float32[np.ndarray, "pixels"]
    end: Float32[np.ndarray, "pixels"]
    surfel: Int64[np.ndarray, "pixels"]

    def of(self, ray: Int64[np.ndarray, "rays"]) -> "_FrontLayer":
        """Select some pixels."""
        return _FrontLayer(
            transmittance=self.transmittance[ray],
            depth=self.depth[ray],
            end=self.end[ray],
            surfel=self.surfel[ray],
        )


def draw_reference(
    tables: PlayerTables, settings: RenderSettings, inputs: PlayerInputs
) -> Float32[np.ndarray, "height width 4"]:
    """Return premultiplied color and alpha in [0, 1]."""
    traced = trace_picture(tables, VoxelCodes.of(tables.bricks), settings, inputs)
    return draw_traced(traced, tables, settings, inputs.size_px)


def trace_picture(
    tables: PlayerTables, codes: VoxelCodes, settings: RenderSettings, inputs: PlayerInputs
) -> TracedPicture:
    """Find the segments of all layers' rays.

    Pixels have further layers where `codes`, of the voxels of `tables.bricks`, let light pass.
    """
    posed = _pose_surface(tables, settings, inputs)
    splats = _splat_surfels(tables, settings, inputs, posed)
    buffer = z_buffer(inputs.size_px, splats)
    filled = fill_holes(buffer, tables.reach_m, settings, splats).ravel()
    covered = np.flatnonzero(filled < EMPTY_PIXEL_KEY)
    key = filled[covered]
    close_up = splats.side >= MIN_FOOTPRINT_PX
    rays, depth, doubtful = _ray_entries(
        tables, settings, inputs, posed, covered, key, None, close_up
    )
    blocks = replace(
        settings,
        uniform_blocks=settings.uniform_blocks + close_up,
        max_blocks=settings.max_blocks + close_up,
    )
    segments = first_layer_segments(rays, posed.nodes, tables.bricks, blocks, inputs.samples)
    alpha = composite_segments(segments, settings, tables.bricks, codes)[:, 3]
    front = _FrontLayer(
        transmittance=1.0 - alpha, depth=depth, end=rays.end.copy(), surfel=surfel_of_key(key)
    )
    passed = front.transmittance > settings.layer_min_transmittance
    alive = np.arange(len(covered))
    for layer in range(1, settings.layers):
        alive = alive[front.transmittance[alive] > settings.layer_min_transmittance]
        key = _keys_behind(tables, settings, inputs, posed, splats, covered[alive], front.of(alive))
        key = key[covered]
        alive = np.flatnonzero(key < EMPTY_PIXEL_KEY)
        rays, depth, _ = _ray_entries(
            tables, settings, inputs, posed, covered[alive], key[alive], front.of(alive), close_up
        )
        behind = further_layer_segments(
            rays, alive, len(covered), tables.bricks, (settings.further_layer_samples, layer)
        )
        alpha = composite_segments(behind, settings, tables.bricks, codes)[:, 3]
        front.transmittance *= 1.0 - alpha
        front.depth[alive], front.end[alive] = depth, rays.end
        front.surfel[alive] = surfel_of_key(key[alive])
        segments = append_layer(segments, behind)
    return TracedPicture(covered, segments, doubtful, passed, splats.side)


def _keys_behind(
    tables: PlayerTables,
    settings: RenderSettings,
    inputs: PlayerInputs,
    posed: _PosedSurface,
    splats: SurfelFootprints,
    pixel: Int64[np.ndarray, "pixels"],
    front: _FrontLayer,
) -> Int64[np.ndarray, "all_pixels"]:
    """Return every pixel's key in a z-buffer of surfels far enough behind the layer in front."""
    (width, height), margin = inputs.size_px, splats.margin
    limit = np.full((height, width), 1e6, dtype=np.float32)
    limit.reshape(-1)[pixel] = front.depth + np.float32(settings.layer_gap_m)
    limits = np.pad(limit, margin, constant_values=1e6).reshape(-1)[splats.cell]
    behind = splats.depth > limits
    if settings.other_sheet_gap_m < settings.layer_gap_m:
        passed = np.zeros((height, width), dtype=np.int64)
        passed.reshape(-1)[pixel] = front.surfel
        limits -= np.float32(settings.layer_gap_m - settings.other_sheet_gap_m)
        near = np.flatnonzero(~behind & (splats.depth > limits))
        before = np.pad(passed, margin).reshape(-1)[splats.cell[near]]
        behind[near] = ~_one_sheet(
            settings, tables, posed.positions, surfel_of_key(splats.key[near]), before
        )
    return z_buffer(inputs.size_px, splats, behind)[margin:-margin, margin:-margin].ravel()


def _one_sheet(
    settings: RenderSettings,
    tables: PlayerTables,
    camera: Float32[np.ndarray, "surfels 3"],
    one: Int64[np.ndarray, "pairs"],
    other: Int64[np.ndarray, "pairs"],
) -> Bool[np.ndarray, "pairs"]:
    """Tell which pairs of surfels are about as close in canonical space as they are posed."""
    places = tables.surfels.positions
    apart = np.linalg.norm(places[one] - places[other], axis=1)
    posed = np.linalg.norm(camera[one] - camera[other], axis=1)
    return apart < posed * settings.same_sheet_ratio + settings.same_sheet_m


def _pose_surface(
    tables: PlayerTables, settings: RenderSettings, inputs: PlayerInputs
) -> _PosedSurface:
    nodes = skinning_nodes(tables.skinning, settings.skinning_subdivision)
    blended = (nodes.weights.T @ inputs.bones.reshape(24, 12)).reshape(-1, 3, 4)
    node_camera = np.einsum("nij,nj->ni", blended[:, :, :3], nodes.positions) + blended[:, :, 3]
    there = PosedNodes(nodes, node_camera)
    splatted, edges = skin_tetrahedral(there, tables.surfels.positions)
    inverse, volume = invert_matrices(edges)
    flat = np.abs(volume) < MIN_VOLUME
    from_eye = np.einsum("nij,nj->ni", inverse, splatted)
    facing = np.einsum("ni,ni->n", tables.surfels.normals, from_eye)
    return _PosedSurface(
        nodes=there, positions=splatted, facing=np.where(flat, 0.0, facing).astype(np.float32)
    )


def _project_surfels(
    settings: RenderSettings, inputs: PlayerInputs, posed: _PosedSurface, reach: float
) -> tuple[Float32[np.ndarray, "surfels 2"], Bool[np.ndarray, "surfels"]]:
    """Project surfels; tell which are at most `reach` pixels outside the picture."""
    depth = posed.positions[:, 2]
    safe = np.maximum(depth, np.float32(settings.near_plane_m))[:, None]
    place = posed.positions[:, :2] / safe * inputs.focal + inputs.center
    within = (place > -reach).all(axis=1) & (place < np.array(inputs.size_px) + reach).all(axis=1)
    return place, within & (depth > settings.near_plane_m)


def _spacing_px(
    tables: PlayerTables, settings: RenderSettings, inputs: PlayerInputs, posed: _PosedSurface
) -> float:
    """Return about a surfel spacing where they are nearest, pixels."""
    _, near = _project_surfels(settings, inputs, posed, 0.5 * settings.max_footprint_px)
    if not near.any():
        return 0.0
    spacing_px = inputs.focal.max() * tables.surfels.spacing_m / posed.positions[near, 2].min()
    return float(spacing_px * settings.footprint_spacings)


def _splat_surfels(
    tables: PlayerTables, settings: RenderSettings, inputs: PlayerInputs, posed: _PosedSurface
) -> SurfelFootprints:
    spacing_px = _spacing_px(tables, settings, inputs, posed)
    side = int(np.clip(np.floor(spacing_px + 0.999), 2, settings.max_footprint_px))
    width, height = inputs.size_px
    place, seen = _project_surfels(settings, inputs, posed, 0.5 * side)
    surfel = np.flatnonzero(seen)
    depth, place = posed.positions[surfel, 2], place[surfel]
    faces = posed.facing[surfel] < -depth * settings.min_facing_cosine
    near = inputs.bones[0, 2, :3] @ tables.pelvis + inputs.bones[0, 2, 3] - tables.reach_m
    code = (depth - near) / (2.0 * tables.reach_m) * (DEPTH_CODES - 1)
    code = np.clip(code, 0, DEPTH_CODES - 1).astype(np.int64)
    key = (code << SURFEL_BITS) | surfel
    deep_enough = np.where(faces, depth, np.float32(0.0))

    first = np.floor(place - np.float32((side - 1) / 2)).astype(np.int64)
    steps = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 1, 2)
    margin = HOLE_SPACINGS[-1] * side
    column, row = np.moveaxis(first + steps + margin, -1, 0)
    rows, columns = height + 2 * margin, width + 2 * margin
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    shape = inside.shape
    cell = (row * columns + column)[inside]
    key, depth = (np.broadcast_to(part, shape)[inside] for part in (key, deep_enough))
    return SurfelFootprints(spacing_px, side, cell, key, depth)


def _ray_entries(
    tables: PlayerTables,
    settings: RenderSettings,
    inputs: PlayerInputs,
    posed: _PosedSurface,
    pixel: Int64[np.ndarray, "pixels"],
    key: Int64[np.ndarray, "pixels"],
    front: _FrontLayer | None,
    close_up: bool,
) -> tuple[CanonicalRays, Float32[np.ndarray, "pixels"], Bool[np.ndarray, "pixels"]]:
    """Return canonical rays of covered pixels, where they enter (depth), and which are doubtful."""
    surfels, surfel = tables.surfels, surfel_of_key(key)
    row, column = np.divmod(pixel, inputs.size_px[0])
    plane = (np.stack([column, row], axis=1) + 0.5 - inputs.center) / inputs.focal
    ray = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    ray = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).astype(np.float32)

    normal, thickness = surfels.normals[surfel], surfels.thickness[surfel]
    camera, derivative = skin_trilinear(posed.nodes, surfels.positions[surfel])
    inverse, trusted = invert_jacobians(settings, derivative)
    along = (camera * ray).sum(axis=1)
    direction = np.einsum("nij,nj->ni", inverse, ray)
    if close_up:
        trusted &= (direction**2).sum(axis=1) <= MAX_TRUSTED_COMPRESSION**2
    # where the skin is folded or compressed, look along its normal
    direction = np.where(trusted[:, None], direction, -normal)
    nearest = ray * along[:, None] - camera
    beside = np.einsum("nij,nj->ni", inverse, nearest)  # from the surfel to the ray
    beside = np.where(trusted[:, None], beside, np.float32(0.0))
    falling = (normal * direction).sum(axis=1)
    behind = falling > 0.0
    shallow = np.float32(-0.5 * settings.min_cosine)
    hit = -(normal * beside).sum(axis=1) / np.minimum(falling, shallow)
    hit = np.where(falling < shallow, hit, 0.0)
    enter = along + np.clip(hit, -settings.max_entry_shift_m, settings.max_entry_shift_m)
    cosine = np.maximum(-falling, settings.min_cosine)
    most_lead = settings.max_entry_margin_m * compression_factor(settings, direction)
    # from behind, a ray has come through the body
    lead = np.where(behind, most_lead, np.minimum(settings.entry_margin_m / cosine, most_lead))
    begin = enter - lead
    sine = 1.0 - falling**2 / (direction**2).sum(axis=1)
    bent = np.minimum(cosine, np.float32(settings.max_compression))
    length = thickness * np.minimum(
        (1.0 + settings.grazing_factor * sine) / bent, settings.max_lengthening
    )
    end = begin + np.minimum(length + lead, settings.max_segment_m)
    if front is not None:
        first = surfels.positions[front.surfel]
        apart = np.linalg.norm(surfels.positions[surfel] - first, axis=1)
        in_camera = np.linalg.norm(camera - skin_trilinear(posed.nodes, first)[0], axis=1)
        one_sheet = apart < in_camera * settings.same_sheet_ratio + settings.same_sheet_m
        later = np.minimum(np.maximum(begin, front.end), end)
        begin = np.where(one_sheet, later, begin)
    start = surfels.positions[surfel] + beside + (begin - along)[:, None] * direction
    rays = CanonicalRays(*(part.astype(np.float32) for part in (ray, begin, end, start, direction)))
    return rays, (enter * ray[:, 2]).astype(np.float32), ~trusted | behind
