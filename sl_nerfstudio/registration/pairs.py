"""Registration of two frames by a similarity: search over rotations where no guess is given, then refinement.

Point-to-plane with projective association (Blais and Levine, PAMI 1995), both ways, with a scale whose logarithm has a
prior and a bound: each frame's baseline has an unknown length, but a free scale would collapse a cloud onto a patch.
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import pixel_of
from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.parallel import compiled_range
from sl_nerfstudio.registration.agreement import Agreement, Hypotheses, Side, Tolerance, agreement
from sl_nerfstudio.registration.settings import (
    REGISTRATION_DEFAULTS,
    EdgeSettings,
    PairSettings,
    Search,
    ToneMatchSettings,
)
from sl_nerfstudio.registration.surfaces import SurfaceMap

# Similarities from which the registration of a pair starts.


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
    angles = np.arange(round(2 * np.pi / step)) * (2 * np.pi / round(2 * np.pi / step))
    roll = Rotation.from_euler("z", angles).as_matrix()
    return np.einsum("aij,bjk->abik", tilt, roll).reshape(-1, 3, 3)


def around_guess(target: SurfaceMap, search: Search, guess: Similarity) -> Hypotheses:
    """A guess, rotated about what may be the object."""
    return Hypotheses.joined([_rotated(rotations(search), view.centre, guess) for view in target.views])


def _rotated(turn: Float64[ndarray, "k 3 3"], pivot: Float64[ndarray, "3"], guess: Similarity) -> Hypotheses:
    t = pivot + np.einsum("kij,j->ki", turn, guess.t - pivot)
    scale = np.full(len(turn), guess.scale)
    return Hypotheses(scale, turn @ guess.R, t, np.log(scale))


def without_guess(source: SurfaceMap, target: SurfaceMap, search: Search, scales: tuple[float, ...]) -> Hypotheses:
    """Rotations of two cameras that look at the object from the same side.

    The frames' guesses of where the object is are put onto each other, one after the other. `scales` are relative to
    the one at which their sizes are equal.
    """
    turn, parts = rotations(search), []
    for a, b in zip(source.views, target.views, strict=True):
        for scale in (factor * b.size / a.size for factor in scales):
            size = np.full(len(turn), scale)
            parts.append(Hypotheses(size, turn, b.centre - scale * turn @ a.centre, np.log(size)))
    return Hypotheses.joined(parts)


# How far one frame may slip along the surface of another without anything telling.
#
# A table, or a vase without texture, looks the same after some motions. The normal equations do not show it: noise
# of the
# normals makes information where there is none. So the motion that they know least is tried.


def weakest_rotation(information: Float64[ndarray, "7 7"]) -> Float64[ndarray, "7"]:
    """The increment (v, w, l) with |w| = 1 that is known least, with translation and scale free to follow."""
    other = [0, 1, 2, 6]
    follow = -np.linalg.solve(information[np.ix_(other, other)], information[other][:, 3:6])
    reduced = information[3:6, 3:6] + information[3:6][:, other] @ follow
    w = np.linalg.eigh(reduced)[1][:, 0]
    x = np.zeros(7)
    x[3:6], x[other] = w, follow @ w
    return x


@dataclass(frozen=True)
class CostOfPoints:
    """Robust cost of some points before and after a motion; sums and counts in shares of all points."""

    still: float  # sum of the costs before the motion
    moved: float
    judged_still: float  # how many of the points the other frame can judge
    judged_moved: float

    def __add__(self, other: "CostOfPoints") -> "CostOfPoints":
        """Of two pairs of frames together."""
        return CostOfPoints(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def rise(self) -> float:
        """Of the mean cost; 0 where nothing is judged."""
        if min(self.judged_still, self.judged_moved) <= 0:
            return 0.0
        return self.moved / self.judged_moved - self.still / self.judged_still


@dataclass(frozen=True)
class MotionCost:
    """What a motion costs: all points, and those that it moves along their normals."""

    every: CostOfPoints
    telling: CostOfPoints

    def __add__(self, other: "MotionCost") -> "MotionCost":
        """Of two pairs of frames together."""
        return MotionCost(self.every + other.every, self.telling + other.telling)

    @property
    def rise(self) -> float:
        """The larger rise, in the units of a rise of all points: few points must notice a motion all the more.

        The standard error of a mean over a share of the points is larger by the inverse root of that share.
        """
        share = self.telling.judged_still / max(self.every.judged_still, 1e-9)
        return max(self.every.rise, self.telling.rise * float(np.sqrt(share)))


def motion_cost(
    sides: tuple[Side, Side], still: Similarity, moved: Similarity, kernel: Tolerance, settings: PairSettings
) -> MotionCost:
    """What a motion from one similarity to another costs the points of both frames.

    Points that stay on their own tangent plane tell nothing, whatever they are: those of a vase that turns about its
    axis, or of the table below it.
    """
    source, target = sides
    both = Hypotheses.joined([Hypotheses.of(still), Hypotheses.of(moved)])
    some = (
        _moved_points(source, still, moved, settings.slip_sigmas),
        _moved_points(target, still.inverse(), moved.inverse(), settings.slip_sigmas),
    )
    share = (len(some[0].points) / len(source.points) + len(some[1].points) / len(target.points)) / 2
    every = _cost_of(agreement(*sides, both, kernel, kernel, settings.agreement), 1.0)
    return MotionCost(every, _cost_of(agreement(*some, both, kernel, kernel, settings.agreement), share))


def _cost_of(found: Agreement, share: float) -> CostOfPoints:
    """Of points that are a share of all; `found` is before and after the motion."""
    before, after = (share * found.judged).tolist()
    return CostOfPoints(float(found.cost[0]) * before, float(found.cost[1]) * after, before, after)


def _moved_points(side: Side, still: Similarity, moved: Similarity, sigmas: float) -> Side:
    """The points that a motion moves along their normals by more than some standard deviations of both surfaces."""
    step = moved.points(side.points) - still.points(side.points)
    along = np.abs((step * (side.normals @ still.R.T)).sum(1))
    some = along > sigmas * 2**0.5 * still.scale * side.sigma
    return Side(side.map, side.points[some], side.normals[some], side.sigma[some])


def slip_deg(
    sides: tuple[Side, Side],
    S_target_source: Similarity,
    direction: Float64[ndarray, "7"],
    common: Tolerance,
    settings: PairSettings,
) -> float:
    """The largest of some angles, in degrees, up to which a motion in either sense is not noticed; 0 where all are.

    A motion is noticed where the mean robust cost of all points, or of those that it moves, rises, with a kernel as
    narrow as the surfaces agree, though everything but its rotation may follow: the axis of a surface of revolution is
    never known exactly.
    """
    surface, unit = sides[1].map, Tolerance(0.0, common.sigmas / settings.common_rms)
    angles = np.array([0.0, *settings.slip_angles_deg])
    rise = np.full(len(angles) - 1, np.inf)
    for sense in (1.0, -1.0):
        moved = Hypotheses.joined(
            [
                Hypotheses.of(screw_motion(sense * angle * direction, surface) @ S_target_source)
                for angle in np.radians(angles)
            ]
        )
        for _ in range(settings.slip_steps):
            moved = followed(sides, moved, direction[3:6], Tolerance(0.0, common.sigmas), settings)
        still, *others = (moved.similarity(k) for k in range(len(angles)))
        rises = [motion_cost(sides, still, other, unit, settings).rise for other in others]
        rise = np.minimum(rise, rises)
    noticed = np.flatnonzero(rise > settings.slip_rise)
    return float(angles[noticed[0]] if len(noticed) else angles[-1])


def followed(
    sides: tuple[Side, Side],
    moved: Hypotheses,
    held: Float64[ndarray, "3"],
    kernel: Tolerance,
    settings: PairSettings,
) -> Hypotheses:
    """After a Gauss-Newton step of each that does not rotate about the axis `held`."""
    target = sides[1].map
    sums = agreement(*sides, moved, kernel, kernel, settings.agreement)
    D = np.array([1.0] * 3 + [target.radius] * 4)
    H, g = sums.H / D[:, None] / D, sums.g / D
    free = np.eye(7) - np.outer(np.r_[0, 0, 0, held, 0], np.r_[0, 0, 0, held, 0])
    damping = settings.damping * np.trace(H, axis1=1, axis2=2).clip(1e-12)
    H = free @ H @ free + damping[:, None, None] * np.eye(7)
    step = -np.linalg.solve(H, (g @ free)[..., None])[..., 0] / D
    growth = np.clip(step[:, 6], -settings.largest_log_scale, settings.largest_log_scale)
    return moved.incremented(step[:, :3], step[:, 3:6], np.exp(growth), target.centroid)


def screw_motion(x: Float64[ndarray, "7"], surface: SurfaceMap) -> Similarity:
    """A screw motion with growth: a point follows the velocity `l (p - c) + w x (p - c) + radius v` for a unit of time.

    To first order it is the increment x; unlike that it stays on a surface of revolution.
    """
    v, w, growth = x[:3] * surface.radius, x[3:6], x[6]
    A = np.zeros((4, 4))
    A[:3, :3] = np.cross(np.eye(3), w) + growth * np.eye(3)
    A[:3, 3] = v - A[:3, :3] @ surface.centroid
    M = expm(A)
    scale = float(np.exp(growth))
    return Similarity(scale, M[:3, :3] / scale, M[:3, 3])


# Two frames turned against each other to where their tones agree, along a motion that their surfaces do not notice.
#
# A vase, a bottle or a ball looks the same from all around, but for its texture. So the whole way around is tried,
# and
# the place where the tones of both frames are most alike is taken if it is clearly better than all others.


@dataclass(frozen=True)
class Likeness:
    """How alike the tones of two frames are under each of k similarities."""

    correlation: Float64[ndarray, "k"]  # NaN where too little of both surfaces is seen
    share: Float64[ndarray, "k"]  # of the source's toned points that are compared


@dataclass(frozen=True)
class ToneTurn:
    """Where the tones agree."""

    S_target_source: Similarity
    direction: Float64[ndarray, "7"]  # the motion (v, w, l) along which the frames slip, |w| = 1
    shape_slip_deg: float  # how far the surfaces alone let them
    sigma_deg: float  # of the rotation along it, by tones


def turn_by_tone(
    sides: tuple[Side, Side],
    S_target_source: Similarity,
    slip: tuple[Float64[ndarray, "7"], float],
    common: Tolerance,
    settings: PairSettings,
) -> ToneTurn | None:
    """The similarity along a motion at which tones agree; None where none stands out.

    `slip` is the motion (v, w, l), and how far, in degrees, the surfaces do not notice it; `common` is how closely they
    agree.
    """
    direction, shape_slip_deg = slip
    if not all(np.isfinite(side.map.tone).any() for side in sides):
        return None
    way = _around(sides, S_target_source, direction, common, settings)
    peak = _peak(likeness(sides, way, common, settings), settings.tone)
    if peak is None or peak.sigma_deg > settings.tone.largest_sigma_deg:
        return None
    if angle_deg(way.R[peak.index]) < peak.half_width_deg:
        return None  # both cameras see it from the same side: what light and view make there looks the same, too
    rest = np.radians(peak.offset_deg) * direction
    turned = Hypotheses.of(screw_motion(rest, sides[1].map) @ way.similarity(peak.index))
    for _ in range(settings.slip_steps):
        turned = followed(sides, turned, direction[3:6], common, settings)
    return ToneTurn(turned.similarity(0), direction, shape_slip_deg, max(peak.sigma_deg, settings.tone.least_sigma_deg))


def likeness(sides: tuple[Side, Side], ways: Hypotheses, common: Tolerance, settings: PairSettings) -> Likeness:
    """Correlation of the source's tones with those of the target where its points lie on that surface."""
    source, target = sides[0].map, sides[1].map
    toned = source.valid & np.isfinite(source.tone)
    points, normals, sigma, tone = source.point[toned], source.normal[toned], source.sigma[toned], source.tone[toned]
    thin = slice(None, None, max(1, len(points) // settings.tone.points))
    sums = np.zeros((len(ways), 6))
    scale, R, t = ways.scale, np.ascontiguousarray(ways.R), np.ascontiguousarray(ways.t)
    _sums(
        len(scale), points[thin], normals[thin], sigma[thin], tone[thin], scale, R, t,
        target.point, target.normal, target.sigma, target.valid, target.tone, target.model_code, target.parameters,
        common.sigmas, settings.agreement.least_facing_cosine, sums,
    )  # fmt: skip
    n, a, b, aa, bb, ab = sums.T
    share = n / max(len(points[thin]), 1)
    n = np.maximum(n, 1)
    spread = np.sqrt(np.maximum(aa / n - (a / n) ** 2, 0) * np.maximum(bb / n - (b / n) ** 2, 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = (ab / n - a * b / n**2) / spread
    enough = (share > settings.tone.least_share) & (spread > 0)
    return Likeness(np.where(enough, correlation, np.nan), share)


def _around(
    sides: tuple[Side, Side], S: Similarity, direction: Float64[ndarray, "7"], common: Tolerance, settings: PairSettings
) -> Hypotheses:
    """Similarities along the motion, a step apart, once around; all but the rotation follows the surfaces."""
    s, target = settings.tone, sides[1].map
    few = sides[0].thinned(s.followed_points), sides[1].thinned(s.followed_points)
    ways: list[list[Hypotheses]] = []
    for sense in (-1.0, 1.0):
        step, way = screw_motion(sense * np.radians(s.step_deg) * direction, target), [Hypotheses.of(S)]
        for _ in range(round(180 / s.step_deg)):
            at = Hypotheses.of(step @ way[-1].similarity(0))
            for _ in range(s.follow_steps):
                at = followed(few, at, direction[3:6], common, settings)
            if not abs(np.log(at.scale[0] / S.scale)) < settings.largest_log_scale:
                break  # nothing is left that it could follow
            way.append(at)
        ways.append(way)
    return Hypotheses.joined([*reversed(ways[0][1:]), *ways[1]])


@dataclass(frozen=True)
class _Peak:
    """Where tones agree clearly better than anywhere else along the way."""

    index: int
    offset_deg: float  # from there to the top
    half_width_deg: float  # from the top to where the correlation has fallen to a half
    sigma_deg: float


def _peak(found: Likeness, settings: ToneMatchSettings) -> _Peak | None:
    """None where no similarity has tones that agree clearly better than those of all that are apart from it."""
    c = found.correlation.clip(-settings.largest_correlation, settings.largest_correlation)
    if not np.isfinite(c[1:-1]).any():
        return None
    best = 1 + int(np.nanargmax(c[1:-1]))
    if c[best] < settings.least_correlation or not np.isfinite(c[[best - 1, best + 1]]).all():
        return None
    width = _half_width(c, best)
    apart = c[(np.abs(np.arange(len(c)) - best) > 2 * width) & np.isfinite(c)]
    if len(apart) < settings.fewest_others:
        return None
    spread = float(np.sqrt(np.mean(np.arctanh(apart) ** 2)))  # of Fisher's transform, where nothing is in common
    left, top, right = np.arctanh(c[[best - 1, best, best + 1]])
    if top - np.arctanh(apart.max()) < settings.least_lead * spread:
        return None
    # The likelihood of n independent places, of which spread^-2 is the number, falls by n / 2 times the square of it.
    bend = max(2 * top - left - right, 1e-6)
    offset, sigma = float(np.clip(0.5 * (right - left) / bend, -0.5, 0.5)), spread / float(np.sqrt(top * bend))
    return _Peak(best, settings.step_deg * offset, settings.step_deg * width, settings.step_deg * sigma)


def _half_width(c: Float64[ndarray, "k"], best: int) -> int:
    """Steps from the best to where less than half of its correlation is left, on the side where that is farther."""
    low = np.flatnonzero(~(c > c[best] / 2))
    before, after = low[low < best], low[low > best]
    first, last = (before[-1] if len(before) else 0), (after[0] if len(after) else len(c) - 1)
    return int(max(best - first, last - best))


@compiled_range
def _sums(
    first, last, points, normals, sigma, tone, scale, R, t, map_point, map_normal, map_sigma, valid, map_tone, code,
    camera, sigmas, least_facing, out
):  # fmt: skip
    """Adds the number, sums and products of tones that meet, for each similarity."""
    h, w = valid.shape
    for k in range(first, last):
        s = scale[k]
        for n in range(len(points)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            a, b, c = normals[n, 0], normals[n, 1], normals[n, 2]
            X = s * (R[k, 0, 0] * x + R[k, 0, 1] * y + R[k, 0, 2] * z) + t[k, 0]
            Y = s * (R[k, 1, 0] * x + R[k, 1, 1] * y + R[k, 1, 2] * z) + t[k, 1]
            Z = s * (R[k, 2, 0] * x + R[k, 2, 1] * y + R[k, 2, 2] * z) + t[k, 2]
            column, row, in_front = pixel_of(code, X, Y, Z, camera)
            if not (in_front and column >= 0 and row >= 0 and column < w and row < h):
                continue
            i, j = int(row), int(column)
            if not valid[i, j] or not np.isfinite(map_tone[i, j]):
                continue
            na, nb, nc = map_normal[i, j, 0], map_normal[i, j, 1], map_normal[i, j, 2]
            A = R[k, 0, 0] * a + R[k, 0, 1] * b + R[k, 0, 2] * c
            B = R[k, 1, 0] * a + R[k, 1, 1] * b + R[k, 1, 2] * c
            C = R[k, 2, 0] * a + R[k, 2, 1] * b + R[k, 2, 2] * c
            off = na * (X - map_point[i, j, 0]) + nb * (Y - map_point[i, j, 1]) + nc * (Z - map_point[i, j, 2])
            if na * A + nb * B + nc * C < least_facing or abs(off) > sigmas * np.hypot(s * sigma[n], map_sigma[i, j]):
                continue
            p, q = tone[n], map_tone[i, j]
            out[k, 0] += 1
            out[k, 1] += p
            out[k, 2] += q
            out[k, 3] += p * p
            out[k, 4] += q * q
            out[k, 5] += p * q


# The result of registering one frame to another: an edge of the pose graph.


@dataclass(frozen=True)
class Rival:
    """A clearly different similarity between the same two frames."""

    S_target_source: Similarity
    ratio: float  # its score over that of the best one: 1 is as good


@dataclass(frozen=True)
class PairMatch:
    """One frame on another. Similarities map camera axes to camera axes, each in units of its own baseline."""

    source: int
    target: int
    S_target_source: Similarity
    information: Float64[ndarray, "7 7"]  # of (v, w, l), see surface_agreement; lengths in radii of the target
    overlap: float  # fraction of all points that lie on the other frame's surface
    fitness: float  # the same among the points that could be judged
    rms: float  # distance of agreeing points from the surface, in radii
    rivals: tuple[Rival, ...]  # the best first
    rotation_sigma_deg: float  # standard deviation of the least known rotation
    slip_deg: float  # rotation that nothing tells from none: above zero on planes and surfaces of revolution
    slip_direction: Float64[ndarray, "7"]  # the motion (v, w, l) in the target's axes, about its centroid, |w| = 1
    shape_slip_deg: float = 0.0  # the rotation that surfaces alone do not tell: larger than `slip_deg` where tones do

    @property
    def second_best_ratio(self) -> float:
        """Score of the best rival over that of this similarity: 1 is ambiguous."""
        return self.rivals[0].ratio if self.rivals else 0.0

    @property
    def by_tone(self) -> bool:
        """Whether tones hold the frames where surfaces alone would let them slip."""
        return self.shape_slip_deg > self.slip_deg

    def without_tone(self) -> "PairMatch":
        """The same pair as one that slips."""
        d, slip = self.slip_direction, np.radians(self.shape_slip_deg)
        covariance = np.linalg.inv(self.information) + slip**2 * np.outer(d, d)
        sigma_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])))
        return replace(
            self,
            information=np.linalg.inv(covariance),
            rotation_sigma_deg=sigma_deg,
            slip_deg=self.shape_slip_deg,
        )

    def between(self, source: int, target: int) -> Similarity:
        """The similarity from `source` to `target`, whichever way it was found."""
        forward = (self.source, self.target) == (source, target)
        return self.S_target_source if forward else self.S_target_source.inverse()

    def other(self, frame: int) -> int:
        """The frame at the other end."""
        return self.target if self.source == frame else self.source


def match_from(
    pair: tuple[int, int],
    S_target_source: Similarity,
    found: Agreement,
    k: int,
    rivals: tuple[Rival, ...],
    sides: tuple[Side, Side],
    common: Tolerance,
    settings: PairSettings,
    turn: ToneTurn | None = None,
) -> PairMatch:
    """The edge for similarity k of `found`, with the uncertainty that follows from the sums and from slipping.

    `turn` is how tones hold two frames that slip.
    """
    target = sides[1].map
    D = np.array([target.radius] * 3 + [1] * 4)
    H = found.H[k] * D[:, None] * D / target.radius**2
    # No pair is assumed to fit better than the surfaces are known: errors of the relative pose bend them.
    typical = float(np.median(target.sigma[target.valid])) / target.radius
    rms = max(float(np.sqrt(found.squares[k])), 1.0) * typical
    count = max(np.trace(H[:3, :3]), 1e-9)  # about the sum of the weights
    information = H * (settings.independent_points / count / rms**2) + settings.least_information * np.eye(7)
    # Errors of the two relative poses move and bend a surface as a whole: more points do not average them.
    bending = np.array([settings.shift_sigmas] * 3 + [settings.turn_sigmas] * 4) * rms
    covariance = np.linalg.inv(information) + np.diag(bending**2)
    direction = weakest_rotation(information) if turn is None else turn.direction
    slip = slip_deg(sides, S_target_source, direction, common, settings) if turn is None else turn.shape_slip_deg
    free = np.radians(slip if turn is None else turn.sigma_deg)
    covariance = covariance + free**2 * np.outer(direction, direction)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])
    return PairMatch(
        *pair,
        S_target_source,
        np.linalg.inv(covariance),
        float(found.agreeing[k]),
        float(found.fitness[k]),
        rms,
        rivals,
        float(np.degrees(sigma)),
        slip if turn is None else 0.0,
        direction,
        slip,
    )


