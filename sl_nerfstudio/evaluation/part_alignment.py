"""A result placed in a part's own axes without a start, and what of its place the shape leaves open.

Many starts are followed by ICP with few points, the best of them with more. Another place counts as equally good if the
surface fits there as well as at the best one; motions along which it keeps fitting (the turn of a cylinder about its
axis) are found from the directions in which the point-to-plane distances hardly change, and tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from sl_nerfstudio.evaluation.mesh_index import Closest, IndexedMesh, neighbours
from sl_nerfstudio.evaluation.reference import icp_step
from sl_nerfstudio.geometry.lie import AXIS_TURNS, Similarity
from sl_nerfstudio.meshing.mesh import Mesh

_STARTS = 120  # random orientations, besides those of the principal axes
_ROUNDS = ((200, 14, 48), (1000, 20, 24))  # points, ICP steps, places that are kept, with samples of the part
_POINTS, _LAST_STEPS = 3000, 20  # with the part itself
_SAMPLES = 10_000  # of the part
_BESIDE = 2.0  # spacings of the samples
_LIKELY, _SAME_FIT = 9.0, 0.002  # squared distances, relative to the best ones, and distance relative to the diagonal
_WIDEST = 0.03  # of the part's diagonal: greater distances count as this one
_FACING = 0.3  # cosine between normals, below which a point lies on another side of the part
_LEAST_FACING = 0.1  # share of the points; with fewer a place is not followed
_AT_EDGES = 0.02  # share of the points that may seem so, because they lie beside an edge
_SAME_TURN_DEG, _SAME_SHIFT = 3.0, 0.02  # places that are nearer (shift: of the diagonal) are the same one
_COMPOSED = 3  # symmetries that are composed with all others, and how often
_SMALL = 0.1  # of the diagonal: a result that need not move farther is in the part's axes already
_AS_GOOD = 1.1  # ratio of mean squared distances up to which two places fit equally well
_EXACT = 1e-5  # of the diagonal: smaller distances are rounding
_FITS = 0.01  # of the smaller diagonal: RMS distance up to which a result is a surface of the part
_WEAK = 0.03  # of the largest curvature of the distances: below, a motion is tried
_TRIED = ((0.17, 0.02), (-0.17, -0.02))  # motions along a weak direction: radian, or share of the diagonal
_SMOOTH_DEG = 30.0  # between neighbouring facets of one curved surface, at most
_MEAN_SAG = np.sqrt(8 / 15)  # RMS of a parabola's height, of its largest


@dataclass(frozen=True)
class OpenMotions:
    """Motions of the part after which the result fits as well as before; directions are unit vectors in its axes."""

    turns: Float64[ndarray, "t 3"]  # axes through `point`; three: every turn about it
    shifts: Float64[ndarray, "s 3"]
    point: Float64[ndarray, "3"]

    def __bool__(self) -> bool:
        """Whether there are any."""
        return len(self.turns) + len(self.shifts) > 0


@dataclass(frozen=True)
class PartAlignment:
    """Where a result lies in a part's axes; lengths in the part's unit."""

    S_part_result: Similarity
    in_place: bool  # the result lies there in its own axes, to within a small motion
    rms: float  # of the nearest 80 % of the result
    size: float  # diagonal of the result or of the part, whichever is smaller
    open_motions: OpenMotions
    equal_turns: tuple[Float64[ndarray, "3 3"], ...]  # rotations of the part after which it fits equally well
    next_rms: float | None  # at the best place that fits less well; None if no such place was found

    @property
    def fits(self) -> bool:
        """Whether the result can be a surface of this part."""
        return self.rms < _FITS * self.size


class _SampledPart:
    """Nearest points of a part by way of samples with normals: good to their spacing, and quick far away from it."""

    def __init__(self, part: IndexedMesh, seed: int) -> None:
        self.points, self.normals = part.sample(_SAMPLES, seed)
        self._spacing = _BESIDE * float(np.sqrt(part.area / _SAMPLES))
        self._tree = KDTree(self.points)

    def closest(self, points: Float64[ndarray, "n 3"]) -> Closest:
        """The foot on the plane of the nearest sample if that is beside it, else the sample."""
        _, index = self._tree.query(points)
        foot, normal = self.points[index], self.normals[index]
        offset = points - foot
        along = (offset * normal).sum(1, keepdims=True) * normal
        beside = np.linalg.norm(offset - along, axis=1, keepdims=True) < self._spacing
        foot = np.where(beside, points - along, foot)
        return Closest(np.linalg.norm(points - foot, axis=1), foot, normal)


class _Points:
    """Points of the result with normals, and how well they fit the part, or its samples."""

    def __init__(
        self,
        part: IndexedMesh,
        points: Float64[ndarray, "n 3"],
        normals: Float64[ndarray, "n 3"],
        samples: _SampledPart | None = None,
    ) -> None:
        self.part, self.points, self.normals = part, points, normals
        self.closest = (part if samples is None else samples).closest
        self.widest = _WIDEST * part.diagonal

    def some(self, count: int, samples: _SampledPart) -> "_Points":
        step = max(1, len(self.points) // count)
        return _Points(self.part, self.points[::step], self.normals[::step], samples)

    def costs(self, places: Sequence[Similarity]) -> Float64[ndarray, "k"]:
        """Mean squared distance at some places, in the result's own scale; points on another side count as far."""
        near = self.closest(np.concatenate([S.points(self.points) for S in places]))
        facing = (np.concatenate([self.normals @ S.R.T for S in places]) * near.normal).sum(1)
        squares = (np.minimum(near.distance, self.widest).reshape(len(places), -1) ** 2).mean(1)
        other_side = np.maximum((facing < _FACING).reshape(len(places), -1).mean(1) - _AT_EDGES, 0)
        return (squares + self.widest**2 * other_side) / np.array([S.scale for S in places]) ** 2

    def rms(self, S: Similarity) -> float:
        """RMS distance of the nearest 80 % of the points, in the part's unit."""
        distance = np.sort(self.part.distance(S.points(self.points)))
        return float(np.sqrt((distance[: int(0.8 * len(distance))] ** 2).mean()))

    def followed(self, places: Sequence[Similarity], steps: int, with_scale: bool) -> list[Similarity]:
        """The places after some steps of ICP from each; a point counts if the part's nearest side faces its way."""
        now = list(places)
        for _ in range(steps):
            moved = [S.points(self.points) for S in now]
            near = self.closest(np.concatenate(moved))
            for k, p in enumerate(moved):
                own = slice(k * len(p), (k + 1) * len(p))
                facing = ((self.normals @ now[k].R.T) * near.normal[own]).sum(1) > _FACING
                if facing.mean() < _LEAST_FACING:
                    continue
                its = Closest(*(values[own][facing] for values in (near.distance, near.point, near.normal)))
                step = icp_step(p[facing], its, self.part, with_scale)
                if not with_scale or 0.67 < step.scale * now[k].scale / places[k].scale < 1.5:
                    now[k] = step @ now[k]
        return now


