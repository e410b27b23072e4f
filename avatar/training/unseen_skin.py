"""Skin that no frame shows looks like skin that frames show: mirrored, or the same garment's.

Rays say nothing about the side that was never filmed. There each canonical point is given a source,
a point whose color and density it is drawn to as far as it is unseen and the source is seen:

1. the mirrored point on the other side of the body (people are symmetric);
2. the point in front of, or behind, the limb's bone, on the same garment (but never a face);
3. the nearest point around the limb at the same height, so that stripes go round.

The source of a patch is the candidate of the least cost: the distance to it, in which lengths along
the bone count more than those around it, a cost of each kind of reflection, and one of candidates
that were seen obliquely: the outline, which lies nearest to the unseen side, is stained most.

What the front shows, but not the outline at its height, as a print or a neckline, is not likely to
go round: pairs are drawn to the skin around the limb as far as its color is more common there.
Necklines lie higher behind than in front, and the torso's two faces correspond accordingly.

A face that was seen from one side alone could have any depth; it is kept near the body model's.

Which skin frames show, how squarely and from how many sides is kept by patch, a seed of the rig
about 2 cm wide. This evidence only grows, costs a millisecond a frame, and needs no image but the
frame's mask.
"""

from dataclasses import replace
from typing import NamedTuple, final

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int, Int64
from scipy.sparse import coo_array
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist
from torch import Tensor

from avatar.rig import CLOTHING_BAND_M, HEAD_PART, Rig
from avatar.training.frame_stream import TrainingFrame
from preprocess.body.body_surface import visible_points
from preprocess.body.kinematics import body_from_rest

BONE_OF_PART = (
    (0, 12), (1, 4), (2, 5), (4, 7), (5, 8), (7, 10), (8, 11), (12, 15), (16, 18), (17, 19),
    (18, 20), (19, 21), (20, 22), (21, 23),
)  # fmt: skip
"""Joints at both ends of each body part's bone."""
MIRRORED_PART = np.array([0, 2, 1, 4, 3, 6, 5, 7, 9, 8, 11, 10, 13, 12])
"""The part on the other side of the body."""
TORSO = 0
HEAD, FEET = HEAD_PART, (5, 6)
"""Parts whose front and back are not alike."""
NEAR_SKIN_M = 0.025
"""Distance from the skin within which most surfaces lie, metres."""
MIN_WEIGHT = 0.02
"""Weight below which a patch is left to its rays."""


STEPS_PER_DRAW = 64
"""Steps whose pairs are drawn at once, which takes a tenth of the time."""
DrawnPairs = tuple[
    Float32[np.ndarray, "pairs 3"], Float32[np.ndarray, "pairs 3"], Float32[np.ndarray, "pairs"]
]
"""Points, their sources, and the weight of each pair."""
MIN_PERSON_ALPHA = 127
"""Alpha of 255 above which a pixel shows the person."""
UNSEEN_COSINE, SEEN_COSINE = 0.1, 0.4
"""Cosines between normal and view direction up to which a patch counts as not seen (84°), and from
which it counts as seen (66°)."""