# Which registered pairs become edges of the pose graph, and how much each counts.


def is_accepted(match: PairMatch, settings: EdgeSettings = REGISTRATION_DEFAULTS.edge) -> bool:
    """Whether a pair overlaps and agrees well enough to be an edge."""
    return match.fitness > settings.least_fitness and match.overlap > settings.least_overlap


def support(match: PairMatch) -> float:
    """Between 0 and 1: how much two surfaces agree, and how little contradicts."""
    return support_of(match.overlap, match.fitness)


def support_of(overlap: float, fitness: float) -> float:
    """The same from the share of points that agree, and the share of those that could be judged."""
    return overlap * fitness**2


def quality(match: PairMatch, settings: EdgeSettings = REGISTRATION_DEFAULTS.edge) -> float:
    """Between 0 and 1: which of two results for a pair is better, and which pair of a frame."""
    clear = match.second_best_ratio < settings.ambiguous_ratio
    return support(match) * (1.0 if clear else settings.ambiguous_weight)


def is_ambiguous(match: PairMatch, settings: EdgeSettings = REGISTRATION_DEFAULTS.edge) -> bool:
    """Whether a clearly different similarity fits nearly as well."""
    return match.second_best_ratio > settings.ambiguous_ratio


def edge_weights(
    edges: Sequence[PairMatch], settings: EdgeSettings = REGISTRATION_DEFAULTS.edge
) -> Float64[ndarray, "edges"]:
    """Weight of each pair: smaller where its surfaces agree less than those of the scan's good pairs do.

    On smooth surfaces frames slide: neighbours that are wrong in the same way close cycles with each other and
    outnumber the right pairs. But they fit a little worse.
    """
    fitness = np.array([e.fitness for e in edges])
    if not len(fitness):
        return fitness
    deficit = np.maximum(np.quantile(fitness, settings.good_quantile) - fitness, 0) / settings.fitness_scale
    factor = np.array([settings.ambiguous_weight if is_ambiguous(e, settings) else 1.0 for e in edges])
    return np.maximum(np.exp(-(deficit**2)) * factor, settings.least_weight)