def place_on_part(result: Mesh, part: Mesh, with_scale: bool = False, seed: int = 0) -> PartAlignment:
    """Place a surface, all or a piece of the part's, in the part's axes, wherever it is now.

    Args:
        result: in any axes; in the part's unit unless `with_scale`.
        part: the nominal surface, its triangles counter-clockwise as seen from outside.
        with_scale: the result's unit is not known.
        seed: of the orientations from which the search starts.

    The place is the best there is; whether it is good is said by `PartAlignment.fits`.
    """
    indexed = IndexedMesh(part)
    whole = IndexedMesh(result)
    every = _Points(indexed, *whole.sample(_POINTS, seed))
    places = _starts(every, with_scale, seed)
    samples, costs = _SampledPart(indexed, seed), np.empty(0)
    for count, steps, kept in _ROUNDS:
        some = every.some(count, samples)
        places, costs = _best(some.followed(places, steps, with_scale), some, kept)
    # To the end only those that may turn out as good, and two others.
    likely = int((costs < _LIKELY * costs[0] + (_SAME_FIT * indexed.diagonal) ** 2).sum()) + 2
    places, costs = _best(every.followed(places[:likely], _LAST_STEPS, with_scale), every, likely)
    # Below the facets' own distance from the surfaces, and below rounding, places do not differ.
    fits = _AS_GOOD * costs[0] + facet_sag(indexed) ** 2 + (_EXACT * indexed.diagonal) ** 2
    # The axes that the result has count before others that fit no better.
    own = every.followed([Similarity.identity()], 2 * _LAST_STEPS, with_scale)[0]
    cost, moved = every.costs([own]), np.linalg.norm(own.points(every.points) - every.points, axis=1).max()
    in_place = bool(cost[0] <= fits and moved < _SMALL * indexed.diagonal)
    if in_place:
        places, costs = [own, *places], np.concatenate([cost, costs])
    motions = _open_motions(every, places[0], fits)
    places, costs = _distinct(places, costs, every, motions, len(places))
    equal = _completed([S for S, cost in zip(places, costs, strict=True) if cost <= fits], every, motions, fits)
    turns = [(S @ places[0].inverse()).R for S in equal[1:]]
    worse = [S for S, cost in zip(places[1:], costs[1:], strict=True) if cost > fits]
    size, next_rms = min(indexed.diagonal, places[0].scale * whole.diagonal), every.rms(worse[0]) if worse else None
    return PartAlignment(places[0], in_place, every.rms(places[0]), size, motions, tuple(turns), next_rms)


