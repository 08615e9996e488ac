"""One search for the poses: steps in stages with a narrowing kernel; frames that were lost on the way placed again.

A frame that ended in a wrong minimum while the others agreed is placed on its own: with all others fixed it has six
unknowns and thousands of residuals. Starting with a wide kernel, and from a few poses around its current one, it finds
the surface that the others agree on.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import DAMPING, LMState, lm_step
from sl_nerfstudio.bundle_adjustment.observations import (
    NOISE_FLOOR_PX,
    Kernel,
    away_from_borders,
    frame_medians,
    involving,
    narrowed,
    noise_of,
    noise_ratios,
    observe,
    partners,
    place_anchors,
    useful_distance,
)
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    PriorTerm,
    RefinePoses,
    free_parameters,
    of_one_frame,
    rough_weight,
)
from sl_nerfstudio.bundle_adjustment.residuals import (
    Anchors,
    Observations,
    Residuals,
    Rig,
    linearise,
    pixels_of_rows,
    residuals_of,
    viewing_cosines,
)
from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.devices import project
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA

FRAMES_MOVE = ("free", "rigid-rig", "known-rig")
"""What may be refined if single frames are to move by themselves."""

LEAST_COSINE = 0.1  # between surface normal and ray; below it a device counts as not seeing a point
PARTNERS = 64  # frames, about, in which anchors of one frame may be looked up: many frames take time by their number
_LEAST_ANCHORS = 60  # of each frame, however many frames there are
_RIGID_ITERATIONS = 5  # steps in which frames move as a whole, before projectors move relative to their cameras
_OBSERVE_EVERY = 4  # steps between new choices of which frame sees which anchor
INDEPENDENT = 50.0  # residuals of a frame that count as independent of each other while the poses are still rough
_KERNEL_MEDIANS = 2.0  # width that a frame's kernel narrows to, in its median residuals
_KERNEL_NOISES = 3.0  # smallest width, in estimated noises
_CONVERGED = 1e-4  # largest component of a step, scene units or radian, below which the poses have converged
_SETTLED = 0.98  # share of its last width above which a kernel counts as no longer narrowing

# Frames that are lost.
_ROUNDS = 3  # of searching; frames that were found help to find the others
_LOST_ANCHORS = 200  # decoded pixels of each frame that are used
EVERY_FRAME_PER_ANCHOR = 16  # in which an anchor is looked up where every frame that may see it is asked
_MOST_RESIDUALS = 6000  # between one frame and all others
_STARTS = 12  # starting poses for a lost frame, drawn from the prior
_FRAME_STEPS = 10  # from each, in which the frame moves as a whole
_PROJECTOR_STEPS = 10  # after those, in which its projector moves, too
_LOST_OBSERVE_EVERY = 3
_INLIER_NOISES = 5.0  # largest residual that supports a pose
LEAST_GAIN = 0.01  # share of supporting residuals that a new pose must add to replace the old one
_LOST_SIGMAS = 4.0  # robust standard deviations below the median frame's support at which a frame is lost,
_LEAST_SHARE, _MOST_SHARE = 0.75, 0.95  # always below the first share of that, and never above the second


@dataclass(frozen=True)
class AdjustmentSettings:
    """Size of the bundle adjustment; the defaults suit object-sized scans."""

    anchors_per_frame: int = 600
    """Decoded pixels of each frame that are looked up in other frames."""
    max_anchors: int = 12000
    """Decoded pixels of all frames, at most: time grows with this number, accuracy with its square root."""
    frames_per_anchor: int = 8
    """Most other frames in which each of them is looked up."""
    max_iterations: int = 40
    """Most Levenberg-Marquardt steps."""
    seed: int = 0
    """Seed of the choice of pixels."""
    other_minima: int = 3
    """Searches from other starting poses if a result turns out to be one of several minima; 0: none."""
    hops: int = 12
    """Most further searches after rough starts, each begun beside the best end so far; 0: none."""
    lost_by_surface: bool = True
    """Whether frames that agree with no others after all searches are looked for by their surfaces."""


@dataclass(frozen=True)
class SearchProblem:
    """A search: the measurements, the prior, and where it begins."""

    start: Rig  # to which the prior belongs
    begin: Rig  # where the search begins
    maps: CoordinateMaps
    prior: PosePrior
    settings: AdjustmentSettings
    generator: torch.Generator
    partners: Bool[Tensor, "frames frames"]
    anchors: Anchors  # where they are at its beginning
    expected: Float[Tensor, "frames"]  # support of each frame with which it is not lost; -inf: it is never searched for

    def observe(self, state: LMState) -> Observations:
        """A new choice of which frame looks up which anchor; no residual is too large to be used."""
        return observe(
            state.rig, state.anchors, self.maps, self.settings.frames_per_anchor, float("inf"), LEAST_COSINE,
            self.generator, self.partners,
        )  # fmt: skip

    def again(self, start: Rig, begin: Rig, expected: Float[Tensor, "frames"]) -> "SearchProblem":
        """Another search with the same measurements, which expects that support of each frame."""
        return replace(problem_of(start, self.maps, self.prior, self.settings, begin), expected=expected)


@dataclass(frozen=True)
class SearchProgress:
    """The current state of an adjustment."""

    state: LMState
    rows: Observations
    widths: Float[Tensor, "frames"]  # of each frame's kernel
    noise: float
    iterations: int

    @property
    def pairs(self) -> Int[Tensor, "2 rows"]:
        """Frame of the anchor, frame that looks it up."""
        return self.rows.pairs(self.state.anchors)

    def at(self, rig: Rig, moved: Bool[Tensor, "frames"]) -> "SearchProgress":
        """Continue with some frames at other poses; the kernels of those frames are wide again."""
        widths = torch.where(moved, torch.full_like(self.widths, float("inf")), self.widths)
        return replace(self, state=replace(self.state, rig=rig), widths=widths)


def kernel_of(state: LMState, rows: Observations, widths: Float[Tensor, "frames"], r: Residuals) -> Kernel:
    """The kernel with the noise that look-ups have by how obliquely a camera sees the surface."""
    cosine = viewing_cosines(state.rig, state.anchors, rows)
    return Kernel(widths, state.anchors.frame, rows.pairs(state.anchors), noise_ratios(r, cosine))


def problem_of(
    start: Rig, maps: CoordinateMaps, prior: PosePrior, settings: AdjustmentSettings, begin: Rig | None = None
) -> SearchProblem:
    """A search that begins at the starting poses, or elsewhere."""
    begin = start if begin is None else begin
    generator = torch.Generator().manual_seed(settings.seed)
    per_frame = min(settings.anchors_per_frame, settings.max_anchors // start.frames)
    per_frame = max(per_frame, min(_LEAST_ANCHORS, settings.anchors_per_frame))
    anchors = place_anchors(begin, maps, per_frame, generator)
    together = partners(begin, anchors, maps, PARTNERS, LEAST_COSINE, generator)
    whatever = torch.full((start.frames,), float("inf"), dtype=torch.float64)
    return SearchProblem(start, begin, maps, prior, settings, generator, together, anchors, whatever)


@dataclass(frozen=True)
class SearchStage:
    """A part of the adjustment."""

    refine: RefinePoses
    rough: bool  # residuals still come from wrong poses: those of one frame are correlated and count as few
    iterations: int  # at most


def stages(refine: RefinePoses, settings: AdjustmentSettings) -> list[SearchStage]:
    """First frames move as a whole; then everything moves; then everything moves with all residuals at full weight.

    While poses are wrong, the thousands of residuals of a frame amount to only a few independent measurements. If they
    counted as thousands, they would overrule the prior along directions that they hardly determine, and the scene would
    drift.
    """
    rough = max(settings.max_iterations // 2 - _RIGID_ITERATIONS, 1)
    found = [SearchStage(refine, True, rough), SearchStage(refine, False, settings.max_iterations)]
    if refine in ("free", "rigid-rig"):  # a static projector is already in place
        found.insert(0, SearchStage("known-rig", True, _RIGID_ITERATIONS))
    return found


def run_stage(problem: SearchProblem, stage: SearchStage, found: SearchProgress) -> SearchProgress:
    """Take the steps of one stage, until nothing moves any more."""
    start, maps = problem.start, problem.maps
    found = replace(found, state=replace(found.state, damping=DAMPING))
    for iteration in track(range(stage.iterations), "Adjusting poses"):
        if stage.rough and iteration % _OBSERVE_EVERY == 0:
            found = replace(found, rows=problem.observe(found.state))
        linear = linearise(found.state.rig, found.state.anchors, found.rows, maps)
        r = linear.residuals
        target = _KERNEL_MEDIANS * frame_medians(r, found.pairs, start.frames)
        noise = noise_of(r, float(torch.minimum(found.widths, target).min()))
        widths = narrowed(found.widths, target).clamp_min(_KERNEL_NOISES * noise)
        kernel = kernel_of(found.state, found.rows, widths, r)
        per_frame = float(r.cross_valid.sum()) / start.frames
        weight = rough_weight(noise, per_frame, INDEPENDENT) if stage.rough else noise**2
        prior = PriorTerm(problem.prior, start, weight)
        free = free_parameters(stage.refine, found.state.rig)
        state = lm_step(found.state, linear, found.rows, maps, kernel, prior, free)
        # a step may also be small because it was damped
        small = state.size < _CONVERGED and (state.damping < 1 or state.size == 0)
        settled = bool((widths >= _SETTLED * found.widths).all()) and small
        found = SearchProgress(state, found.rows, widths, noise, found.iterations + 1)
        if settled:
            break
    return found


def rows_of_all(
    rig: Rig, anchors: Anchors, maps: CoordinateMaps, generator: torch.Generator, around: int | None = None
) -> Observations:
    """Every anchor in other frames that may see it; with `around`, only anchors of or in one frame."""
    if around is None:
        allowed = partners(rig, anchors, maps, PARTNERS, LEAST_COSINE, generator)
    else:
        allowed = involving(around, rig.frames)
    return observe(rig, anchors, maps, EVERY_FRAME_PER_ANCHOR, float("inf"), LEAST_COSINE, generator, allowed)


def support_of(
    rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps, noise: float
) -> Float[Tensor, "frames"]:
    """Share of residuals within the noise, of those each frame takes part in; NaN where there are none."""
    r = residuals_of(rig, anchors, rows, maps)
    inlier = r.cross_valid & (r.cross.norm(dim=-1) < _INLIER_NOISES * noise)
    counts = torch.zeros(2, rig.frames, dtype=torch.float64)
    for frame in rows.pairs(anchors):
        for k, counted in enumerate((inlier, r.cross_valid)):
            counts[k] += torch.bincount(frame[counted], minlength=rig.frames)
    return counts[0] / counts[1]


def frame_support(
    rig: Rig, maps: CoordinateMaps, noise: float, settings: AdjustmentSettings
) -> Float[Tensor, "frames"]:
    """Share of residuals within the noise of each frame, the same ones of the same poses; NaN where there are none."""
    generator = torch.Generator().manual_seed(settings.seed)
    anchors = place_anchors(rig, maps, _LOST_ANCHORS, generator)
    return support_of(rig, anchors, rows_of_all(rig, anchors, maps, generator), maps, noise)


def unplaced_frames(rig: Rig, maps: CoordinateMaps, noise: float, settings: AdjustmentSettings) -> tuple[int, ...]:
    """Frames that see too little of the surface on which the others agree, in order."""
    support = frame_support(rig, maps, noise, settings)
    wrong = support.isnan() | (support < _LEAST_SHARE * support.nanmedian())
    return tuple(wrong.nonzero().squeeze(-1).tolist())


def least_support(support: Float[Tensor, "frames"]) -> float:
    """The smallest support with which a frame counts as placed.

    It is some robust standard deviations below the median frame's, but always between two shares of that.
    """
    middle = support.nanmedian()
    sigma = MAD_TO_SIGMA * (support - middle).abs().nanmedian()
    return float((middle - _LOST_SIGMAS * sigma).clamp(_LEAST_SHARE * middle, _MOST_SHARE * middle))


def find_lost_frames(support: Float[Tensor, "frames"]) -> Int[Tensor, "lost"]:
    """Frames with far less support than most others, those with the most support first."""
    lost = (support < least_support(support)).nonzero().squeeze(-1)
    return lost[support[lost].argsort(descending=True)]


@dataclass(frozen=True)
class Relocalised:
    """Result of a search for lost frames."""

    rig: Rig
    found: tuple[int, ...]  # frames that the others support now
    in_vain: tuple[int, ...]  # frames that they do not, even where they are supported better than before


def relocalise(
    problem: SearchProblem, refine: RefinePoses, rig: Rig, noise: float, expected: Float[Tensor, "frames"]
) -> Relocalised:
    """The rig with lost frames moved to poses that the other frames support; a frame without a better pose stays.

    The search covers poses around the current one, as far as the prior is uncertain. If projectors are free, the frame
    starts with its original relative pose, because one that was adjusted at a wrong pose of the frame is useless.
    A frame with the support that is `expected` of it, or with enough of it, is not searched for.
    """
    maps, prior, generator = problem.maps, problem.prior, problem.generator
    anchors = place_anchors(rig, maps, _LOST_ANCHORS, generator)
    support = support_of(rig, anchors, rows_of_all(rig, anchors, maps, generator), maps, noise)
    lost = find_lost_frames(support)
    placed = ~torch.isin(torch.arange(rig.frames), lost) & support.isfinite()
    searched = [k for k in lost.tolist() if support[k] < expected[k]]
    usual = least_support(support)
    for k in searched:
        enough = min(usual, float(expected[k]))
        best, best_support = rig, float(support[k]) + LEAST_GAIN
        for attempt in range(_STARTS):
            delta = torch.zeros(rig.frames, 6, dtype=torch.float64)
            if attempt:
                delta[k] = prior.sigma[k, :6] * torch.randn(6, generator=generator, dtype=torch.float64)
            relative = rig.T_camera_projector.clone()
            if refine == "free":
                relative[k] = problem.start.T_camera_projector[k]
            there = replace(rig, T_camera_projector=relative).moved(delta, torch.zeros_like(delta))
            found, found_support = _place_one(problem, refine, there, anchors, k, placed, noise)
            if found_support > best_support:
                best, best_support = found, found_support
            if best_support > enough:
                break
        rig = best
        placed[k] = best_support > enough
    return Relocalised(rig, tuple(k for k in searched if placed[k]), tuple(k for k in searched if not placed[k]))


def _place_one(
    problem: SearchProblem, refine: RefinePoses, rig: Rig, all_anchors: Anchors, k: int, placed: Bool[Tensor, "frames"],
    noise: float,
) -> tuple[Rig, float]:  # fmt: skip
    """Move frame k alone, first as a whole, then its projector too; returns the rig and the frame's support in it."""
    n, maps = rig.frames, problem.maps
    allowed = placed.clone()
    allowed[k] = True

    def rows_near(rig: Rig) -> tuple[Int[Tensor, "n"], Observations]:
        """Numbers of anchors that take part, and their rows; a random subset of these if there are too many."""
        rows, frame = rows_of_all(rig, all_anchors, maps, problem.generator, k), all_anchors.frame
        chosen = (allowed[frame[rows.anchor]] & allowed[rows.frame]).nonzero().squeeze(-1)
        chosen = chosen[torch.randperm(len(chosen), generator=problem.generator)[:_MOST_RESIDUALS]]
        taking_part = frame == k
        taking_part[rows.anchor[chosen]] = True
        number = torch.cumsum(taking_part, 0) - 1
        return taking_part.nonzero().squeeze(-1), Observations(number[rows.anchor[chosen]], rows.frame[chosen])

    width = torch.full((n,), float("inf"), dtype=torch.float64)
    anchors, (number, rows) = all_anchors, rows_near(rig)
    state = LMState(rig, anchors.chosen(number), DAMPING)
    for step in range(_FRAME_STEPS + (_PROJECTOR_STEPS if refine == "free" else 0)):
        if step and step % _LOST_OBSERVE_EVERY == 0:
            anchors = anchors.at(anchors.depth.index_copy(0, number, state.anchors.depth))
            number, rows = rows_near(state.rig)
            state = replace(state, anchors=anchors.chosen(number))
        linear = linearise(state.rig, state.anchors, rows, maps)
        if not linear.residuals.cross_valid.any():
            return rig, 0.0
        pair = rows.pairs(state.anchors)
        target = _KERNEL_MEDIANS * float(frame_medians(linear.residuals, pair, n)[k])
        width = narrowed(width, torch.full_like(width, target)).clamp_min(_KERNEL_NOISES * noise)
        weight = rough_weight(noise, float(linear.residuals.cross_valid.sum()), INDEPENDENT)
        term = PriorTerm(problem.prior, problem.start, weight)
        kernel = Kernel(width, state.anchors.frame, pair)
        free = of_one_frame(k, n, with_projector=step >= _FRAME_STEPS)
        state = lm_step(state, linear, rows, maps, kernel, term, free)
    number, rows = rows_near(state.rig)
    support = support_of(state.rig, all_anchors.chosen(number), rows, maps, noise)[k]
    return state.rig, float(support.nan_to_num())