@final
class SkinEvidence:
    """How each patch of a rig's skin was seen; less near the person's outline.

    Attributes:
        cosines: Largest cosine at which it was seen, in [0, 1]; 0 if it never was.
        seen_frames: Number of frames that showed it squarely; an oblique view counts less.
        frame_count: Number of all frames.
        color_sums: Sums of its colors in the frames times their cosines, and of these.
    """

    cosines: Float32[np.ndarray, "seeds"]
    seen_frames: Float32[np.ndarray, "seeds"]
    frame_count: int
    color_sums: Float32[np.ndarray, "seeds 4"]

    def __init__(self, rig: Rig) -> None:
        """Starts with every patch unseen."""
        self._rig = rig
        self._weights = rig.weights_at(rig.seeds)
        self.cosines = np.zeros(len(rig.seeds), dtype=np.float32)
        self._direction_sums, self._frames = np.zeros((len(rig.seeds), 3)), np.zeros(len(rig.seeds))
        self.seen_frames, self.frame_count = np.zeros(len(rig.seeds), dtype=np.float32), 0
        self.color_sums = np.zeros((len(rig.seeds), 4), dtype=np.float32)

    def add(self, frame: TrainingFrame) -> None:
        """Takes in what a frame shows: patches that face the camera, unoccluded, in the mask."""
        blends = self._rig.body_from_canonical(frame.pose.joint_rotations)[:, :3].reshape(24, 12)
        blends = (self._weights @ blends.astype(np.float32)).reshape(-1, 3, 4)
        points = np.einsum("pab,pb->pa", blends[..., :3], self._rig.seeds) + blends[..., 3]
        normals = np.einsum("pab,pb->pa", blends[..., :3], self._rig.seed_normals)
        to_camera = frame.origin - points
        cosines = np.einsum("pa,pa->p", to_camera, normals) / np.maximum(
            np.linalg.norm(to_camera, axis=1) * np.linalg.norm(normals, axis=1), 1e-9
        )
        in_camera = -to_camera @ frame.body_from_camera
        depths = in_camera[:, 2]
        if depths.min() <= 0.0:  # a person behind the camera is not in the image either
            return
        plane = in_camera[:, :2] / depths[:, None] * depths.mean()
        # a cell around a limb: clothes and errors of the pose may hide what is behind
        shown = visible_points(plane, depths, cosines, margin_cells=1)
        within, colors = _pixels_of(in_camera, frame)
        shown &= within > 0.0
        # a video has one color for each 2 x 2 pixels, and smears it: the background's up to 0.5
        cosines = cosines * _smooth_step(within, 0.5, 3.0)
        cosines = np.where(shown, cosines, 0.0)
        np.maximum(self.cosines, cosines, out=self.cosines)
        self.seen_frames += _smooth_step(cosines, UNSEEN_COSINE, SEEN_COSINE)
        self.frame_count += 1
        self.color_sums += cosines[:, None] * np.column_stack([colors, np.ones(len(colors))])
        canonical = np.einsum("pab,pa->pb", blends[..., :3], to_camera)
        canonical /= np.maximum(np.linalg.norm(canonical, axis=1, keepdims=True), 1e-9)
        self._direction_sums += shown[:, None] * canonical
        self._frames += shown

    @property
    def seen(self) -> Float32[np.ndarray, "seeds"]:
        """Degree to which each patch was seen, in [0, 1]: smooth steps of its cosine and share."""
        shares = self.seen_frames / max(self.frame_count, 1)
        squarely = _smooth_step(self.cosines, UNSEEN_COSINE, SEEN_COSINE)
        # of all frames: in a few a tracker may turn the person round
        return squarely * _smooth_step(shares, 0.0, 0.03)

    @property
    def colors(self) -> Float32[np.ndarray, "seeds 3"]:
        """Mean color of each patch in the frames, in [0, 1]; black where it was never seen."""
        return self.color_sums[:, :3] / np.maximum(self.color_sums[:, 3:], 1e-6)

    @property
    def depth_known(self) -> Float32[np.ndarray, "seeds"]:
        """Degree to which each patch was seen from several sides, in [0, 1].

        From one side alone, a surface at any depth shows the same pictures.
        """
        length = np.linalg.norm(self._direction_sums, axis=1) / np.maximum(self._frames, 1.0)
        spread = np.sqrt(np.clip(2.0 - 2.0 * length, 0.0, 2.0)) * (self._frames > 0.0)
        return _smooth_step(spread, 0.3, 0.8)  # radians: a sixth of a turn, and a whole one


def _smooth_step(
    values: Float[np.ndarray, "*shape"] | Float32[np.ndarray, "*shape"], low: float, high: float
) -> Float32[np.ndarray, "*shape"]:
    """0 up to `low`, 1 from `high` on, without a corner."""
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    return (share * share * (3.0 - 2.0 * share)).astype(np.float32)


def _pixels_of(
    in_camera: Float[np.ndarray, "points 3"], frame: TrainingFrame
) -> tuple[Float32[np.ndarray, "points"], Float32[np.ndarray, "points 3"]]:
    """Distance of points in camera axes to the outline, pixels; 0 beside the person; and colors."""
    camera = replace(frame.view.camera, camera_from_world=np.eye(4))
    width, height = camera.size_px
    column, row = np.floor(camera.project(in_camera)).astype(np.int64).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    picture = np.zeros((height, width, 4), dtype=np.uint8)
    picture[frame.view.near_person()] = frame.colors
    is_person = (picture[..., 3] > MIN_PERSON_ALPHA).astype(np.uint8)
    distances = cv2.distanceTransform(is_person, cv2.DIST_L2, 3).reshape(-1)
    at = (row * width + column) * inside
    colors = picture.reshape(-1, 4)[at, :3].astype(np.float32) / 255.0
    return np.where(inside, distances[at], 0.0), colors


