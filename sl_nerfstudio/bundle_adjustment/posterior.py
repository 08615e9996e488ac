"""Which of two rigs is more probable, by one posterior; and how far single frames may have slid.

The posterior is that of the look-ups that exist at both rigs, and of the starting poses.

What exists at one of them alone says nothing by itself: frames that are turned onto one side of a round object see
each other more than they do where they belong, and agree as far as the object is round. So both are asked the same: an
anchor is the same pixel of the same frame, at the depth that each rig gives it, and the same frames look it up.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import exp, pi

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps, MapSample
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.observations import (
    anchors_at,
    anchors_on,
    in_front_of,
    observe,
    partners,
    surface_rays,
    visible_rows,
)
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    PriorTerm,
    RefinePoses,
    baseline_scale,
    by_frame,
    free_parameters,
    gauge_directions,
    restore,
    rough_weight,
)
from sl_nerfstudio.bundle_adjustment.residuals import (
    OWN_PLACE_PX,
    Anchors,
    Observations,
    Rig,
    linearise,
    residuals_of,
)
from sl_nerfstudio.bundle_adjustment.search import (
    EVERY_FRAME_PER_ANCHOR,
    INDEPENDENT,
    LEAST_COSINE,
    PARTNERS,
    SearchProblem,
    SearchProgress,
    kernel_of,
)
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost
from sl_nerfstudio.parallel import results

_COMPARED_ANCHORS = 300  # decoded pixels of each frame that are looked up
_FRAME_ANCHORS = 6000  # the same of a frame that alone is in question
_OF_OTHERS = 25  # one in so many of those of the other frames, or in as many as there are frames, if these are more
_FRAME_LOOK_UPS = 24_000  # of all of them, at most
_COMPARED_NOISES = 4.0  # residual at which a look-up costs half of what a contradiction costs
_NATS = _COMPARED_NOISES**2 / 2  # cost of a look-up that contradicts, however far off it is
_HIDDEN = 2.0  # widths of the kernel from which on a nearer surface is another one, which hides the anchor
_BLOCK = 32  # pixels along each side: look-ups of anchors within such a block may depend on each other
_MOST_CELLS = 2**12  # along each side of an image
_LEAST_ODDS = 5.0  # nats by which a rig must be more probable, at least, and by more than their standard error
GROSS = 25.0  # nats that a frame costs whose starting pose is wrong altogether: once in a thousand frames, and then
# anywhere (six of twelve dimensions, each some 20 sigma wide)
_MOST_STEPS, _CONVERGED = 30, 1e-6  # of the similarity at which the starting poses are least contradicted


@dataclass(frozen=True)
class Odds:
    """How many times as probable one rig is as another, as logarithms (nats): below zero if it is less probable."""

    data: float  # of the look-ups
    prior: float  # of the starting poses
    error: float  # standard error of `data`

    @property
    def nats(self) -> float:
        """Of the whole posterior."""
        return self.data + self.prior

    @property
    def better(self) -> bool:
        """Whether one rig is more probable by more than the uncertainty of the comparison."""
        return self.nats > max(_LEAST_ODDS, self.error)


def odds(problem: SearchProblem, one: Rig, two: Rig, noise: float) -> Odds:
    """Compare two rigs; `noise` is that of one look-up, in projector pixels.

    A contradiction costs a fixed amount, however far off it is. A camera that sees another surface in front of the
    anchor says nothing. Look-ups of a frame are correlated: together they count as `INDEPENDENT`, however many they
    are. The prior counts in full, so a rig far from the starting poses must explain far better what both explain.
    """
    generator = torch.Generator().manual_seed(problem.settings.seed)
    frame, uv = problem.maps.draw(torch.arange(one.frames), _COMPARED_ANCHORS, generator)
    seen = problem.maps.look_up(frame, uv)
    (mine, good), (theirs, as_good) = (anchors_at(rig, frame, uv, seen) for rig in (one, two))
    both = good & as_good
    ends = [_End(one, mine, both), _End(two, theirs, both)]
    allowed = torch.stack([end.partners(problem.maps, generator) for end in ends]).any(0)
    first, second = (end.numbers(problem.maps, allowed, generator) for end in ends)
    shared = first[torch.isin(first, second)]
    rows = _some(one.frames, shared, EVERY_FRAME_PER_ANCHOR * int(both.sum()), generator)
    own, cross, common = _gains(problem.maps, ends, rows, noise)
    share = min(INDEPENDENT * one.frames / max(len(cross), 1), 1.0)
    gain, block = share * torch.cat([own[both], cross]), _blocks(frame, uv)
    mean, error = mean_and_error(gain, torch.cat([block[both], block[rows.anchor[common]]]))
    prior = prior_cost(problem.prior, problem.start, two) - prior_cost(problem.prior, problem.start, one)
    return Odds(mean * len(gain), prior, error * len(gain))


@dataclass(frozen=True)
class _End:
    """A rig, and decoded pixels as its anchors."""

    rig: Rig
    anchors: Anchors
    good: Bool[Tensor, "anchors"]  # those that can be used

    def partners(self, maps: CoordinateMaps, generator: torch.Generator) -> Bool[Tensor, "frames frames"]:
        return partners(self.rig, self.anchors.chosen(self.good), maps, PARTNERS, LEAST_COSINE, generator)

    def numbers(
        self, maps: CoordinateMaps, allowed: Bool[Tensor, "frames frames"], generator: torch.Generator
    ) -> Int[Tensor, "rows"]:
        """Every look-up as one number: of its anchor, then of the frame that looks it up."""
        index, n = self.good.nonzero()[:, 0], self.rig.frames
        anchors = self.anchors.chosen(index)
        rows = observe(self.rig, anchors, maps, n, float("inf"), LEAST_COSINE, generator, allowed)
        return index[rows.anchor] * n + rows.frame


def _some(frames: int, numbers: Int[Tensor, "n"], most: int, generator: torch.Generator) -> Observations:
    """Look-ups by their numbers; a random choice if there are too many."""
    chosen = numbers[torch.randperm(len(numbers), generator=generator)[:most].sort().values]
    return Observations(chosen // frames, chosen % frames)


def _gains(
    maps: CoordinateMaps, ends: list[_End], rows: Observations, noise: float
) -> tuple[Float[Tensor, "anchors"], Float[Tensor, "common"], Bool[Tensor, "rows"]]:
    """What the first of two rigs gains over the second, nats.

    By the own residuals of anchors, which count where both rigs have them; then by look-ups that exist at both; and
    which these are.
    """
    found = [residuals_of(end.rig, end.anchors, rows, maps) for end in ends]
    width, both = _COMPARED_NOISES * noise, ends[0].good & ends[1].good
    common = found[0].cross_valid & found[1].cross_valid & both[rows.anchor]
    for end, r in zip(ends, found, strict=True):
        far = (common & (r.cross.norm(dim=-1) > _HIDDEN * width)).nonzero()[:, 0]
        hidden = in_front_of(end.rig, end.anchors, Observations(rows.anchor[far], rows.frame[far]), maps)
        common[far[hidden]] = False

    def cost(residual: Float[Tensor, "n 2"]) -> Float[Tensor, "n"]:
        return _NATS * geman_mcclure_cost((residual / width).square().sum(-1))

    first, second = found
    return cost(second.own) - cost(first.own), cost(second.cross[common]) - cost(first.cross[common]), common


def _blocks(frame: Int[Tensor, "n"], uv: Float[Tensor, "n 2"]) -> Int[Tensor, "n"]:
    """Number of the block of an image in which each pixel is: what is decoded in one may err alike."""
    cell = (uv / _BLOCK).long()
    return (frame * _MOST_CELLS + cell[:, 1]) * _MOST_CELLS + cell[:, 0]


def prior_cost(prior: PosePrior, start: Rig, rig: Rig) -> float:
    """What the starting poses say against a rig, in nats, wherever it is as a whole and however large.

    The starting pose of any frame may be wrong altogether, which costs a fixed amount. Half of them count on the way,
    however far they are.
    """
    term = PriorTerm(prior, start, 0.5)
    rig = restore(start, rig, baseline_scale(start, rig, None))
    for _ in range(_MOST_STEPS):
        energies = term.energies(rig)
        right = torch.sigmoid(GROSS - energies / (energies.median() / GROSS).clamp_min(1))[:, None, None]
        H, g = term.equations(rig)
        G = by_frame(gauge_directions(rig))
        information, pull = (G.mT @ (right * H) @ G).sum(0), (G.mT @ (right * g[..., None])).sum(0)[:, 0]
        step = -torch.linalg.lstsq(information, pull[:, None], driver="gelsd").solution[:, 0]
        rig = rig.scaled(float(step[6].clamp(-1, 1).exp()))
        rig = rig.moved(step[:6].expand(rig.frames, 6), torch.zeros(rig.frames, 6, dtype=step.dtype))
        if float(step.abs().max()) < _CONVERGED:
            break
    return -float(torch.logaddexp(-term.energies(rig), torch.tensor(-GROSS, dtype=step.dtype)).sum())


def mean_and_error(values: Float[Tensor, "n"], block: Int[Tensor, "n"]) -> tuple[float, float]:
    """Mean and its standard error, if the values within a block may depend on each other in any way.

    The error of a ratio of sums over blocks (Cochran, Sampling Techniques, 1977, section 6.3).
    """
    mean = values.mean()
    _, index = torch.unique(block, return_inverse=True)
    blocks = int(index.max()) + 1 if len(index) else 0
    if blocks < 2:
        return float(mean), float("inf")
    sums = torch.zeros(blocks, dtype=values.dtype).index_add(0, index, values - mean)
    return float(mean), float((blocks / (blocks - 1) * (sums**2).sum()).sqrt() / len(values))


# How far single frames may have slid: the likelihood along the motion in which each is known least.
#
# A covariance holds where residuals grow in proportion to a motion. Where few details hold a frame, as the holes of a
# flange hold it about its axis, it leaves them after some tenths of a degree; farther on, look-ups contradict as they
# do anywhere, and the likelihood may rise again. So it is asked on both sides, 4, 8, 16... sigma away (a slice of the
# likelihood: Pawitan, In All Likelihood, 2001, section 3.4), of many pixels of the frame. A place s away whose
# look-ups are preferred by z standard errors counts exp(z s / sigma): on a parabola whose maximum has the standard
# error sigma, those of the right place would be preferred by s / (2 sigma).

_FIRST_SIGMAS = 4.0  # distance at which a frame is tried first; then twice as far each time
_PRIOR_SIGMAS = 2.0  # uncertainties of the starting pose up to which it is
_PARABOLA_SIGMAS = 6.0  # beyond which the parabola no longer holds: contradictions cost no more
_DECIDED = 7.0  # nats that look-ups say against both places: none farther off is tried
_CELL = 0.75  # of a distance, that a place stands for: half-way to those half as far and twice as far away


def with_slides(
    problem: SearchProblem, refine: RefinePoses, found: SearchProgress, factor: Float[Tensor, "joint k"],
    frames: list[int],
) -> Float[Tensor, "joint more"]:  # fmt: skip
    """The covariance's factor, wider by how far some of the frames may have slid, each by itself."""
    n, rig = found.state.rig.frames, found.state.rig
    directions, pixels = least_known_motions(problem, refine, found), many_pixels(problem)
    generator = torch.Generator().manual_seed(problem.settings.seed)
    allowed = partners(rig, found.state.anchors, problem.maps, PARTNERS, LEAST_COSINE, generator)
    motions = torch.zeros(len(frames), 2, n, 6, dtype=torch.float64)

    def slid(motion: Float[Tensor, "2 frames 6"], k: int) -> float:
        place = PlaceOfFrame.of(problem, rig, found.noise, k, pixels, allowed)
        sigma = float((motion.flatten() @ factor[: 12 * n]).norm())
        prior = float((directions[k] / problem.prior.sigma[k]).norm().reciprocal())
        return how_far(lambda d: place.lead_of(rig.moved(d * motion[0], d * motion[1])), sigma, prior)

    for motion, k in zip(motions, frames, strict=True):
        motion[:, k] = directions[k].reshape(2, 6)
    asked = [partial(slid, motion, k) for motion, k in zip(motions, frames, strict=True)]
    sizes = torch.tensor(results(asked), dtype=torch.float64)
    columns = (sizes[:, None] * motions.flatten(1)).mT[:, sizes > 0]
    return torch.cat([factor, torch.nn.functional.pad(columns, (0, 0, 0, len(factor) - 12 * n))], 1)