def search(problem: SearchProblem, refine: RefinePoses) -> tuple[SearchProgress, float] | None:
    """All stages, and the median residual at the beginning; None if there is nothing to search."""
    begin, settings = problem.begin, problem.settings
    state = LMState(begin, problem.anchors, DAMPING)
    rows = problem.observe(state)
    r = residuals_of(begin, state.anchors, rows, problem.maps)
    if settings.max_iterations < 1 or not r.cross_valid.any():
        return None
    before = float(r.cross[r.cross_valid].norm(dim=-1).median())
    widths = torch.full((begin.frames,), float("inf"), dtype=torch.float64)
    found = SearchProgress(state, rows, widths, max(before, NOISE_FLOOR_PX), 0)
    *rough, last = stages(refine, settings)
    for stage in rough:
        found = run_stage(problem, stage, found)
    found = _relocalised(problem, refine, rough[-1], found)
    found = _away_from_borders(problem, found)
    found = run_stage(problem, replace(last, iterations=max(settings.max_iterations - found.iterations, 1)), found)
    return found, before


def _away_from_borders(problem: SearchProblem, found: SearchProgress) -> SearchProgress:
    """Leave out look-ups so near to the border of what was decoded that their residuals are larger than usual.

    As wide a strip beside those falls away, too, if windows reach that far: their look-ups average over both.
    """
    state, maps = found.state, problem.maps
    anchors, rows = state.anchors, found.rows
    r = residuals_of(state.rig, anchors, rows, maps)
    frame = torch.cat([anchors.frame, rows.frame])
    uv_own = project(state.rig.camera[anchors.frame], anchors.d_camera)[0]
    uv = torch.cat([uv_own, pixels_of_rows(state.rig, anchors, rows)[0]])
    own, seen = maps.border_distance(frame, uv).tensor_split([len(uv_own)])
    size = r.cross.norm(dim=-1) / noise_ratios(r, viewing_cosines(state.rig, anchors, rows))
    nearer = torch.minimum(own[rows.anchor], seen)
    least = useful_distance(nearer[r.cross_valid], size[r.cross_valid])
    if least <= 0:
        return found
    least += min(least, maps.half_window)
    anchors, rows = away_from_borders(anchors, rows, (own, seen), least, state.rig.frames)
    return replace(found, state=replace(state, anchors=anchors), rows=rows)


def _relocalised(
    problem: SearchProblem, refine: RefinePoses, stage: SearchStage, found: SearchProgress
) -> SearchProgress:
    """Place lost frames again and adjust everything with them, until no frame moves any more.

    A frame that was searched for in vain is searched for again only when others were found.
    """
    if refine not in FRAMES_MOVE:
        return found
    expected = problem.expected.clone()
    for _ in range(_ROUNDS):
        again = relocalise(problem, refine, found.state.rig, found.noise, expected)
        moved = (again.rig.T_world_camera != found.state.rig.T_world_camera).flatten(1).any(1)
        if not moved.any():
            break
        found = run_stage(problem, stage, found.at(again.rig, moved))
        if again.found:
            expected = problem.expected.clone()
        expected[list(again.in_vain)] = float("-inf")
    return found
