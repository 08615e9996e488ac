"""Two frames onto each other by a similarity: search over rotations where no guess is given, then refinement.

Point-to-plane with projective association (Blais and Levine, PAMI 1995), both ways, with a scale whose logarithm has a
prior and a bound: each frame's baseline has an unknown length, but a free scale would collapse a cloud onto a patch.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.surface_agreement import Agreement, Side, agreement
from sl_nerfstudio.registration.surface_map import SurfaceMap

TOLERANCE = 0.04  # radii: calibration errors bend a frame's surface by up to about this much
_SEARCH_TOLERANCE = 0.15
_SEARCH_POINTS, _COARSE_POINTS, _FINE_POINTS = 200, 400, 1500
_COARSE_STARTS, _FINE_STARTS = 24, 4
_COARSE_WIDTHS = (0.3, 0.3, 0.25, 0.25, 0.2, 0.2, 0.15, 0.15, 0.12, 0.1, 0.08, 0.08)
_FINE_WIDTHS = (0.08, 0.06, 0.05, 0.04, 0.03, 0.03, 0.03, 0.03)
_SCALES = (0.87, 1.0, 1.15)
_SCALE_SIGMA = 0.2  # of the logarithm: how far the visible parts' sizes may differ
LARGEST_LOG_SCALE = 0.6
_INDEPENDENT = 40  # of the points of a pair: a surface's errors go together
_LEAST_RMS = 0.015  # radii: no pair is believed to fit better, bent as surfaces are by calibration errors
_SAME_ANGLE, _SAME_SHIFT = np.radians(6.0), 0.12  # results closer than this (radian, radii) are one


@dataclass(frozen=True)
class Search:
    """Rotations to start from: all within `angle` of a guess; `roll` all about the line of sight as well."""

    angle_deg: float
    spacing_deg: float
    all_rolls: bool = False


NEIGHBOURS = Search(50.0, 17.0)
ANYWHERE = Search(75.0, 20.0, all_rolls=True)
NEARBY = Search(20.0, 10.0)
ROUGHLY = Search(30.0, 12.0)
NONE = Search(0.0, 1.0)


@dataclass(frozen=True)
class PairMatch:
    """One frame on another. Similarities map camera axes to camera axes, each in units of its own baseline."""

    source: int
    target: int
    S_target_source: Similarity
    information: Float64[ndarray, "7 7"]  # of (v, w, l), see surface_agreement; lengths in radii of the target
    agreeing: float  # fraction of all points that lie on the other frame's surface
    fitness: float  # the same among the points that could be judged
    rms: float  # distance of agreeing points from the surface, in radii
    rival: float  # score of the best clearly different placement over that of this one: 1 is undecided
    slack_deg: float  # standard deviation of the least known rotation: large on surfaces of revolution


def rotations(search: Search) -> Float64[ndarray, "k 3 3"]:
    """Rotation matrices of a search, the identity first."""
    step, reach = np.radians(search.spacing_deg), np.radians(search.angle_deg)
    n = int(np.ceil(reach / step))
    lattice = np.stack(np.meshgrid(*[np.arange(-n, n + 1) * step] * (2 if search.all_rolls else 3)), -1)
    vectors = lattice.reshape(-1, lattice.shape[-1])
    vectors = vectors[np.linalg.norm(vectors, axis=1) <= reach + 1e-9]
    vectors = vectors[np.argsort(np.linalg.norm(vectors, axis=1), kind="stable")]
    if not search.all_rolls:
        return Rotation.from_rotvec(vectors).as_matrix()
    tilt = Rotation.from_rotvec(np.pad(vectors, ((0, 0), (0, 1)))).as_matrix()
    turns = np.arange(round(2 * np.pi / step)) * (2 * np.pi / round(2 * np.pi / step))
    roll = Rotation.from_euler("z", turns).as_matrix()
    return np.einsum("aij,bjk->abik", tilt, roll).reshape(-1, 3, 3)


def register_pair(
    maps: tuple[SurfaceMap, SurfaceMap],
    pair: tuple[int, int],
    search: Search,
    rng: np.random.Generator,
    guess: Similarity | None = None,
) -> PairMatch | None:
    """Frame `pair[0]` onto frame `pair[1]`; None where no placement makes anything agree.

    With a guess the search turns it about the object; without one it starts from both cameras looking at the object
    from the same side, at sizes that make the visible parts equally large.
    """
    source, target = maps
    if not (source.valid.any() and target.valid.any()):
        return None
    scale, R, t = _starts(source, target, search, guess)
    scale, R, t = _best(*_sides(source, target, _SEARCH_POINTS, rng), (scale, R, t), _SEARCH_TOLERANCE, _COARSE_STARTS)
    reference = np.log(guess.scale if guess else target.radius / source.radius)
    coarse = _sides(source, target, _COARSE_POINTS, rng)
    for width in _COARSE_WIDTHS:
        scale, R, t = _stepped(*coarse, (scale, R, t), width, reference)
    scale, R, t = _best(*coarse, (scale, R, t), 2 * TOLERANCE, _FINE_STARTS, distinct=True)
    fine = _sides(source, target, _FINE_POINTS, rng)
    for width in _FINE_WIDTHS:
        scale, R, t = _stepped(*fine, (scale, R, t), width, reference)
    return _judged(fine, (scale, R, t), pair)


Placements = tuple[ndarray, ndarray, ndarray]  # scale [k], R [k 3 3], t [k 3]


def _sides(source: SurfaceMap, target: SurfaceMap, count: int, rng: np.random.Generator) -> tuple[Side, Side]:
    return Side(source, *source.sample(count, rng)), Side(target, *target.sample(count, rng))


def _starts(source: SurfaceMap, target: SurfaceMap, search: Search, guess: Similarity | None) -> Placements:
    turn = rotations(search)
    if guess is not None:
        R = turn @ guess.R
        pivot = target.middle
        t = pivot + np.einsum("kij,j->ki", turn, guess.t - pivot)
        return np.full(len(R), guess.scale), R, t
    size = target.radius / source.radius
    parts = []
    for factor in _SCALES:
        t = target.middle - factor * size * turn @ source.middle
        parts.append((np.full(len(turn), factor * size), turn, t))
    scale, R, t = (np.concatenate(p) for p in zip(*parts, strict=True))
    return scale, R, t


def _best(
    source: Side, target: Side, placements: Placements, tolerance: float, count: int, distinct: bool = False
) -> Placements:
    """Those with the highest scores; with `distinct`, none that another of them comes close to."""
    scale, R, t = placements
    order = np.argsort(-agreement(source, target, scale, R, t, tolerance, tolerance).score, kind="stable")
    kept: list[int] = []
    for k in order:
        if len(kept) == count:
            break
        if not distinct or all(_apart(placements, int(k), j, target.map) for j in kept):
            kept.append(int(k))
    return scale[kept], R[kept], t[kept]


def _apart(placements: Placements, a: int, b: int, target: SurfaceMap) -> bool:
    scale, R, t = placements
    angle = np.arccos(np.clip((np.trace(R[a] @ R[b].T) - 1) / 2, -1, 1))
    # where a puts the point that b puts at the target's centroid
    p = (R[b].T @ (target.centroid - t[b])) / scale[b]
    shift = np.linalg.norm(scale[a] * R[a] @ p + t[a] - target.centroid) / target.radius
    return bool(angle > _SAME_ANGLE or shift > _SAME_SHIFT)


def _stepped(source: Side, target: Side, placements: Placements, width: float, reference: float) -> Placements:
    """One damped Gauss-Newton step of each placement."""
    scale, R, t = placements
    sums = agreement(source, target, scale, R, t, width, width)
    radius, c = target.map.radius, target.map.centroid
    D = np.array([1, 1, 1, radius, radius, radius, radius])  # turns and scalings as lengths at one radius
    H, g = sums.H / D[:, None] / D, sums.g / D
    trace = np.trace(H, axis1=1, axis2=2)[:, None, None].clip(1e-12)
    H = H + 1e-4 * trace * np.eye(7)
    # Prior of the scale: a departure by its sigma costs as much as all of some tens of points being off by the width.
    prior = trace[:, 0, 0] / 3 / _INDEPENDENT * width**2 / _SCALE_SIGMA**2
    H[:, 6, 6] += prior
    g[:, 6] += prior * (np.log(scale) - reference) * radius
    step = -np.linalg.solve(H, g[..., None])[..., 0] / D
    step = step / np.maximum(np.linalg.norm(step * D, axis=1, keepdims=True) / (0.5 * radius), 1)
    bounded = np.clip(np.log(scale) + step[:, 6], reference - LARGEST_LOG_SCALE, reference + LARGEST_LOG_SCALE)
    growth = np.exp(bounded) / scale
    turn = Rotation.from_rotvec(step[:, 3:6]).as_matrix()
    t = c + growth[:, None] * np.einsum("kij,kj->ki", turn, t - c) + step[:, :3]
    return np.exp(bounded), turn @ R, t


def _judged(sides: tuple[Side, Side], placements: Placements, pair: tuple[int, int]) -> PairMatch | None:
    """The best of the refined placements, with what tells right from wrong."""
    found = agreement(*sides, *placements, TOLERANCE, TOLERANCE)
    order = np.argsort(-found.score, kind="stable")
    best = int(order[0])
    if found.agreeing[best] <= 0:
        return None
    others = [int(k) for k in order[1:] if _apart(placements, int(k), best, sides[1].map)]
    rival = max(0.0, found.score[others[0]] / max(found.score[best], 1e-9)) if others else 0.0
    scale, R, t = placements
    S = Similarity(float(scale[best]), R[best], t[best])
    return match_of(sides, S, pair, found, best, float(rival))


def match_of(
    sides: tuple[Side, Side], S: Similarity, pair: tuple[int, int], found: Agreement, k: int, rival: float
) -> PairMatch:
    """A placement as an edge of the graph of frames."""
    radius = sides[1].map.radius
    D = np.array([radius, radius, radius, 1, 1, 1, 1])
    H = found.H[k] * D[:, None] * D / radius**2
    rms = max(float(np.sqrt(found.squares[k])) / radius, _LEAST_RMS)
    count = max(np.trace(H[:3, :3]), 1e-9)  # about the sum of the weights
    information = H * (_INDEPENDENT / count / rms**2) + 1e-3 * np.eye(7)
    slack = np.sqrt(1 / np.linalg.eigvalsh(_turns_alone(information))[0])
    return PairMatch(
        *pair, S, information, float(found.agreeing[k]), float(found.fitness[k]), rms, rival, float(np.degrees(slack))
    )


def _turns_alone(information: Float64[ndarray, "7 7"]) -> Float64[ndarray, "3 3"]:
    """Information of the rotation with translation and scale free."""
    other = [0, 1, 2, 6]
    cross = information[3:6][:, other]
    return information[3:6, 3:6] - cross @ np.linalg.solve(information[np.ix_(other, other)], cross.T)


def agreement_at(
    maps: tuple[SurfaceMap, SurfaceMap], S: Similarity, rng: np.random.Generator, tolerance: float = TOLERANCE
) -> Agreement:
    """How two frames agree under a similarity that is given."""
    sides = _sides(*maps, _COARSE_POINTS, rng)
    return agreement(*sides, np.array([S.scale]), S.R[None], S.t[None], tolerance, tolerance)