def many_pixels(problem: SearchProblem) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"]]:
    """Many decoded pixels of every frame: whose they are, and where."""
    generator = torch.Generator().manual_seed(problem.settings.seed)
    return problem.maps.draw(torch.arange(problem.start.frames), _FRAME_ANCHORS, generator)


@dataclass(frozen=True)
class PlaceOfFrame:
    """The place of one frame in a rig, with which its other places are compared.

    By the look-ups alone, of many decoded pixels of that frame, and of some of those of the others.
    """

    problem: SearchProblem
    noise: float  # of one look-up, projector pixels
    here: _End
    block: Int[Tensor, "anchors"]  # of an image, in which each is
    its: Bool[Tensor, "anchors"]  # those of the frame itself
    seen: MapSample  # what was decoded at these
    rays: tuple[Float[Tensor, "5 its 3"], Float[Tensor, "5 its 3"]]  # their `surface_rays`
    rows: Observations  # look-ups here

    @staticmethod
    def of(
        problem: SearchProblem, rig: Rig, noise: float, frame: int,
        pixels: tuple[Int[Tensor, "n"], Float[Tensor, "n 2"]], allowed: Bool[Tensor, "frames frames"],
    ) -> "PlaceOfFrame":  # fmt: skip
        """`pixels` are the `many_pixels` of all frames; `allowed` says which frames may look up anchors of which."""
        owner, uv = pixels
        chosen = owner == frame
        chosen[:: max(_OF_OTHERS, rig.frames)] = True
        owner, uv = owner[chosen], uv[chosen]
        seen = problem.maps.look_up(owner, uv)
        rays = surface_rays(rig, owner, uv, seen)
        here = _End(rig, *anchors_on(rig, owner, seen, rays))
        generator = torch.Generator().manual_seed(problem.settings.seed)
        own = torch.arange(rig.frames) == frame
        numbers = here.numbers(problem.maps, allowed & (own | own[:, None]), generator)
        rows = _some(rig.frames, numbers, _FRAME_LOOK_UPS, generator)
        its = owner == frame
        own_rays = rays[0][:, its], rays[1][:, its]
        return PlaceOfFrame(problem, noise, here, _blocks(owner, uv), its, seen.chosen(its), own_rays, rows)

    def lead_of(self, other: Rig) -> float:
        """By how many of its standard errors a rig in which that frame alone is elsewhere is more probable."""
        maps, there, its = self.problem.maps, self._moved(other), self.its
        own, cross, common = _gains(maps, [there, self.here], self.rows, self.noise)
        seen = visible_rows(other, there.anchors, self.rows, maps, LEAST_COSINE)[common]
        both = its & there.good & self.here.good
        block = torch.cat([self.block[both], self.block[self.rows.anchor[common][seen]]])
        mean, error = mean_and_error(torch.cat([own[both], cross[seen]]), block)
        return mean / error if error > 0 else 0.0

    def _moved(self, other: Rig) -> _End:
        """The same pixels as anchors of a rig in which that frame alone is elsewhere."""
        here, its = self.here, self.its
        anchors, good = anchors_on(other, here.anchors.frame[its], self.seen, self.rays)
        return _End(other, here.anchors.replaced(its, anchors), here.good.masked_scatter(its, good))


