"""Registration of two frames by a similarity: proposals from a search and a walk, compared by their likelihood.

The search starts from many rotations and refines point-to-plane distances on coarse surfaces, with projective
association (Blais and Levine, PAMI 1995), both ways. Its ends, and the places along the motion that surfaces know
least, are refined on what the frames decoded and compared there (see evidence). The logarithm of the scale has a prior:
each frame's baseline has an unknown length, but a free scale would collapse a surface onto a patch.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.special import softmax

from sl_nerfstudio.geometry.devices import for_loops, pixel_of
from sl_nerfstudio.geometry.lie import Similarity, angle_deg, rotated
from sl_nerfstudio.parallel import compiled_range
from sl_nerfstudio.registration.agreement import (
    AGREEING_SIGMAS,
    COARSE_POINTS,
    LEAST_FACING_COSINE,
    Hypotheses,
    Side,
    Tolerance,
    agreement,
)
from sl_nerfstudio.registration.evidence import (
    ABSENT,
    JUDGED,
    LARGEST_NOISE,
    LEAST_ODDS,
    LEAST_SEEN,
    Commonness,
    Frame,
    FrameEvidence,
    PairEvidence,
    Places,
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
LIKENESS_POINTS, SEARCH_POINTS = 80, 200  # points of each frame: to choose pairs, and starts
COARSE_STARTS = 24  # best starts that are refined
MOST_PLACES = 16  # best distinct ends of the search that are compared
KERNEL_SIGMAS = 3.0  # least width of the kernel, in standard deviations of the two surfaces
COARSE_WIDTHS = (0.3, 0.3, 0.25, 0.25, 0.2, 0.2, 0.15, 0.15, 0.12, 0.1, 0.08, 0.08)  # of the kernel in each step, radii
DAMPING = 1e-4  # of a step, as a share of the trace of the normal equations
LARGEST_STEP = 0.5  # radii
SCALE_SIGMA = 0.25  # prior of the logarithm of the scale, about that of the start
SCALE_POINTS = 40.0  # independent points against which that prior is weighed
LARGEST_LOG_SCALE = 0.6  # bound of the logarithm of the scale, about that of the start
SAME_ROTATION_DEG = 6.0  # rotation between two results below which they are one
SAME_SHIFT = 0.12  # shift between two results, radii, below which they are one

# Places that are compared. Widths of kernels are in standard deviations of the residuals.
THINNED = 4  # only each so-manieth point is used to find places
SEARCH_WIDTHS = (60.0, 40.0, 25.0, 15.0, 10.0, 7.0, 5.0, 4.0)
WALK_WIDTHS = (8.0, 5.0, 4.0)
FINE_WIDTHS = (4.0, 3.0, 3.0)
STEP_DEG = 2.0  # of a walk: the peak that a feature makes is about as wide
WIDEST_STEP_DEG = 6.0  # between likely places of one motion along which frames slip
MOST_STEPS = 90  # in each sense: half a turn
FINE_STEPS = 9  # between the steps of a walk before and after the best place
SAME_TURN_DEG = 4.0  # between two rotations below which they are one
LEAST_STRAIGHT = 0.7  # cosine between the axes of two steps
LEAST_OVERLAP_OF_WALK = 0.25  # points that can be judged, relative to the start
SAME_START_DEG = 1.0  # rotation between two ends of the search below which they are one
SAME_PLACE_DEG, SAME_PLACE_SHIFT = 3.0, 0.1  # rotation and shift (radii) below which two places are one
EVEN_ODDS = 5.0  # nats within which residuals themselves choose
MOST_BEHIND = 60.0  # nats behind the best from which a place is no rival

# Uncertainty of a pair.
LEAST_SLIP_DEG = 4.0  # up to which the places along a slip are one
LEAST_SIDE_DEG = 12.0  # between two sides of an object, or teeth of a gear; closer places are slides along a surface
LEAST_INFORMATION = 1e-3  # on each unknown, inverse squares of radians and radii
# On the sigma by the likelihood's curvature: the decoder's errors are shared over more than a window.
ERROR_FACTOR = 2.0
LEAST_SIGMA_DEG, LEAST_SIGMA_SHIFT = 0.1, 0.002  # of rotations, and of shifts in radii: surfaces are bent a little
MOST_RIVALS = 24
LEAST_WEIGHT = 0.02  # of an edge with many rivals

# Frames that would slip, held by the tone of their surface.
TONE_STEP_DEG = 3.0  # rotation between places that are compared
TONE_FINAL_STEPS = 5  # of refinement at the place that is taken
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
TONE_LARGEST_LOSS = 20.0  # nats by which surfaces may be less likely there
TONE_ODDS = 20.0  # nats that the place at which tones agree leads others, if other pairs confirm it
TONE_SIGMAS = 4.0  # of two surfaces within which tones are compared


@dataclass(frozen=True)
class Rival:
    """A clearly different similarity between the same two frames."""

    S_target_source: Similarity
    log_odds: float  # against the best one, nats: 0 is as likely


@dataclass(frozen=True)
class PairMatch:
    """One frame on another. Similarities map camera axes to camera axes, each in units of its own baseline."""

    source: int
    target: int
    S_target_source: Similarity
    information: Float64[ndarray, "7 7"]  # of (v, w, l), see agreement; lengths in radii of the target
    overlap: float  # fraction of all points that lie on the other frame's surface
    fitness: float  # the same among the points that should be seen
    log_odds: float  # that the frames belong here and not anywhere else, nats
    rivals: tuple[Rival, ...]  # the most likely first
    rotation_sigma_deg: float  # standard deviation of the least known rotation
    slip_deg: float  # rotation that nothing tells from none: above zero on planes and surfaces of revolution
    slip_direction: Float64[ndarray, "7"]  # the motion (v, w, l) in the target's axes, about its centroid, |w| = 1
    common: tuple[Commonness, Commonness]  # what the places that are not right say of each frame's points
    noise: tuple[float, float]  # how much larger the residuals of each frame's points are than stated
    by_shape: "PairMatch | None" = None  # what surfaces alone say, which let the frames slip, where tones hold them

    @property
    def lead(self) -> float:
        """Log-odds against all rivals, nats; also against the frames having nothing in common."""
        return min([self.log_odds, *(-rival.log_odds for rival in self.rivals)])

    @property
    def holds(self) -> bool:
        """Whether the pair tells which side of the object its frames see: a slide along one is ended by other pairs."""
        return self.slip_deg < LEAST_SIDE_DEG

    @property
    def by_tone(self) -> bool:
        """Whether tones hold the frames where surfaces alone would let them slip."""
        return self.by_shape is not None

    @cached_property
    def places(self) -> tuple[Rival, ...]:
        """Its place and the rivals: all with their log-odds against it."""
        return Rival(self.S_target_source, 0.0), *self.rivals

    @cached_property
    def _rotations(self) -> tuple[Float64[ndarray, "m 3 3"], Float64[ndarray, "m"]]:
        """Rotations of all places, and their log-odds."""
        return np.stack([one.S_target_source.R for one in self.places]), np.array([one.log_odds for one in self.places])

    def log_odds_at(self, S: Similarity) -> float | None:
        """Log-odds of a place against the best one, nats; None for places that the pair does not know."""
        R, odds = self._rotations
        near = np.einsum("mij,ij->m", R, S.R) >= 1 + 2 * math.cos(math.radians(SAME_TURN_DEG))
        return float(odds[near].max()) if near.any() else None

    @cached_property
    def sides(self) -> tuple[Rival, ...]:
        """Its places, without those to which a likelier one slides: the covariance covers them."""
        if self.slip_deg == 0:
            return self.places
        kept: list[Rival] = []
        for one in sorted(self.places, key=lambda place: -place.log_odds):
            R = one.S_target_source.R
            if all(angle_deg(R @ other.S_target_source.R.T) > self.slip_deg for other in kept):
                kept.append(one)
        return tuple(kept)

    def nearest(self, S: Similarity) -> Similarity:
        """The side with the rotation nearest to that of a similarity."""
        return max((one.S_target_source for one in self.sides), key=lambda side: float((side.R * S.R).sum()))

    def knows(self, nodes: Mapping[int, Similarity]) -> bool:
        """Whether both frames are among these nodes, at one of its places to each other."""
        inside = self.source in nodes and self.target in nodes
        return inside and self.log_odds_at(nodes[self.target].inverse() @ nodes[self.source]) is not None

    def between(self, source: int, target: int) -> Similarity:
        """The similarity from `source` to `target`, whichever way it was found."""
        forward = (self.source, self.target) == (source, target)
        return self.S_target_source if forward else self.S_target_source.inverse()

    def other(self, frame: int) -> int:
        """The frame at the other end."""
        return self.target if self.source == frame else self.source


def is_accepted(match: PairMatch) -> bool:
    """Whether two frames have a surface in common, wherever it is.

    What slips fits as well along its whole motion, so that no odds show it; the size of its residuals does.
    """
    if match.slip_deg or match.by_tone:
        return match.log_odds > 0 and max(match.noise) < LARGEST_NOISE
    return match.log_odds > LEAST_ODDS


def is_ambiguous(match: PairMatch) -> bool:
    """Whether a clearly different similarity is nearly as likely."""
    return any(rival.log_odds > -LEAST_ODDS for rival in match.rivals)


def support_of(overlap: float, fitness: float) -> float:
    """Score between 0 and 1 by the share of points that agree, and the share of those that should be seen."""
    return overlap * fitness**2


def edge_weights(edges: Sequence[PairMatch]) -> Float64[ndarray, "edges"]:
    """Weight of each pair in a pose graph: about the probability that it is right, by its rivals."""
    odds = [sum(math.exp(min(side.log_odds, 0.0)) for side in e.sides) for e in edges]
    return np.maximum(1 / np.array(odds, dtype=np.float64), LEAST_WEIGHT)


# Search: similarities from which two surfaces come to agree, wherever that is.


def register_pair(
    frames: tuple[Frame, Frame],
    pair: tuple[int, int],
    search: Search,
    rng: np.random.Generator,
    guess: Similarity | None = None,
    known: Sequence[Similarity] = (),
) -> PairMatch | None:
    """Frame `pair[0]` onto frame `pair[1]`; None where no similarity makes anything agree.

    With a guess the search rotates it about the object; without one it starts from both cameras looking at the object
    from the same side. `known`: other similarities that are compared as well.
    """
    source, target = frames
    if not all(len(frame.evidence.points) and frame.map.valid.any() for frame in frames):
        return None
    found = search_places((source.map, target.map), search, rng, guess)
    starts = Places.joined([Places.without_errors(found), *([Places.of(*known)] if known else [])])
    few = PairEvidence(source.evidence, target.evidence, THINNED)
    places, H = few.refined(starts, SEARCH_WIDTHS)
    odds = few.by_likelihood(few.compare(places))
    kept = distinct_places(places, np.argsort(-odds, kind="stable").tolist(), target.evidence)
    way = walk(few, places[kept[:1]], H[kept[0]])
    fine = PairEvidence(source.evidence, target.evidence)
    match = best_match(fine, Places.joined([way, places[kept]]), pair)
    return None if match is None else held_by_tone(fine, match, (source.map, target.map), rng)


def search_places(
    maps: tuple[SurfaceMap, SurfaceMap], search: Search, rng: np.random.Generator, guess: Similarity | None
) -> Hypotheses:
    """The best distinct ends of a search on coarse surfaces."""
    source, target = maps

    def sides(count: int) -> Sides:
        return Side.sampled(source, count, rng), Side.sampled(target, count, rng)

    found = without_guess(source, target, search) if guess is None else around_guess(target, search, guess)
    few = sides(SEARCH_POINTS)
    found = found[_ranked(few, found, SEARCH_TOLERANCE)[:COARSE_STARTS]]
    coarse = sides(COARSE_POINTS)
    for width in COARSE_WIDTHS:
        found = _improved(coarse, found, Tolerance(width, KERNEL_SIGMAS))
    return found[_distinct(found, _ranked(coarse, found, COARSE_TOLERANCE), MOST_PLACES, target)]


def search_score(maps: tuple[SurfaceMap, SurfaceMap], search: Search, rng: np.random.Generator) -> float:
    """Score of the best of all starts, before any refinement: which pairs are worth registering."""
    source, target = maps
    if not (source.valid.any() and target.valid.any()):
        return -1.0
    sides = Side.sampled(source, LIKENESS_POINTS, rng), Side.sampled(target, LIKENESS_POINTS, rng)
    found = without_guess(source, target, search)
    tolerance = Tolerance(SEARCH_TOLERANCE, AGREEING_SIGMAS)
    return float(agreement(*sides, found, tolerance).score.max())


def _ranked(sides: Sides, found: Hypotheses, radii: float) -> list[int]:
    """Their indices, the highest score first; points within some radii agree."""
    tolerance = Tolerance(radii, AGREEING_SIGMAS)
    return np.argsort(-agreement(*sides, found, tolerance).score, kind="stable").tolist()


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
    """By the angle between two of them, or by how far apart they map the point that b maps to the centroid."""
    centre = target.centroid
    angle = np.arccos(np.clip((np.trace(found.R[a] @ found.R[b].T) - 1) / 2, -1, 1))
    p = (found.R[b].T @ (centre - found.t[b])) / found.scale[b]
    shift = np.linalg.norm(found.scale[a] * found.R[a] @ p + found.t[a] - centre)
    return bool(np.degrees(angle) > SAME_ROTATION_DEG or shift / target.radius > SAME_SHIFT)


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
    prior = trace[:, 0, 0] / 3 / SCALE_POINTS * width**2 / SCALE_SIGMA**2
    H[:, 6, 6] += prior
    g[:, 6] += prior * (log_scale - found.log_scale_prior) * radius
    step = -np.linalg.solve(H, g[..., None])[..., 0] / D
    size = np.linalg.norm(step * D, axis=1, keepdims=True)
    step = step / np.maximum(size / (LARGEST_STEP * radius), 1)
    bound = LARGEST_LOG_SCALE
    bounded = found.log_scale_prior + np.clip(log_scale + step[:, 6] - found.log_scale_prior, -bound, bound)
    return found.incremented(step[:, :3], step[:, 3:6], np.exp(bounded) / found.scale, c)


# Comparison of places by their likelihood.


def best_match(evidence: PairEvidence, starts: Places, pair: tuple[int, int]) -> PairMatch | None:
    """The most likely of all places, with those that are nearly as likely."""
    target = evidence.target
    places, H = evidence.refined(starts, FINE_WIDTHS)
    found = evidence.compare(places)
    best = int(np.argmax(evidence.by_likelihood(found)))
    if not (found.codes[best] == JUDGED).any():
        return None
    # the peak of a feature is narrow: steps of a walk, or the slope of smooth surface, may miss its top
    near, H_near = evidence.refined(fine_steps(evidence, places[[best]], H[best]), FINE_WIDTHS)
    places, H = Places.joined([places, near]), np.concatenate([H, H_near])
    raw = evidence.compare(places)
    found = evidence.scaled(raw, noise := evidence.noise(raw, int(np.argmax(evidence.by_likelihood(raw)))))
    likelihood = evidence.by_likelihood(found)
    even = np.flatnonzero(likelihood > likelihood.max() - EVEN_ODDS)
    best = int(even[np.argmax(evidence.by_likelihood(raw.chosen(even)))])
    # which place it is, residuals in units of their own say; where exactly, the residuals themselves
    turned, shifted = differences(places, places[[best]], target)
    same = np.flatnonzero((turned <= SAME_PLACE_DEG) & (shifted <= SAME_PLACE_SHIFT))
    best = int(same[np.argmax(evidence.by_likelihood(raw.chosen(same)))])
    turned, shifted = differences(places, places[[best]], target)
    common = evidence.commonness(found.chosen(np.flatnonzero((turned > SAME_PLACE_DEG) | (shifted > SAME_PLACE_SHIFT))))
    compared = evidence.comparison(found, common)
    odds, alone = -compared.leads[best], float(compared.odds[best])
    judged = (found.codes == JUDGED).sum(1)
    odds = np.where(judged >= LEAST_SEEN * judged[best], odds, -np.inf)
    different: list[int] = []
    for k in np.argsort(-odds, kind="stable").tolist():
        apart = differences(places[[k]], places[[best, *different]], target)
        if ((apart[0] > SAME_PLACE_DEG) | (apart[1] > SAME_PLACE_SHIFT)).all() and odds[k] > odds[best] - MOST_BEHIND:
            different.append(k)
    likely = odds > odds[best] - LEAST_ODDS
    slip = _slip_deg(turned[likely & (shifted < 1.0)])
    direction = weakest_rotation(similarity_information(H[best]))[0]
    codes, z = found.codes[best], np.abs(found.z[best])  # in units of the noise that was found
    agreeing = float(((codes == JUDGED) & (z < AGREEING_SIGMAS)).mean())
    expected = float(((codes == JUDGED) | (codes == ABSENT)).mean())
    covariance = np.linalg.inv(similarity_information(H[best]) + LEAST_INFORMATION * np.eye(7))
    covariance *= (ERROR_FACTOR * max(noise)) ** 2
    covariance += np.diag(np.r_[np.full(3, LEAST_SIGMA_SHIFT), np.full(4, np.radians(LEAST_SIGMA_DEG))] ** 2)
    rivals = [Rival(places.similarity(k), float(odds[k] - odds[best])) for k in different[:MOST_RIVALS]]
    along = variance_along((Rival(places.similarity(best), 0.0), *rivals), slip)
    covariance += along * np.outer(direction, direction)
    return PairMatch(
        *pair, places.similarity(best), np.linalg.inv(covariance), agreeing, agreeing / max(expected, 1e-9),
        alone, tuple(rivals), largest_rotation_sigma_deg(covariance),
        slip if slip > LEAST_SLIP_DEG else 0.0, direction, common, noise,
    )  # fmt: skip


def largest_rotation_sigma_deg(covariance: Float64[ndarray, "7 7"]) -> float:
    """Standard deviation of the least known rotation of an increment (v, w, l)."""
    return float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])))


def variance_along(places: Sequence[Rival], slip_deg: float) -> float:
    """Variance of a rotation along a slip, square radians: of the places along it, which are about equally far apart.

    Of any rotation between minus and plus the slip, where it leads from one side of an object to others.
    """
    if slip_deg <= LEAST_SLIP_DEG:
        return math.radians(slip_deg / 2) ** 2  # too near to each other to be places
    if slip_deg >= LEAST_SIDE_DEG:
        return math.radians(slip_deg) ** 2 / 3
    turned = np.array([angle_deg(one.S_target_source.R @ places[0].S_target_source.R.T) for one in places])
    inside = turned <= slip_deg
    odds = np.array([one.log_odds for one in places])[inside]
    return float(softmax(odds) @ np.radians(turned[inside]) ** 2)


def _slip_deg(turned: Float64[ndarray, "k"]) -> float:
    """The largest of the turns that small steps from none lead to."""
    way = np.sort(np.append(turned, 0.0))
    wide = np.flatnonzero(np.diff(way) > WIDEST_STEP_DEG)
    return float(way[wide[0]] if len(wide) else way[-1])


def differences(
    places: Places, other: Places, target: FrameEvidence
) -> tuple[Float64[ndarray, "k"], Float64[ndarray, "k"]]:
    """Least angle of each place to the others, degrees, and how far they map what lies in the centroid, in radii."""
    turn = np.einsum("kij,mij->km", places.R, other.R)
    angle = np.degrees(np.arccos(np.clip((turn - 1) / 2, -1, 1)))
    c = target.centroid
    p = np.einsum("mji,mj->mi", other.R, c - other.t) / other.scale[:, None]
    at = places.scale[:, None, None] * np.einsum("kij,mj->kmi", places.R, p) + places.t[:, None, :]
    shift = np.linalg.norm(at - c, axis=-1) / target.radius
    nearest = np.argmin(angle / SAME_PLACE_DEG + shift / SAME_PLACE_SHIFT, axis=1)
    rows = np.arange(len(places))
    return angle[rows, nearest], shift[rows, nearest]


def distinct_places(places: Places, ranked: list[int], target: FrameEvidence) -> list[int]:
    """The ranked ones without those that are close to a better one."""
    kept: list[int] = []
    for k in ranked:
        if kept:
            turned, shifted = differences(places[[k]], places[kept], target)
            if turned[0] < SAME_START_DEG and shifted[0] < SAME_PLACE_SHIFT:
                continue
        kept.append(k)
    return kept


# A walk along the motion that two frames know least: about the axis of what is nearly round, features make a narrow
# peak that no slope leads to, and no search with steps of many degrees meets.


def similarity_information(H: Float64[ndarray, "17 17"]) -> Float64[ndarray, "7 7"]:
    """What is known of the similarity while the errors of both relative poses are free (Schur complement)."""
    return H[:7, :7] - H[:7, 7:] @ np.linalg.solve(H[7:, 7:], H[7:, :7])


def weakest_rotation(
    information: Float64[ndarray, "7 7"],
) -> tuple[Float64[ndarray, "7"], Float64[ndarray, "3"]]:
    """The increment (v, w, l) with |w| = 1 that is known least, and the information on all rotations, smallest first.

    Translation and scale are free to follow.
    """
    other = [0, 1, 2, 6]
    follow = -np.linalg.lstsq(information[np.ix_(other, other)], information[other][:, 3:6], rcond=1e-10)[0]
    reduced = information[3:6, 3:6] + information[3:6][:, other] @ follow
    values, vectors = np.linalg.eigh(reduced)
    w = vectors[:, 0]
    x = np.zeros(7)
    x[3:6], x[other] = w, follow @ w
    return x, values


def moved_along(place: Places, direction: Float64[ndarray, "7"], angle: float, target: FrameEvidence) -> Places:
    """A screw motion about the axis that a motion (v, w, l) has; its growth is left to refinement."""
    w, v = direction[3:6], direction[:3] * target.radius
    on_axis = target.centroid + np.cross(w, v)
    E = Rotation.from_rotvec(w * angle).as_matrix()
    t = on_axis + (place.t - on_axis) @ E.T + w * (w @ v) * angle
    return Places(place.scale, E @ place.R, t, place.errors)


def walk(evidence: PairEvidence, start: Places, H: Float64[ndarray, "17 17"]) -> Places:
    """Places a step apart in both senses, until they are unlikely; all but the rotation follows the surfaces."""
    target, first, way = evidence.target, evidence.compare(start), [start]
    for sense in (1.0, -1.0):
        place, information = start, H
        last = sense * weakest_rotation(similarity_information(H))[0]
        for _ in range(MOST_STEPS):
            direction = weakest_rotation(similarity_information(information))[0]
            cosine = direction[3:6] @ last[3:6]
            if abs(cosine) < LEAST_STRAIGHT:
                break
            last = direction * np.sign(cosine)
            place = moved_along(place, last, np.radians(STEP_DEG), target)
            place, each = evidence.refined(place, WALK_WIDTHS, axis=last[None, 3:6])
            information = each[0]
            here = evidence.compare(place)
            if evidence.lead(first, here) > MOST_BEHIND or not here.overlaps(first, LEAST_OVERLAP_OF_WALK):
                break
            way.append(place)
    return Places.joined(way)


def fine_steps(evidence: PairEvidence, place: Places, H: Float64[ndarray, "17 17"]) -> Places:
    """Places along the weakest motion closer to each other than the steps of a walk."""
    direction = weakest_rotation(similarity_information(H))[0]
    steps = np.linspace(-STEP_DEG, STEP_DEG, FINE_STEPS)
    moved = Places.joined([moved_along(place, direction, np.radians(step), evidence.target) for step in steps])
    return evidence.refined(moved, WALK_WIDTHS, axis=np.tile(direction[3:6], (FINE_STEPS, 1)))[0]


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


def held_by_tone(
    evidence: PairEvidence, match: PairMatch, maps: tuple[SurfaceMap, SurfaceMap], rng: np.random.Generator
) -> PairMatch:
    """A pair that slips, turned to where its tones agree; as it is if it does not slip, or that is not certain.

    Other places of the pair are passed over: tones were compared all the way around.
    """
    if match.slip_deg == 0:
        return match
    sides = Side.sampled(maps[0], TONE_FOLLOWED_POINTS, rng), Side.sampled(maps[1], TONE_FOLLOWED_POINTS, rng)
    turned = turn_by_tone(sides, match.S_target_source, match.slip_direction, Tolerance(0.0, TONE_SIGMAS))
    if turned is None:
        return match
    S, sigma_deg = turned
    places, _ = evidence.refined(Places.of(S), WALK_WIDTHS, axis=match.slip_direction[None, 3:6])
    both = Places.joined([Places.of(match.S_target_source), places])
    found = evidence.compare(evidence.refined(both, FINE_WIDTHS, axis=np.tile(match.slip_direction[3:6], (2, 1)))[0])
    odds = evidence.log_odds(found, match.common)
    if odds[1] < odds[0] - TONE_LARGEST_LOSS:
        return match
    d, along = match.slip_direction, variance_along(match.places, match.slip_deg)
    covariance = np.linalg.inv(match.information) + (math.radians(sigma_deg) ** 2 - along) * np.outer(d, d)
    return replace(
        match, S_target_source=places.similarity(0), information=np.linalg.inv(covariance), rivals=(), slip_deg=0.0,
        rotation_sigma_deg=largest_rotation_sigma_deg(covariance), by_shape=match,
    )  # fmt: skip


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
    for _ in range(TONE_FINAL_STEPS):
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
        target.point, target.normal, target.sigma, target.valid, target.tone, *for_loops(target.camera),
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
    ways: list[list[Hypotheses]] = []
    for sense in (-1.0, 1.0):
        step, way = screw_motion(sense * np.radians(TONE_STEP_DEG) * direction, target), [Hypotheses.of(S)]
        for _ in range(round(180 / TONE_STEP_DEG)):
            at = Hypotheses.of(step @ way[-1].similarity(0))
            for _ in range(TONE_FOLLOW_STEPS):
                at = followed(sides, at, direction[3:6], common)
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
        s, M = scale[k], R[k]
        for n in range(len(points)):
            x, y, z = rotated(M, points[n, 0], points[n, 1], points[n, 2])
            X, Y, Z = s * x + t[k, 0], s * y + t[k, 1], s * z + t[k, 2]
            column, row, in_front = pixel_of(code, X, Y, Z, camera)
            if not (in_front and column >= 0 and row >= 0 and column < w and row < h):
                continue
            i, j = int(row), int(column)
            if not valid[i, j] or not np.isfinite(map_tone[i, j]):
                continue
            na, nb, nc = map_normal[i, j, 0], map_normal[i, j, 1], map_normal[i, j, 2]
            A, B, C = rotated(M, normals[n, 0], normals[n, 1], normals[n, 2])
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
