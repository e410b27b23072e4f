"""Rays as the player's own graph traces them: where each of a picture's pixels reads the bricks.

tracer = RayTracer(tables, settings)
traced = tracer.trace(bones, camera)
colors = composite_segments(traced.segments, settings, tables.bricks, codes)
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64

from capture.camera import Camera
from export.graph.player_graph import TRACE_OUTPUTS, build_trace_graph
from export.package.player_tables import (
    MAX_MEDIAN_DIFFERENCE,
    MIN_FOOTPRINT_PX,
    MIN_MEDIAN_ALPHA,
    PlayerTables,
    RenderSettings,
)
from export.player import create_session, find_provider
from export.player_inputs import graph_initializers, graph_inputs


@dataclass(frozen=True, eq=False, kw_only=True)
class RaySegments:
    """Blocks of equidistant samples along rays, each ray's in the order in which light passes them.

    Attributes:
        ray_offsets: First segment of each ray, and the number of segments.
        start: Begin of each segment, in voxels of the brick grid.
        slope: Voxels from one sample to the next.
        step_m: Metres from one sample to the next along the ray.
        layer: Depth layer, from 0.
    """

    ray_offsets: Int64[np.ndarray, "rays_and_one"]
    start: Float32[np.ndarray, "segments 3"]
    slope: Float32[np.ndarray, "segments 3"]
    step_m: Float32[np.ndarray, "segments"]
    count: Int32[np.ndarray, "segments"]
    layer: Int32[np.ndarray, "segments"]

    @property
    def num_rays(self) -> int:
        """Number of rays, with segments or without."""
        return len(self.ray_offsets) - 1

    @classmethod
    def concatenate(cls, many: "Sequence[RaySegments]") -> "RaySegments":
        """Concatenate the rays of several pictures."""
        offsets = np.cumsum([0, *(len(segments.step_m) for segments in many)])
        starts = [s.ray_offsets[:-1] + o for s, o in zip(many, offsets[:-1], strict=True)]
        names = [field.name for field in fields(cls) if field.name != "ray_offsets"]
        columns = {
            name: np.concatenate([getattr(segments, name) for segments in many]) for name in names
        }
        return cls(ray_offsets=np.concatenate([*starts, offsets[-1:]]), **columns)


class TracedPicture(NamedTuple):
    """Covered pixels of a picture, and where their rays sample the bricks.

    Attributes:
        pixel: Numbers of the covered pixels, ascending.
        doubtful: Whether the surfel that the pixel sees is folded, compressed along the ray or seen
            from behind.
        passed: Whether light passes the first layer, so that others are looked for.
    """

    pixel: Int64[np.ndarray, "pixels"]
    segments: RaySegments
    doubtful: Bool[np.ndarray, "pixels"]
    passed: Bool[np.ndarray, "pixels"]
    footprint_px: int


@final
class RayTracer:
    """Traces rays of one tier to their ends, as if none of the first layer ever became opaque.

    Pixels have further layers where the tables' own bricks let light pass. One tracer may be used
    by several threads at once.
    """

    def __init__(self, tables: PlayerTables, settings: RenderSettings) -> None:
        """Build the graph, and a session for it."""
        self._settings = settings
        # onnxruntime only borrows the arrays: they must live as long as the session
        self._borrowed = {
            name: array.tobytes() for name, array in graph_initializers(tables, settings).items()
        }
        graph = build_trace_graph(tables, settings).SerializeToString()
        self._session = create_session(
            graph, self._borrowed, 1, find_provider("cpu"), optimize=False
        )

    def trace(self, bones: Float32[np.ndarray, "24 3 4"], camera: Camera) -> TracedPicture:
        """Trace a picture of camera-from-canonical matrices."""
        inputs = graph_inputs(bones, camera, self._settings.samples)
        pixel, doubtful, passed, footprint_px, ray, layer, path = map(
            np.asarray, self._session.run(TRACE_OUTPUTS, inputs)
        )
        order = np.argsort(ray, kind="stable")
        layer, rows = layer[order], path.T[order]
        counts = self._settings.block_samples, self._settings.further_layer_samples
        segments = RaySegments(
            ray_offsets=np.searchsorted(ray[order], np.arange(len(pixel) + 1)).astype(np.int64),
            start=np.ascontiguousarray(rows[:, :3]),
            slope=np.ascontiguousarray(rows[:, 3:6]),
            step_m=np.ascontiguousarray(rows[:, 6]),
            count=np.where(layer == 0, *counts).astype(np.int32),
            layer=layer,
        )
        return TracedPicture(pixel.astype(np.int64), segments, doubtful, passed, int(footprint_px))


def filter_specks(
    picture: Float32[np.ndarray, "height width 4"], traced: TracedPicture
) -> Float32[np.ndarray, "height width 4"]:
    """Take the median of nine pixels, half a footprint apart, where the picture is unreliable.

    It replaces doubtful pixels, and those inside of the avatar whose ray passed the first layer and
    that differ from it: specks where sheets of skin cross.
    """
    half = traced.footprint_px // 2
    filtered, pixel = picture.reshape(-1, 4).copy(), traced.pixel
    bordered = np.pad(picture, ((half, half), (half, half), (0, 0)))
    row, column = np.divmod(pixel, picture.shape[1])
    steps = [(i * half, j * half) for i in range(3) for j in range(3)]
    median = np.median([bordered[row + i, column + j] for i, j in steps], axis=0)
    inside = median[:, 3] > MIN_MEDIAN_ALPHA
    differs = np.abs(median - filtered[pixel]).max(axis=1) > MAX_MEDIAN_DIFFERENCE
    speck = traced.passed & inside & differs & (traced.footprint_px >= MIN_FOOTPRINT_PX)
    chosen = traced.doubtful | speck
    filtered[pixel[chosen]] = median[chosen]
    return filtered.reshape(picture.shape)