class Sources(NamedTuple):
    """The source of each patch's color and density.

    Attributes:
        reflection: 0: none, the source lies around the limb; 1: mirrored; 2: the limb's other face;
            3: both.
        weight: How strongly the patch is drawn to its source, in [0, 1].
        around: The source around the limb at the same height; -1: none.
        around_share: Share of pairs, in [0, 1], that are drawn to that one instead.
    """

    patch: Int[np.ndarray, "seeds"]
    reflection: Int[np.ndarray, "seeds"]
    weight: Float32[np.ndarray, "seeds"]
    around: Int[np.ndarray, "seeds"]
    around_share: Float32[np.ndarray, "seeds"]


class SourcePairs(NamedTuple):
    """Points of unseen skin, then their sources, and the weight of each pair, in [0, 1]."""

    points: Float32[Tensor, "points 3"]
    weights: Float32[Tensor, "pairs"]

    @classmethod
    def none(cls) -> "SourcePairs":
        """No pairs."""
        return cls(torch.empty(0, 3), torch.empty(0))


class FaceCells(NamedTuple):
    """Flat indices of cells before a face, which are empty, and under its skin, which are solid."""

    before: Int64[Tensor, "before"]
    under: Int64[Tensor, "under"]


class _BoneFrames(NamedTuple):
    """Origin and axes (forward, sideways, along the bone) of each part, canonical."""

    origin: Float[np.ndarray, "14 3"]
    axes: Float[np.ndarray, "14 3 3"]

    @classmethod
    def of(cls, rig: Rig) -> "_BoneFrames":
        """The frames of a rig's bones; forward is as near to the chest's as the bone allows."""
        transforms = body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
        joints = np.einsum("jab,jb->ja", transforms[:, :3, :3], rig.rest_joints)
        joints += transforms[:, :3, 3]
        start, end = joints[np.array(BONE_OF_PART)].transpose(1, 0, 2)
        along = end - start
        along[HEAD] = (0.0, 1.0, 0.0)
        along[list(FEET)] = (0.0, 1.0, 0.0)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        forward = np.array([0.0, 0.0, 1.0]) - along[:, 2:] * along
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        axes = np.stack([forward, np.cross(along, forward), along], axis=1)
        return cls(start, axes)

    def to_bone(
        self, points: Float[np.ndarray, "points 3"], parts: Int[np.ndarray, "points"]
    ) -> Float[np.ndarray, "points 3"]:
        return np.einsum("pab,pb->pa", self.axes[parts], points - self.origin[parts])

    def from_bone(
        self, points: Float[np.ndarray, "points 3"], parts: Int[np.ndarray, "points"]
    ) -> Float[np.ndarray, "points 3"]:
        return np.einsum("pba,pb->pa", self.axes[parts], points) + self.origin[parts]