Sides = tuple[Side, Side]  # of the source and the target


def register_pair(
    maps: tuple[SurfaceMap, SurfaceMap],
    pair: tuple[int, int],
    search: Search,
    rng: np.random.Generator,
    guess: Similarity | None = None,
    settings: PairSettings = REGISTRATION_DEFAULTS.pair,
) -> PairMatch | None:
    """Frame `pair[0]` onto frame `pair[1]`; None where no similarity makes anything agree.

    With a guess the search rotates it about the object; without one it starts from both cameras looking at the object
    from the same side.
    """
    source, target = maps
    if not (source.valid.any() and target.valid.any()):
        return None

    def sides(count: int) -> Sides:
        return Side.sampled(source, count, rng), Side.sampled(target, count, rng)

    if guess is None:
        found = without_guess(source, target, search, settings.start_scales)
    else:
        found = around_guess(target, search, guess)
    few = sides(settings.search_points)
    best = _ranked(few, found, settings.search_tolerance, settings)
    found = found[best[: settings.coarse_starts]]
    coarse = sides(settings.coarse_points)
    for width in settings.coarse_widths:
        found = _improved(coarse, found, Tolerance(width, settings.kernel_sigmas), settings)
    best = _ranked(coarse, found, settings.coarse_tolerance, settings)
    found = found[_distinct(found, best, settings.fine_starts, target, settings)]
    fine = sides(settings.fine_points)
    for width in settings.fine_widths:
        found = _improved(fine, found, Tolerance(width, settings.kernel_sigmas), settings)
    common = Tolerance(0.0, _common_width(fine, found, settings))
    for _ in range(settings.common_steps):
        found = _improved(fine, found, common, settings)
    return _best_match(fine, found, common, pair, settings)


