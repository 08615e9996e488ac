"""Registration of two frames by a similarity: search over rotations where no guess is given, then refinement.

Point-to-plane with projective association (Blais and Levine, PAMI 1995), both ways, with a scale whose logarithm has a
prior and a bound: each frame's baseline has an unknown length, but a free scale would collapse a cloud onto a patch.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import pixel_of
from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.parallel import compiled_range
from sl_nerfstudio.registration.agreement import (
    AGREEING_SIGMAS,
    AGREES,
    COARSE_POINTS,
    LEAST_FACING_COSINE,
    PENALTY,
    Agreement,
    Hypotheses,
    Side,
    Tolerance,
    agreement,
)
from sl_nerfstudio.registration.surfaces import SurfaceMap

Sides = tuple[Side, Side]  # of the source and the target


@dataclass(frozen=True)
class Search:
    """Rotations to start from: all within an angle of the guess."""

    angle_deg: float
    """largest rotation, degrees"""
    spacing_deg: float
    """angle between neighbouring rotations, degrees"""
    all_rolls: bool = False
    """every rotation about the line of sight, combined with tilts within the angle"""


ANYWHERE = Search(75.0, 20.0, all_rolls=True)  # for frames of which nothing is known
NEIGHBOURS = Search(50.0, 17.0)  # for frames that follow each other in a sequence
ROUGH = Search(30.0, 12.0)  # for frames with rough camera poses
NEARBY = Search(20.0, 10.0)  # for frames that other pairs have placed

# The search. Lengths are in radii: RMS distances of a frame's points from their centroid.
START_SCALES = (0.8, 1.0, 1.25)  # relative to the one that makes the expected objects equally large, or equally far
SEARCH_TOLERANCE = 0.15  # radii within which a point agrees while starts are compared
COARSE_TOLERANCE = 0.06  # the same while the results of the first refinement are compared
LIKENESS_POINTS, SEARCH_POINTS, FINE_POINTS = 80, 200, 1500  # points of each frame: to choose pairs, starts, at last
COARSE_STARTS = 24  # best starts that are refined
FINE_STARTS = 4  # best distinct results that are refined further
KERNEL_SIGMAS = 3.0  # least width of the kernel, in standard deviations of the two surfaces
COARSE_WIDTHS = (0.3, 0.3, 0.25, 0.25, 0.2, 0.2, 0.15, 0.15, 0.12, 0.1, 0.08, 0.08)  # of the kernel in each step, radii
FINE_WIDTHS = (0.08, 0.06, 0.04, 0.03, 0.02, 0.015, 0.01, 0.0, 0.0, 0.0)
LIKELY = 0.7  # share of the largest overlap that a result must have to say how closely surfaces agree
COMMON_RMS = 2.5  # width at which results are compared, in root mean square distances of the closest one
LEAST_WIDTH = 1.25  # least such width, in standard deviations of the surfaces
COMMON_STEPS = 4  # of refinement with a kernel of that width
DAMPING = 1e-4  # of a step, as a share of the trace of the normal equations
LARGEST_STEP = 0.5  # radii
SCALE_SIGMA = 0.25  # prior of the logarithm of the scale, about that of the start
LARGEST_LOG_SCALE = 0.6  # bound of the logarithm of the scale, about that of the start
SAME_ROTATION_DEG = 6.0  # rotation between two results below which they are one
SAME_SHIFT = 0.12  # shift between two results, radii, below which they are one

# Uncertainty of a pair.
INDEPENDENT_POINTS = 40.0  # points that count as independent: neighbouring points share errors
LEAST_INFORMATION = 1e-3  # on each unknown, inverse squares of radians and radii
SHIFT_SIGMAS = 1.5  # error of the translation that all points share, in standard deviations of the surfaces
TURN_SIGMAS = 0.4  # the same of rotation and scale, as lengths at one radius
SLIP_ANGLES_DEG = (4.0, 8.0, 12.0)  # rotations by which slipping is tried
BOUNDED_SLIP_DEG = 4.0  # up to which several pairs together connect frames: an uncertainty like any other
SLIP_STEPS = 5  # by which the rest of the motion follows each of these rotations
SLIP_SIGMAS = 3.0  # displacement along its normal, in sigmas of both surfaces, from which a point notices a motion
SLIP_RISE = 0.056  # of the mean robust cost: three standard errors of 40 independent points of one sigma each

# Frames that would slip, held by the tone of their surface.
TONE_STEP_DEG = 3.0  # rotation between places that are compared
TONE_FOLLOW_STEPS = 2  # by which the rest of the motion follows each of them
TONE_FOLLOWED_POINTS = 300  # of each frame by which it follows
TONE_POINTS = 5000  # of a frame that are compared at most
TONE_LEAST_SHARE = 0.15  # of a frame's toned points that the other must see, for a correlation to count
TONE_LEAST_CORRELATION = 0.3  # of the tones at the place that is taken
TONE_LARGEST_CORRELATION = 0.999  # that counts: Fisher's transform of 1 is infinite
TONE_LEAST_LEAD = 2.0  # of that place over all others, in standard deviations of what chance gives
TONE_FEWEST_OTHERS = 12  # places that it must be compared with
TONE_LEAST_SIGMA_DEG = 0.3  # of a rotation found so
TONE_LARGEST_SIGMA_DEG = 1.5  # beyond it nothing is found: broad shades are as likely light as surface
TONE_LARGEST_LOSS = 0.05  # share of the points that may agree less there than where the surfaces agree best

# Which pairs are accepted, and their weights in the pose graph.
LEAST_FITNESS = 0.6  # share of the points that can be judged which must agree
LEAST_OVERLAP = 0.15  # share of all points which must agree
AMBIGUOUS_RATIO = 0.85  # score of the second best result over the best from which a pair is ambiguous
AMBIGUOUS_WEIGHT = 0.5  # factor of the weight of an ambiguous pair
GOOD_QUANTILE = 0.75  # of the fitness of all pairs: that of good ones
FITNESS_SCALE = 0.05  # fitness below that of good pairs at which a pair's weight falls to 1/e
LEAST_WEIGHT = 0.02  # of the worst pair


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
    def holds(self) -> bool:
        """Whether the pair holds its frames in place, to within a slip that other pairs end."""
        return self.slip_deg <= BOUNDED_SLIP_DEG

    @property
    def by_tone(self) -> bool:
        """Whether tones hold the frames where surfaces alone would let them slip."""
        return self.shape_slip_deg > self.slip_deg

    def without_tone(self) -> "PairMatch":
        """The pair as one that slips."""
        d, slip = self.slip_direction, np.radians(self.shape_slip_deg)
        covariance = np.linalg.inv(self.information) + slip**2 * np.outer(d, d)
        sigma_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])))
        return replace(
            self, information=np.linalg.inv(covariance), rotation_sigma_deg=sigma_deg, slip_deg=self.shape_slip_deg
        )

    def between(self, source: int, target: int) -> Similarity:
        """The similarity from `source` to `target`, whichever way it was found."""
        forward = (self.source, self.target) == (source, target)
        return self.S_target_source if forward else self.S_target_source.inverse()

    def other(self, frame: int) -> int:
        """The frame at the other end."""
        return self.target if self.source == frame else self.source


def is_accepted(match: PairMatch) -> bool:
    """Whether a pair overlaps and agrees well enough to be an edge."""
    return match.fitness > LEAST_FITNESS and match.overlap > LEAST_OVERLAP


def support(match: PairMatch) -> float:
    """Score between 0 and 1: how much two surfaces agree, and how little contradicts."""
    return support_of(match.overlap, match.fitness)


def support_of(overlap: float, fitness: float) -> float:
    """Support by the share of points that agree, and the share of those that could be judged."""
    return overlap * fitness**2


def quality(match: PairMatch) -> float:
    """Score between 0 and 1 that ranks results of a pair, and pairs of a frame."""
    clear = match.second_best_ratio < AMBIGUOUS_RATIO
    return support(match) * (1.0 if clear else AMBIGUOUS_WEIGHT)


def is_ambiguous(match: PairMatch) -> bool:
    """Whether a clearly different similarity fits nearly as well."""
    return match.second_best_ratio > AMBIGUOUS_RATIO


def edge_weights(edges: Sequence[PairMatch]) -> Float64[ndarray, "edges"]:
    """Weight of each pair: smaller where its surfaces agree less than those of the scan's good pairs do.

    On smooth surfaces frames slide: neighbours that are wrong in the same way close cycles with each other and
    outnumber the right pairs. But they fit a little worse.
    """
    fitness = np.array([e.fitness for e in edges])
    if not len(fitness):
        return fitness
    deficit = np.maximum(np.quantile(fitness, GOOD_QUANTILE) - fitness, 0) / FITNESS_SCALE
    factor = np.array([AMBIGUOUS_WEIGHT if is_ambiguous(e) else 1.0 for e in edges])
    return np.maximum(np.exp(-(deficit**2)) * factor, LEAST_WEIGHT)


# Search and refinement.


def register_pair(
    maps: tuple[SurfaceMap, SurfaceMap],
    pair: tuple[int, int],
    search: Search,
    rng: np.random.Generator,
    guess: Similarity | None = None,
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

    found = without_guess(source, target, search) if guess is None else around_guess(target, search, guess)
    few = sides(SEARCH_POINTS)
    best = _ranked(few, found, SEARCH_TOLERANCE)
    found = found[best[:COARSE_STARTS]]
    coarse = sides(COARSE_POINTS)
    for width in COARSE_WIDTHS:
        found = _improved(coarse, found, Tolerance(width, KERNEL_SIGMAS))
    best = _ranked(coarse, found, COARSE_TOLERANCE)
    found = found[_distinct(found, best, FINE_STARTS, target)]
    fine = sides(FINE_POINTS)
    for width in FINE_WIDTHS:
        found = _improved(fine, found, Tolerance(width, KERNEL_SIGMAS))
    common = Tolerance(0.0, _common_width(fine, found))
    for _ in range(COMMON_STEPS):
        found = _improved(fine, found, common)
    return _best_match(fine, found, common, pair)


def search_score(maps: tuple[SurfaceMap, SurfaceMap], search: Search, rng: np.random.Generator) -> float:
    """Score of the best of all starts, before any refinement: which pairs are worth registering."""
    source, target = maps
    if not (source.valid.any() and target.valid.any()):
        return -1.0
    sides = tuple(Side.sampled(m, LIKENESS_POINTS, rng) for m in maps)
    found = without_guess(source, target, search)
    tolerance = Tolerance(SEARCH_TOLERANCE, AGREEING_SIGMAS)
    return float(agreement(sides[0], sides[1], found, tolerance).score().max())


def _ranked(sides: Sides, found: Hypotheses, radii: float) -> list[int]:
    """Their indices, the highest score first; points within some radii agree."""
    tolerance = Tolerance(radii, AGREEING_SIGMAS)
    score = agreement(*sides, found, tolerance).score()
    return np.argsort(-score, kind="stable").tolist()


def _distinct(found: Hypotheses, ranked: list[int], count: int, target: SurfaceMap) -> list[int]:
    """The first `count` of the ranked ones, without those that are close to a better one."""
    kept: list[int] = []
    for k in ranked:
        if len(kept) == count:
            break
        if all(_differ(found, k, j, target) for j in kept):
            kept.append(k)
    return kept


def _differ(found: Hypotheses, a: int, b: int, target: SurfaceMap) -> bool:
    angle_deg, shift = found.difference(a, b, target.centroid)
    return angle_deg > SAME_ROTATION_DEG or shift / target.radius > SAME_SHIFT


def _improved(sides: Sides, found: Hypotheses, kernel: Tolerance) -> Hypotheses:
    """Take one damped Gauss-Newton step of each."""
    sums = agreement(*sides, found, kernel)
    target = sides[1].map
    radius, c, log_scale = target.radius, target.centroid, np.log(found.scale)
    D = np.array([1, 1, 1, radius, radius, radius, radius])  # rotations and scalings as lengths at one radius
    H, g = sums.H / D[:, None] / D, sums.g / D
    trace = np.trace(H, axis1=1, axis2=2)[:, None, None].clip(1e-12)
    H = H + DAMPING * trace * np.eye(7)
    # Prior of the scale: a departure by its sigma costs as much as all independent points being off by the width.
    width = max(kernel.radii, kernel.sigmas * float(np.median(sides[1].sigma)) / radius)
    prior = trace[:, 0, 0] / 3 / INDEPENDENT_POINTS * width**2 / SCALE_SIGMA**2
    H[:, 6, 6] += prior
    g[:, 6] += prior * (log_scale - found.log_scale_prior) * radius
    step = -np.linalg.solve(H, g[..., None])[..., 0] / D
    size = np.linalg.norm(step * D, axis=1, keepdims=True)
    step = step / np.maximum(size / (LARGEST_STEP * radius), 1)
    bound = LARGEST_LOG_SCALE
    bounded = found.log_scale_prior + np.clip(log_scale + step[:, 6] - found.log_scale_prior, -bound, bound)
    return found.incremented(step[:, :3], step[:, 3:6], np.exp(bounded) / found.scale, c)


def _common_width(sides: Sides, found: Hypotheses) -> float:
    """Standard deviations within which surfaces agree if they are the same: from the result that agrees most closely.

    How uncertain the surfaces are says how far they may be apart, not how far they are: most of it is common to all
    points, and a similarity takes it up. What remains shows a relief that would otherwise be lost in it.
    """
    sums = agreement(*sides, found, AGREES)
    likely = sums.agreeing >= LIKELY * sums.agreeing.max()
    rms = float(np.sqrt(sums.squares[likely].min())) if likely.any() else 0.0
    return float(np.clip(COMMON_RMS * rms, LEAST_WIDTH, AGREEING_SIGMAS))


def _best_match(sides: Sides, found: Hypotheses, common: Tolerance, pair: tuple[int, int]) -> PairMatch | None:
    """The result that explains most at the common width, with the others and how far they fall short."""
    score = agreement(*sides, found, common).score(PENALTY)
    sums = agreement(*sides, found, AGREES)
    best, *others = np.argsort(-score, kind="stable").tolist()
    if sums.agreeing[best] <= 0:
        return None
    target = sides[1].map
    different: list[int] = []
    for k in others:
        if score[k] > 0 and all(_differ(found, k, j, target) for j in [best, *different]):
            different.append(k)
    rivals = tuple(Rival(found.similarity(k), float(score[k] / max(score[best], 1e-9))) for k in different)
    match = match_from(pair, found.similarity(best), sums, best, rivals, sides, common)
    return _held_by_tone(match, sides, common) or match


def _held_by_tone(match: PairMatch, sides: Sides, common: Tolerance) -> PairMatch | None:
    """A pair that slips, turned to where its tones agree; None if it does not slip, or where that is not certain.

    Other results for the pair are passed over: tones were compared all the way around.
    """
    if match.slip_deg == 0:
        return None
    found = turn_by_tone(sides, match.S_target_source, match.slip_direction, common)
    if found is None:
        return None
    S, sigma_deg = found
    sums = agreement(*sides, Hypotheses.of(S), AGREES)
    if sums.fitness[0] < match.fitness - TONE_LARGEST_LOSS:
        return None
    by_tone = match.slip_direction, match.slip_deg, sigma_deg
    return match_from((match.source, match.target), S, sums, 0, (), sides, common, by_tone)


def match_from(
    pair: tuple[int, int],
    S_target_source: Similarity,
    found: Agreement,
    k: int,
    rivals: tuple[Rival, ...],
    sides: Sides,
    common: Tolerance,
    by_tone: tuple[Float64[ndarray, "7"], float, float] | None = None,
) -> PairMatch:
    """The edge for similarity k of `found`, with the uncertainty that follows from the sums and from slipping.

    `by_tone`: the motion along which surfaces slip, by how many degrees, and the sigma in degrees that tones leave.
    """
    target = sides[1].map
    D = np.array([target.radius] * 3 + [1] * 4)
    H = found.H[k] * D[:, None] * D / target.radius**2
    # No pair is assumed to fit better than the surfaces are known: errors of the relative pose bend them.
    typical = float(np.median(target.sigma[target.valid])) / target.radius
    rms = max(float(np.sqrt(found.squares[k])), 1.0) * typical
    count = max(np.trace(H[:3, :3]), 1e-9)  # about the sum of the weights
    information = H * (INDEPENDENT_POINTS / count / rms**2) + LEAST_INFORMATION * np.eye(7)
    # Errors of the two relative poses move and bend a surface as a whole: more points do not average them.
    bending = np.array([SHIFT_SIGMAS] * 3 + [TURN_SIGMAS] * 4) * rms
    covariance = np.linalg.inv(information) + np.diag(bending**2)
    if by_tone is None:
        direction = weakest_rotation(information)
        shape_slip = slip = free = slip_deg(sides, S_target_source, direction, common)
    else:
        (direction, shape_slip, free), slip = by_tone, 0.0
    covariance = covariance + np.radians(free) ** 2 * np.outer(direction, direction)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])
    agreeing, fitness = float(found.agreeing[k]), float(found.fitness[k])
    return PairMatch(
        *pair, S_target_source, np.linalg.inv(covariance), agreeing, fitness, rms, rivals, float(np.degrees(sigma)),
        slip, direction, shape_slip,
    )  # fmt: skip


# Similarities to start from.


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
    turn, parts = rotations(search), []
    scale = np.full(len(turn), guess.scale)
    for view in target.views:
        t = view.centre + np.einsum("kij,j->ki", turn, guess.t - view.centre)
        parts.append(Hypotheses(scale, turn @ guess.R, t, np.log(scale)))
    return Hypotheses.joined(parts)


def without_guess(source: SurfaceMap, target: SurfaceMap, search: Search) -> Hypotheses:
    """Rotations of two cameras that look at the object from the same side.

    The frames' guesses of where the object is are put onto each other, one after the other.
    """
    turn, parts = rotations(search), []
    for a, b in zip(source.views, target.views, strict=True):
        for scale in (factor * b.size / a.size for factor in START_SCALES):
            size = np.full(len(turn), scale)
            parts.append(Hypotheses(size, turn, b.centre - scale * turn @ a.centre, np.log(size)))
    return Hypotheses.joined(parts)


# Slip: a table, or a vase without texture, looks the same after some motions. The normal equations do not show it,
# because noise of the normals makes information where there is none. So the motion that they know least is tried.


def weakest_rotation(information: Float64[ndarray, "7 7"]) -> Float64[ndarray, "7"]:
    """The increment (v, w, l) with |w| = 1 that is known least, with translation and scale free to follow."""
    other = [0, 1, 2, 6]
    follow = -np.linalg.solve(information[np.ix_(other, other)], information[other][:, 3:6])
    reduced = information[3:6, 3:6] + information[3:6][:, other] @ follow
    w = np.linalg.eigh(reduced)[1][:, 0]
    x = np.zeros(7)
    x[3:6], x[other] = w, follow @ w
    return x


def motion_cost(sides: Sides, still: Similarity, moved: Similarity, kernel: Tolerance) -> Float64[ndarray, "2 4"]:
    """Robust costs of a motion from one similarity to another, sums that may be added over pairs of frames.

    Rows: all points of both frames, and those that the motion moves along their normals. Points that stay on their own
    tangent plane carry no information: those of a vase that turns about its axis, or of the table below it. Columns:
    sum of the costs before and after, and how many points the other frame can judge before and after, in shares of all.
    """
    source, target = sides
    both = Hypotheses.of(still, moved)
    some = _moved_points(source, still, moved), _moved_points(target, still.inverse(), moved.inverse())
    share = (len(some[0].points) / len(source.points) + len(some[1].points) / len(target.points)) / 2
    out = np.empty((2, 4))
    for row, (points, part) in zip(out, ((sides, 1.0), (some, share)), strict=True):
        found = agreement(*points, both, kernel)
        row[2:] = part * found.judged
        row[:2] = found.cost * row[2:]
    return out


def rise_of(costs: Float64[ndarray, "2 4"]) -> float:
    """The larger rise of the mean cost, of all points or of those that a motion moves.

    In units of a rise of all points: the standard error of a mean over a share of the points is larger by the inverse
    root of that share, so few points must notice a motion all the more.
    """
    rises = [
        moved / judged_moved - still / judged_still if min(judged_still, judged_moved) > 0 else 0.0
        for still, moved, judged_still, judged_moved in costs.tolist()
    ]
    share = costs[1, 2] / max(costs[0, 2], 1e-9)
    return max(rises[0], rises[1] * float(np.sqrt(share)))


def _moved_points(side: Side, still: Similarity, moved: Similarity) -> Side:
    """The points that a motion moves along their normals by more than SLIP_SIGMAS of both surfaces."""
    step = moved.points(side.points) - still.points(side.points)
    along = np.abs((step * (side.normals @ still.R.T)).sum(1))
    some = along > SLIP_SIGMAS * 2**0.5 * still.scale * side.sigma
    return Side(side.map, side.points[some], side.normals[some], side.sigma[some])


def slip_deg(sides: Sides, S_target_source: Similarity, direction: Float64[ndarray, "7"], common: Tolerance) -> float:
    """The largest of some angles, in degrees, up to which a motion in either sense is not noticed; 0 where all are.

    A motion is noticed where the mean robust cost of all points, or of those that it moves, rises, with a kernel as
    narrow as the surfaces agree, though everything but its rotation may follow: the axis of a surface of revolution is
    never known exactly.
    """
    surface, unit = sides[1].map, Tolerance(0.0, common.sigmas / COMMON_RMS)
    angles = np.array([0.0, *SLIP_ANGLES_DEG])
    rise = np.full(len(angles) - 1, np.inf)
    for sense in (1.0, -1.0):
        motions = [screw_motion(sense * angle * direction, surface) for angle in np.radians(angles)]
        moved = Hypotheses.of(*(motion @ S_target_source for motion in motions))
        for _ in range(SLIP_STEPS):
            moved = followed(sides, moved, direction[3:6], Tolerance(0.0, common.sigmas))
        still, *others = (moved.similarity(k) for k in range(len(angles)))
        rises = [rise_of(motion_cost(sides, still, other, unit)) for other in others]
        rise = np.minimum(rise, rises)
    noticed = np.flatnonzero(rise > SLIP_RISE)
    return float(angles[noticed[0]] if len(noticed) else angles[-1])


def followed(sides: Sides, moved: Hypotheses, held: Float64[ndarray, "3"], kernel: Tolerance) -> Hypotheses:
    """Take a Gauss-Newton step of each that does not rotate about the axis `held`."""
    target = sides[1].map
    sums = agreement(*sides, moved, kernel)
    D = np.array([1.0] * 3 + [target.radius] * 4)
    H, g = sums.H / D[:, None] / D, sums.g / D
    free = np.eye(7) - np.outer(np.r_[0, 0, 0, held, 0], np.r_[0, 0, 0, held, 0])
    damping = DAMPING * np.trace(H, axis1=1, axis2=2).clip(1e-12)
    H = free @ H @ free + damping[:, None, None] * np.eye(7)
    step = -np.linalg.solve(H, (g @ free)[..., None])[..., 0] / D
    growth = np.clip(step[:, 6], -LARGEST_LOG_SCALE, LARGEST_LOG_SCALE)
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


# Tone: a vase, a bottle or a ball looks the same from all around, but for its texture. So the whole way around is
# tried, and the place where the tones of both frames are most alike is taken if it is clearly better than all others.


def turn_by_tone(
    sides: Sides, S_target_source: Similarity, direction: Float64[ndarray, "7"], common: Tolerance
) -> tuple[Similarity, float] | None:
    """The similarity along a motion (v, w, l) at which tones agree, and the sigma of its rotation in degrees.

    None where no place stands out. `common` is how closely the surfaces agree.
    """
    if not all(np.isfinite(side.map.tone).any() for side in sides):
        return None
    way = _around(sides, S_target_source, direction, common)
    peak = _peak(likeness(sides, way, common))
    if peak is None or peak.sigma_deg > TONE_LARGEST_SIGMA_DEG:
        return None
    if angle_deg(way.R[peak.index]) < peak.half_width_deg:
        return None  # both cameras see it from the same side: what light and view make there looks the same, too
    rest = np.radians(peak.offset_deg) * direction
    turned = Hypotheses.of(screw_motion(rest, sides[1].map) @ way.similarity(peak.index))
    for _ in range(SLIP_STEPS):
        turned = followed(sides, turned, direction[3:6], common)
    return turned.similarity(0), max(peak.sigma_deg, TONE_LEAST_SIGMA_DEG)


def likeness(sides: Sides, ways: Hypotheses, common: Tolerance) -> Float64[ndarray, "k"]:
    """Correlation of the source's tones with those of the target where its points lie on that surface.

    NaN where too little of both surfaces is seen.
    """
    source, target = sides[0].map, sides[1].map
    toned = source.valid & np.isfinite(source.tone)
    points, normals, sigma, tone = source.point[toned], source.normal[toned], source.sigma[toned], source.tone[toned]
    thin = slice(None, None, max(1, len(points) // TONE_POINTS))
    sums = np.zeros((len(ways), 6))
    scale, R, t = ways.scale, np.ascontiguousarray(ways.R), np.ascontiguousarray(ways.t)
    _sums(
        len(scale), points[thin], normals[thin], sigma[thin], tone[thin], scale, R, t,
        target.point, target.normal, target.sigma, target.valid, target.tone, target.model_code, target.parameters,
        common.sigmas, LEAST_FACING_COSINE, sums,
    )  # fmt: skip
    n, a, b, aa, bb, ab = sums.T
    share = n / max(len(points[thin]), 1)
    n = np.maximum(n, 1)
    spread = np.sqrt(np.maximum(aa / n - (a / n) ** 2, 0) * np.maximum(bb / n - (b / n) ** 2, 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = (ab / n - a * b / n**2) / spread
    enough = (share > TONE_LEAST_SHARE) & (spread > 0)
    return np.where(enough, correlation, np.nan)


def _around(sides: Sides, S: Similarity, direction: Float64[ndarray, "7"], common: Tolerance) -> Hypotheses:
    """Similarities along the motion, a step apart, once around; all but the rotation follows the surfaces."""
    target = sides[1].map
    few = sides[0].thinned(TONE_FOLLOWED_POINTS), sides[1].thinned(TONE_FOLLOWED_POINTS)
    ways: list[list[Hypotheses]] = []
    for sense in (-1.0, 1.0):
        step, way = screw_motion(sense * np.radians(TONE_STEP_DEG) * direction, target), [Hypotheses.of(S)]
        for _ in range(round(180 / TONE_STEP_DEG)):
            at = Hypotheses.of(step @ way[-1].similarity(0))
            for _ in range(TONE_FOLLOW_STEPS):
                at = followed(few, at, direction[3:6], common)
            if not abs(np.log(at.scale[0] / S.scale)) < LARGEST_LOG_SCALE:
                break  # nothing is left that it could follow
            way.append(at)
        ways.append(way)
    return Hypotheses.joined([*reversed(ways[0][1:]), *ways[1]])


@dataclass(frozen=True)
class _Peak:
    """A place along the way where tones agree clearly better than anywhere else."""

    index: int
    offset_deg: float  # from there to the top
    half_width_deg: float  # from the top to where the correlation has fallen to a half
    sigma_deg: float


def _peak(correlation: Float64[ndarray, "k"]) -> _Peak | None:
    """Find where tones agree clearly better than at all similarities apart from it; None if there is no such place."""
    c = correlation.clip(-TONE_LARGEST_CORRELATION, TONE_LARGEST_CORRELATION)
    if not np.isfinite(c[1:-1]).any():
        return None
    best = 1 + int(np.nanargmax(c[1:-1]))
    if c[best] < TONE_LEAST_CORRELATION or not np.isfinite(c[[best - 1, best + 1]]).all():
        return None
    width = _half_width(c, best)
    apart = c[(np.abs(np.arange(len(c)) - best) > 2 * width) & np.isfinite(c)]
    if len(apart) < TONE_FEWEST_OTHERS:
        return None
    spread = float(np.sqrt(np.mean(np.arctanh(apart) ** 2)))  # of Fisher's transform, where nothing is in common
    left, top, right = np.arctanh(c[[best - 1, best, best + 1]])
    if top - np.arctanh(apart.max()) < TONE_LEAST_LEAD * spread:
        return None
    # The likelihood of n independent places, of which spread^-2 is the number, falls by n / 2 times the square of it.
    bend = max(2 * top - left - right, 1e-6)
    offset, sigma = float(np.clip(0.5 * (right - left) / bend, -0.5, 0.5)), spread / float(np.sqrt(top * bend))
    return _Peak(best, TONE_STEP_DEG * offset, TONE_STEP_DEG * width, TONE_STEP_DEG * sigma)


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