@final
class UnseenSkin:
    """Random points of unseen skin, and their sources as of the last update."""

    def __init__(self, rig: Rig) -> None:
        """Starts with everything unseen, and so without any source."""
        self.evidence = SkinEvidence(rig)
        self._rig, self._frames = rig, _BoneFrames.of(rig)
        # left and right hips, knees, shoulders, elbows
        sides = rig.rest_joints[np.array([(1, 2), (4, 5), (16, 17), (18, 19)])][..., 0]
        self._middle_x = float(sides.mean())
        self._cells, self._shape = rig.clothing_cells, rig.skin_distance.shape
        self._seed_of_cell = np.full(rig.skin_distance.size, -1, dtype=np.int32)
        self._seed_of_cell[self._cells] = rig.seed_of_clothing_cell
        # rays see the space around a lone patch, as the fold of an ear, and know it to be empty
        one, other = KDTree(rig.seeds).query_pairs(0.06, output_type="ndarray").T
        links = np.concatenate([one, other]), np.concatenate([other, one])
        shape = (len(rig.seeds), len(rig.seeds))
        self._neighbors = coo_array((np.ones(len(links[0])), links), shape=shape).tocsr()
        self._neighbor_counts = self._neighbors.sum(axis=1) + 1.0
        self.sources: Sources | None = None
        self._is_stale, self._unseen_share = True, 0.0
        self._drawn_from = self._cells[:0]
        none = np.zeros((0, 3), dtype=np.float32)
        self._drawn: DrawnPairs = none, none, none[:, 0]
        self._count = self._steps = 0

    def add(self, frame: TrainingFrame) -> None:
        """Takes in what a frame shows; sources follow at the next `update`."""
        self.evidence.add(frame)
        self._is_stale = True

    def update(self) -> bool:
        """Finds the sources again, if frames have been added since; returns whether they have."""
        if not self._is_stale:
            return False
        found = find_sources(self._rig, self._frames, self.evidence, self._middle_x)
        around = (self._neighbors @ found.weight + found.weight) / self._neighbor_counts
        self.sources = found._replace(weight=(found.weight * around).astype(np.float32))
        weights = self.sources.weight[self._seed_of_cell[self._cells]]
        drawn = self._cells[weights > MIN_WEIGHT]
        near = drawn[self._rig.skin_distance.reshape(-1)[drawn] < NEAR_SKIN_M]
        self._drawn_from = np.concatenate([drawn, *[near] * 3])  # those four times as often
        self._unseen_share = len(drawn) / len(self._cells)
        self._is_stale, self._steps = False, 0
        return True

    def face_cells(self, strength: float) -> FaceCells:
        """Cells before and under the skin of a face, as far as its depth is unknown.

        `strength` is the share, in [0, 1], by which the body's face is to be believed.
        """
        rig, seed = self._rig, self._seed_of_cell[self._cells]
        unknown = (strength * _faces(self._frames, rig) * (1.0 - self.evidence.depth_known))[seed]
        distance = rig.skin_distance.reshape(-1)[self._cells]
        is_inside = rig.inside_skin.reshape(-1)[self._cells]
        reach = CLOTHING_BAND_M + (0.008 - CLOTHING_BAND_M) * unknown
        least, most = 0.005, 0.03  # metres
        is_solid = is_inside & (least < distance) & (distance < most * unknown)
        return FaceCells(
            torch.from_numpy(self._cells[~is_inside & (distance > reach)]),
            torch.from_numpy(self._cells[is_solid]),
        )

    def sample(self, count: int, generator: torch.Generator) -> SourcePairs:
        """Random points of unseen skin with their sources: of `count` the share that is unseen."""
        count = round(count * self._unseen_share)
        if self.sources is None or not count:
            return SourcePairs.none()
        turn = self._steps % STEPS_PER_DRAW
        if turn == 0 or count != self._count:
            turn, self._count = 0, count
            self._drawn = self._draw(STEPS_PER_DRAW * count, generator)
        self._steps = turn + 1
        points, sources, weights = (numbers[turn::STEPS_PER_DRAW] for numbers in self._drawn)
        pairs = np.concatenate([points, sources])
        return SourcePairs(torch.from_numpy(pairs), torch.from_numpy(weights.copy()))

    def _draw(self, count: int, generator: torch.Generator) -> DrawnPairs:
        """Points of unseen skin, those of their sources that lie near the skin, and weights."""
        assert self.sources is not None
        drawn = torch.randint(len(self._drawn_from), (count,), generator=generator)
        within = torch.rand(count, 3, generator=generator).numpy()
        cells = self._drawn_from[drawn.numpy()]
        corner = np.stack(np.unravel_index(cells, self._shape), axis=1)
        points = (self._rig.box_low + (corner + within) / self._rig.cells_per_m).astype(np.float32)
        seeds = self._seed_of_cell[cells]
        is_around = (
            torch.rand(count, generator=generator).numpy() < self.sources.around_share[seeds]
        )
        sources, is_near = self._source_points(points, seeds, is_around)
        return points[is_near], sources[is_near], self.sources.weight[seeds[is_near]]

    def _source_points(
        self,
        points: Float32[np.ndarray, "points 3"],
        seeds: Int[np.ndarray, "points"],
        is_around: Bool[np.ndarray, "points"],
    ) -> tuple[Float32[np.ndarray, "points 3"], Bool[np.ndarray, "points"]]:
        """The sources of points, and whether they lie near the skin."""
        assert self.sources is not None
        rig, normals = self._rig, self._rig.seed_normals[seeds]
        target = np.where(is_around, self.sources.around[seeds], self.sources.patch[seeds])
        reflection = np.where(is_around, 0, self.sources.reflection[seeds])
        heights = ((points - rig.seeds[seeds]) * normals).sum(axis=1)
        parts = rig.seed_parts[seeds]
        at = reflect(self._frames, points, parts, reflection, self._middle_x)
        landed = np.where(reflection > 0, self._seed_at(at), target)
        found = landed >= 0
        normal, place = rig.seed_normals[landed], rig.seeds[landed]
        lift = heights - ((at - place) * normal).sum(axis=1)
        along = self._frames.axes[rig.seed_parts[target], 2]
        # a head's source keeps its height, from which hair hangs down
        start = np.where((parts == HEAD)[:, None], rig.seeds[seeds], place)
        slide = ((points - start) * along).sum(axis=1, keepdims=True) * along
        around = place + slide + heights[:, None] * normal
        there = np.where(
            np.isin(reflection, (2, 3))[:, None],
            at + lift[:, None] * normal,
            np.where((reflection == 1)[:, None], at, around),
        )
        return there.astype(np.float32), found

    def _seed_at(self, points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, "points"]:
        """The seed nearest to each point; -1 far from the skin."""
        cell = np.floor((points - self._rig.box_low) * self._rig.cells_per_m).astype(np.int64)
        inside = ((cell >= 0) & (cell < np.array(self._shape))).all(axis=1)
        flat = np.ravel_multi_index(tuple(np.where(inside, cell.T, 0)), self._shape)
        return np.where(inside, self._seed_of_cell[flat], -1)