def search_score(
    maps: tuple[SurfaceMap, SurfaceMap],
    search: Search,
    rng: np.random.Generator,
    settings: PairSettings = REGISTRATION_DEFAULTS.pair,
) -> float:
    """How well the best of all starts agrees, before any refinement: which pairs are worth registering."""
    source, target = maps
    if not (source.valid.any() and target.valid.any()):
        return -1.0
    sides = tuple(Side.sampled(m, settings.likeness_points, rng) for m in maps)
    found = without_guess(source, target, search, settings.start_scales)
    a, tolerance = settings.agreement, Tolerance(settings.search_tolerance, settings.tolerance_sigmas)
    return float(agreement(sides[0], sides[1], found, tolerance, tolerance, a).score(a.search_penalty, a.behind).max())


def _ranked(sides: Sides, found: Hypotheses, radii: float, settings: PairSettings) -> list[int]:
    """Their indices, the highest score first; points within some radii agree."""
    tolerance = Tolerance(radii, settings.tolerance_sigmas)
    a = settings.agreement
    score = agreement(*sides, found, tolerance, tolerance, a).score(a.search_penalty, a.behind)
    return np.argsort(-score, kind="stable").tolist()


def _distinct(
    found: Hypotheses, ranked: list[int], count: int, target: SurfaceMap, settings: PairSettings
) -> list[int]:
    """The first `count` of the ranked ones, without those that are close to a better one."""
    kept: list[int] = []
    for k in ranked:
        if len(kept) == count:
            break
        if all(_differ(found, k, j, target, settings) for j in kept):
            kept.append(k)
    return kept