def _completed(equal: list[Similarity], points: _Points, motions: OpenMotions, fits: float) -> list[Similarity]:
    """Equally good places with those that follow from them: after one symmetry of the part, another is one, too."""
    for _ in range(_COMPOSED):
        symmetries = [S @ equal[0].inverse() for S in equal[1 : 1 + _COMPOSED]]
        places = [*equal, *(G @ S for G in symmetries for S in equal)]
        costs = points.costs(places)
        good = [S for k, S in enumerate(places) if k < len(equal) or costs[k] <= fits]
        more, _ = _distinct(good, np.zeros(len(good)), points, motions, len(good))
        if len(more) == len(equal):
            break
        equal = more
    return equal


def _starts(points: _Points, with_scale: bool, seed: int) -> list[Similarity]:
    """Orientations of the principal axes in every order, and random ones, about the centres of both surfaces."""
    target, _ = points.part.sample(len(points.points), seed)
    centres, axes, spread = [], [], []
    for cloud in (points.points, target):
        offset = cloud - cloud.mean(0)
        _, size, Vt = np.linalg.svd(offset, full_matrices=False)
        centres.append(cloud.mean(0))
        axes.append(Vt.T * np.sign(np.linalg.det(Vt)))
        spread.append(float(np.linalg.norm(size)))
    scale = spread[1] / spread[0] if with_scale else 1.0
    turns = [axes[1] @ turn @ axes[0].T for turn in AXIS_TURNS]
    turns += [np.eye(3), *Rotation.random(_STARTS, random_state=seed).as_matrix()]
    return [Similarity(scale, R, centres[1] - scale * R @ centres[0]) for R in turns]


OPEN_TO_NOTHING = OpenMotions(np.empty((0, 3)), np.empty((0, 3)), np.zeros(3))


def _best(places: Sequence[Similarity], points: _Points, most: int) -> tuple[list[Similarity], Float64[ndarray, "m"]]:
    """The best of the places, the first one first, without others of the same."""
    costs = points.costs(places)
    order = np.argsort(costs)
    return _distinct([places[k] for k in order], costs[order], points, OPEN_TO_NOTHING, most)


def _distinct(
    places: Sequence[Similarity], costs: Float64[ndarray, "k"], points: _Points, motions: OpenMotions, most: int
) -> tuple[list[Similarity], Float64[ndarray, "m"]]:
    """The first of the places, in their order, that differ by more than open motions."""
    kept: list[int] = []
    for k, S in enumerate(places):
        if not any(_same(S @ places[other].inverse(), points, motions) for other in kept):
            kept.append(k)
        if len(kept) == most:
            break
    return [places[k] for k in kept], costs[kept]


def _same(G: Similarity, points: _Points, motions: OpenMotions) -> bool:
    """Whether a motion of the part is none, or one of the open ones."""
    centre, free = points.part.centre, motions.shifts
    turn = np.degrees(Rotation.from_matrix(G.R).magnitude())
    if len(motions.turns) == 3:
        turn, centre = 0.0, motions.point
    elif len(motions.turns) == 1:
        axis, centre = motions.turns[0], motions.point
        turn = np.degrees(np.arccos(np.clip(axis @ G.R @ axis, -1, 1)))
    shift = G.points(centre) - centre
    shift = shift - free.T @ (free @ shift)
    return bool(turn < _SAME_TURN_DEG and np.linalg.norm(shift) < _SAME_SHIFT * points.part.diagonal)