def reflect(
    frames: _BoneFrames,
    points: Float[np.ndarray, "points 3"],
    parts: Int[np.ndarray, "points"],
    reflection: Int[np.ndarray, "points"],
    middle_x: float,
) -> Float[np.ndarray, "points 3"]:
    """Canonical points reflected as `Sources.reflection` says; the body's middle is `middle_x`."""
    mirrors, reverses = np.isin(reflection, (1, 3)), np.isin(reflection, (2, 3))
    local = frames.to_bone(points, parts)
    local[:, 2] += np.where(reverses, _neckline_lift(frames, local, parts), 0.0)
    local[:, 0] = np.where(reverses, -local[:, 0], local[:, 0])
    out = np.where(reverses[:, None], frames.from_bone(local, parts), points)
    out[:, 0] = np.where(mirrors, 2.0 * middle_x - out[:, 0], out[:, 0])
    return out


def _neckline_lift(
    frames: _BoneFrames, local: Float[np.ndarray, "points 3"], parts: Int[np.ndarray, "points"]
) -> Float[np.ndarray, "points"]:
    """How much higher a point of the torso lies once it is on the other face, metres.

    The slope is the mean of those at both heights, so that a point comes back to where it was.
    """
    neck = float(np.linalg.norm(frames.origin[HEAD] - frames.origin[TORSO]))
    depth = np.where(parts == TORSO, 2.0 * local[:, 0], 0.0)
    lift = np.zeros(len(local))
    for _ in range(3):
        slopes = _smooth_step(np.stack([local[:, 2], local[:, 2] + lift]), (1.0 - 0.4) * neck, neck)
        lift = 0.4 * depth * slopes.mean(axis=0)  # falls by 22° at the neck's base
    return lift