def _differ(found: Hypotheses, a: int, b: int, target: SurfaceMap, settings: PairSettings) -> bool:
    angle_deg, shift = found.difference(a, b, target.centroid)
    return angle_deg > settings.same_rotation_deg or shift / target.radius > settings.same_shift


def _improved(sides: Sides, found: Hypotheses, kernel: Tolerance, settings: PairSettings) -> Hypotheses:
    """After one damped Gauss-Newton step of each."""
    sums = agreement(*sides, found, kernel, kernel, settings.agreement)
    target = sides[1].map
    radius, c, log_scale = target.radius, target.centroid, np.log(found.scale)
    D = np.array([1, 1, 1, radius, radius, radius, radius])  # rotations and scalings as lengths at one radius
    H, g = sums.H / D[:, None] / D, sums.g / D
    trace = np.trace(H, axis1=1, axis2=2)[:, None, None].clip(1e-12)
    H = H + settings.damping * trace * np.eye(7)
    # Prior of the scale: a departure by its sigma costs as much as all independent points being off by the width.
    width = max(kernel.radii, kernel.sigmas * float(np.median(sides[1].sigma)) / radius)
    prior = trace[:, 0, 0] / 3 / settings.independent_points * width**2 / settings.scale_sigma**2
    H[:, 6, 6] += prior
    g[:, 6] += prior * (log_scale - found.log_scale_prior) * radius
    step = -np.linalg.solve(H, g[..., None])[..., 0] / D
    size = np.linalg.norm(step * D, axis=1, keepdims=True)
    step = step / np.maximum(size / (settings.largest_step * radius), 1)
    bound = settings.largest_log_scale
    bounded = found.log_scale_prior + np.clip(log_scale + step[:, 6] - found.log_scale_prior, -bound, bound)
    return found.incremented(step[:, :3], step[:, 3:6], np.exp(bounded) / found.scale, c)