# Motions that the shape leaves open.


def _open_motions(points: _Points, S: Similarity, fits: float) -> OpenMotions:
    """Directions in which the distances hardly change, as far as the result still fits after moving along them."""
    part = points.part
    p = S.points(points.points)
    near = part.closest(p)
    inside = near.distance < points.widest
    p, normal = p[inside], near.normal[inside]
    if not len(p):
        return OPEN_TO_NOTHING
    centre = p.mean(0)
    size = float(np.sqrt(((p - centre) ** 2).sum(1).mean()))
    J = np.concatenate([normal, np.cross((p - centre) / size, normal)], 1)
    curvature, directions = np.linalg.eigh(J.T @ J / len(J))
    for count in range(int((curvature < _WEAK * curvature[-1]).sum()), 0, -1):
        weak = directions[:, :count].T
        if all(_keeps_fitting(points, S, xi, centre, size, fits) for xi in weak):
            return _described(weak, centre, size)
    return OPEN_TO_NOTHING


def _keeps_fitting(
    points: _Points, S: Similarity, xi: Float64[ndarray, "6"], centre: Float64[ndarray, "3"], size: float, fits: float
) -> bool:
    """Whether the result fits at some distance along a direction (shift and turn about the centre, in `size`)."""
    turning = float(np.linalg.norm(xi[3:]))
    for angle, share in _TRIED:
        amount = angle / turning if turning > 0.1 else share * points.part.diagonal / size
        R = Rotation.from_rotvec(amount * xi[3:]).as_matrix()
        G = Similarity(1.0, R, centre + amount * size * xi[:3] - R @ centre)
        there = points.followed([G @ S], 8, False)[0]
        if points.costs([there])[0] > fits:
            return False
        from_start = np.linalg.norm(there.points(points.points) - S.points(points.points), axis=1).mean()
        if from_start < 0.5 * np.linalg.norm((G @ S).points(points.points) - S.points(points.points), axis=1).mean():
            return False  # it slid back to where it came from
    return True


def _described(weak: Float64[ndarray, "k 6"], centre: Float64[ndarray, "3"], size: float) -> OpenMotions:
    """Open directions as shifts, and as turns about a common point."""
    U, turning, _ = np.linalg.svd(weak[:, 3:])
    count = int((turning > 0.1).sum())
    shifts = (U.T @ weak)[count:, :3]
    shifts = shifts / np.linalg.norm(shifts, axis=1, keepdims=True)
    rows = (U.T @ weak)[:count]
    v, w = rows[:, :3] - rows[:, :3] @ shifts.T @ shifts, rows[:, 3:]
    # The point that all turns leave in place: w x c = -v, in least squares, nearest to the centre.
    crosses = [np.cross(one, np.eye(3)).T for one in w]
    point = np.zeros(3) if not count else np.linalg.lstsq(np.concatenate(crosses), -v.reshape(-1), rcond=1e-6)[0]
    return OpenMotions(w / np.linalg.norm(w, axis=1, keepdims=True), shifts, centre + size * point)


# How far a curved surface is from its facets.


def facet_sag(part: IndexedMesh) -> float:
    """RMS distance, over the area, of a part's triangles from the curved surfaces that they approximate."""
    faces, vertices = part.faces, part.vertices
    doubled = np.maximum(np.linalg.norm(part.face_cross, axis=1), 1e-300)
    normal, other = part.face_cross / doubled[:, None], neighbours(faces)
    sag = np.zeros(len(faces))
    for k in range(3):
        length = np.linalg.norm(vertices[faces[:, (k + 1) % 3]] - vertices[faces[:, k]], axis=1)
        angle = np.arccos(np.clip((normal * normal[other[:, k]]).sum(1), -1, 1))
        height = doubled / np.maximum(length, 1e-300)
        sag = np.maximum(sag, np.where(angle < np.radians(_SMOOTH_DEG), height * np.tan(angle / 4) / 2, 0.0))
    return float(_MEAN_SAG * np.sqrt((doubled * sag**2).sum() / doubled.sum()))