def least_known_motions(
    problem: SearchProblem, refine: RefinePoses, found: SearchProgress
) -> Float[Tensor, "frames 12"]:
    """Increment of unit length (scene units, radian) of each frame that its look-ups and its prior know least.

    By the slopes of the surface's normals, with the look-ups of a frame counted as few.
    """
    rig, maps = found.state.rig, problem.maps
    linear = linearise(rig, found.state.anchors, found.rows, maps, OWN_PLACE_PX)
    r = linear.residuals
    kernel = kernel_of(found.state, found.rows, found.widths, r)
    per_frame = float(r.cross_valid.sum()) / rig.frames
    prior = PriorTerm(problem.prior, problem.start, rough_weight(found.noise, per_frame, INDEPENDENT))
    H = normal_equations(linear, found.rows, *kernel.weights(r)).H + prior.equations(rig)[0]
    own = free_parameters(refine, rig).own
    least = torch.linalg.eigh(own.mT @ H @ own).eigenvectors[:, :, :1]
    return torch.nn.functional.normalize((own @ least)[..., 0], dim=1)


def how_far(lead: Callable[[float], float], sigma: float, prior: float) -> float:
    """RMS distance at which a frame may be along a motion, beyond its sigma there.

    `lead`: by how many standard errors look-ups prefer the place at a signed distance. `prior`: sigma of its start.
    """
    distance, mass, square = _FIRST_SIGMAS * sigma, (2 * pi) ** 0.5 * sigma, 0.0
    if not sigma:
        return 0.0
    while distance <= _PRIOR_SIGMAS * prior:
        said = [min(lead(d) * min(distance / sigma, _PARABOLA_SIGMAS), 0.0) for d in (distance, -distance)]
        for nats in said:
            cell = _CELL * distance * exp(nats - 0.5 * (distance / prior) ** 2)
            mass, square = mass + cell, square + cell * distance**2
        if max(said) < -_DECIDED:
            break
        distance *= 2
    return (square / mass) ** 0.5