def _common_width(sides: Sides, found: Hypotheses, settings: PairSettings) -> float:
    """Standard deviations within which surfaces agree if they are the same: from the result that agrees most closely.

    How uncertain the surfaces are says how far they may be apart, not how far they are: most of it is common to all
    points, and a similarity takes it up. What remains shows a relief that would otherwise be lost in it.
    """
    tolerance = Tolerance(0.0, settings.tolerance_sigmas)
    sums = agreement(*sides, found, tolerance, tolerance, settings.agreement)
    likely = sums.agreeing >= settings.likely * sums.agreeing.max()
    rms = float(np.sqrt(sums.squares[likely].min())) if likely.any() else 0.0
    return float(np.clip(settings.common_rms * rms, settings.least_width, settings.tolerance_sigmas))


def _best_match(
    sides: Sides, found: Hypotheses, common: Tolerance, pair: tuple[int, int], settings: PairSettings
) -> PairMatch | None:
    """The result that explains most at the common width, with the others and how far they fall short."""
    a = settings.agreement
    score = agreement(*sides, found, common, common, a).score(a.penalty, a.behind)
    tolerance = Tolerance(0.0, settings.tolerance_sigmas)
    sums = agreement(*sides, found, tolerance, tolerance, a)
    best, *others = np.argsort(-score, kind="stable").tolist()
    if sums.agreeing[best] <= 0:
        return None
    target = sides[1].map
    different: list[int] = []
    for k in others:
        if score[k] > 0 and all(_differ(found, k, j, target, settings) for j in [best, *different]):
            different.append(k)
    rivals = tuple(Rival(found.similarity(k), float(score[k] / max(score[best], 1e-9))) for k in different)
    match = match_from(pair, found.similarity(best), sums, best, rivals, sides, common, settings)
    return _held_by_tone(match, sides, common, settings) or match


def _held_by_tone(match: PairMatch, sides: Sides, common: Tolerance, settings: PairSettings) -> PairMatch | None:
    """A pair that slips, turned to where its tones agree; None if it does not slip, or where that is not certain.

    Other results for the pair are passed over: tones were compared all the way around.
    """
    if match.slip_deg == 0:
        return None
    turn = turn_by_tone(sides, match.S_target_source, (match.slip_direction, match.slip_deg), common, settings)
    if turn is None:
        return None
    tolerance = Tolerance(0.0, settings.tolerance_sigmas)
    S = turn.S_target_source
    sums = agreement(*sides, Hypotheses.of(S), tolerance, tolerance, settings.agreement)
    if sums.fitness[0] < match.fitness - settings.tone.largest_loss:
        return None
    return match_from((match.source, match.target), S, sums, 0, (), sides, common, settings, turn)