def find_sources(rig: Rig, frames: _BoneFrames, evidence: SkinEvidence, middle_x: float) -> Sources:
    """The source of each patch, by the least cost."""
    seen = evidence.seen
    parts = rig.seed_parts.astype(np.int64)
    best, cost = np.zeros(len(parts), dtype=np.int64), np.full(len(parts), np.inf)
    kind, around = np.zeros(len(parts), dtype=np.int64), np.full(len(parts), -1, dtype=np.int64)
    face = _faces(frames, rig)
    rarity = _rarity_at_outline(rig, frames, evidence)
    sources = np.flatnonzero(seen > 0.5)
    for reflection in range(4):
        places = reflect(
            frames, rig.seeds[sources], parts[sources], np.full(len(sources), reflection), middle_x
        )
        landed = MIRRORED_PART[parts[sources]] if reflection & 1 else parts[sources]
        # costs in metres around the limb: the mirrored side, the limb's other face, an oblique view
        extra = 0.03 * (reflection & 1) + 0.08 * (reflection >> 1)
        # hair comes from the crown, which a level camera sees obliquely
        clean = np.where(parts[sources] == HEAD, seen[sources], evidence.cosines[sources])
        extra = extra + 0.2 * (1.0 - clean)
        for part in range(len(BONE_OF_PART)):
            here = np.flatnonzero((parts == part) & (seen < 1.0))
            there = np.flatnonzero(landed == part)
            if not len(here) or not len(there) or (reflection > 1 and part in (HEAD, *FEET)):
                continue
            to = frames.to_bone(rig.seeds[here], parts[here])
            come = frames.to_bone(places[there], landed[there])
            # one array of threes would be slower: sums along its short axis
            away = [np.subtract.outer(to[:, k], come[:, k]) for k in range(3)]
            if part == HEAD:
                away[2] *= np.where(away[2] > 0.0, 3.0, 1.0)  # hair hangs down
            else:
                away[2] *= 4.0  # not of the head, whose hair comes from above
            costs = np.sqrt(away[0] ** 2 + away[1] ** 2 + away[2] ** 2) + extra[there]
            costs += np.maximum(0.0, face[sources[there]] - face[here][:, None])
            if reflection == 0:
                around_costs = costs + 0.1 * rarity[sources[there]]
                around_costs += 3.0 * np.abs(away[2])
                around[here] = sources[there[around_costs.argmin(axis=1)]]
            chosen = costs.argmin(axis=1)
            least = costs[np.arange(len(here)), chosen]
            better = least < cost[here]
            cost[here[better]] = least[better]
            best[here[better]] = sources[there[chosen[better]]]
            kind[here[better]] = reflection
    trust = np.clip(2.0 - 2.0 * cost / 0.6, 0.0, 1.0)
    weight = np.where(np.isfinite(cost), (1.0 - seen) * trust * seen[best], 0.0)
    rarer = np.maximum(rarity[best] - rarity[around], 0.0)
    share = np.where((kind > 1) & (around >= 0), 1.0 - np.exp(-rarer), 0.0)
    return Sources(best, kind, weight.astype(np.float32), around, share.astype(np.float32))


def _rarity_at_outline(
    rig: Rig, frames: _BoneFrames, evidence: SkinEvidence
) -> Float[np.ndarray, "seeds"]:
    """Minus the logarithm of the share of each patch's color at its limb's outline, at its height.

    The outline are patches that were seen obliquely; 0 on heads, and where it was not seen.
    """
    rarity = np.zeros(len(rig.seeds))
    outline = evidence.seen * (1.0 - evidence.cosines)
    for part in range(len(BONE_OF_PART)):
        here = np.flatnonzero((rig.seed_parts == part) & (evidence.seen > 0.0))
        if part == HEAD or not len(here):
            continue
        height = frames.to_bone(rig.seeds[here], rig.seed_parts[here])[:, 2] / 0.08  # metres
        near = np.exp(-0.5 * np.subtract.outer(height, height) ** 2) * outline[here]
        apart = cdist(evidence.colors[here], evidence.colors[here], "sqeuclidean")
        alike = (near * np.exp(-0.5 / 0.12**2 * apart)).sum(axis=1)
        share = (alike + 1e-6) / (near.sum(axis=1) + 1e-6)
        rarity[here] = -np.log(np.maximum(share, 0.02))
    return rarity


def _faces(frames: _BoneFrames, rig: Rig) -> Float[np.ndarray, "seeds"]:
    """Degree to which patches belong to a face with ears, chin and throat, in [0, 1]."""
    forward, aside, height = frames.to_bone(rig.seeds, rig.seed_parts).T
    head = rig.seed_parts == HEAD
    if not head.any():
        return np.zeros(len(head))
    forward = (forward - forward[head].min()) / np.ptp(forward[head])
    height = height / height[head].max()
    behind = np.where(height > 0.3, 0.33, 0.5)  # ears and throat end there, from the back
    middle = 1.0 - (aside / np.abs(aside[head]).max()) ** 2
    # heights as shares of the head's: the neck ends at 0.3; hair covers what is above the line
    hairline = np.interp(forward * middle, (0.0, 1.0), (0.7, 0.92))
    below = np.clip((hairline - height) / 0.2, 0.0, 1.0)
    return np.where(head & (forward > behind), below, 0.0)
