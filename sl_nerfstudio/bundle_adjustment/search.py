"""One search: all stages, with frames that were lost on the way."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import LMState, lm_step
from sl_nerfstudio.bundle_adjustment.observations import (
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
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings, RelocalisationSettings
from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.devices import project
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA

# What a search is given, and how far it has come.

FRAMES_MOVE = ("free", "rigid-rig", "known-rig")
"""What may be refined if single frames are to move by themselves."""
_NO_GATE = float("inf")  # pixels: no residual is too large to be used


@dataclass(frozen=True)
class SearchProblem:
    """What does not change during an adjustment."""

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
        """A new choice of which frame looks up which anchor."""
        s = self.settings
        return observe(
            state.rig, state.anchors, self.maps, s.frames_per_anchor, _NO_GATE, s.least_cosine, self.generator,
            self.partners,
        )  # fmt: skip

    def again(self, start: Rig, begin: Rig, expected: Float[Tensor, "frames"]) -> "SearchProblem":
        """The same problem for another search, which expects that support of each frame."""
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
        """The same with some frames at other poses; the kernels of those frames are wide again."""
        widths = torch.where(moved, torch.full_like(self.widths, float("inf")), self.widths)
        return replace(self, state=replace(self.state, rig=rig), widths=widths)


def kernel_of(
    state: LMState, rows: Observations, widths: Float[Tensor, "frames"], r: Residuals, problem: SearchProblem
) -> Kernel:
    """The kernel with the noise that look-ups have by how obliquely a camera sees the surface."""
    cosine = viewing_cosines(state.rig, state.anchors, rows)
    ratio = noise_ratios(r, cosine, problem.settings.kernel)
    return Kernel(widths, state.anchors.frame, rows.pairs(state.anchors), ratio)


def problem_of(
    start: Rig, maps: CoordinateMaps, prior: PosePrior, settings: AdjustmentSettings, begin: Rig | None = None
) -> SearchProblem:
    """A search that begins at the starting poses, or elsewhere."""
    begin = start if begin is None else begin
    generator = torch.Generator().manual_seed(settings.seed)
    per_frame = min(settings.anchors_per_frame, settings.max_anchors // start.frames)
    per_frame = max(per_frame, min(settings.least_anchors_per_frame, settings.anchors_per_frame))
    anchors = place_anchors(begin, maps, per_frame, generator)
    together = partners(begin, anchors, maps, settings.partners, settings.least_cosine, generator)
    whatever = torch.full((start.frames,), float("inf"), dtype=torch.float64)
    return SearchProblem(start, begin, maps, prior, settings, generator, together, anchors, whatever)


# Steps that follow each other until nothing moves any more.


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
    rough = max(settings.max_iterations // 2 - settings.rigid_iterations, 1)
    found = [SearchStage(refine, True, rough), SearchStage(refine, False, settings.max_iterations)]
    if refine in ("free", "rigid-rig"):  # a static projector is already in place
        found.insert(0, SearchStage("known-rig", True, settings.rigid_iterations))
    return found


def run_stage(problem: SearchProblem, stage: SearchStage, found: SearchProgress) -> SearchProgress:
    """Take the steps of one stage, until nothing moves any more."""
    start, maps, s = problem.start, problem.maps, problem.settings
    found = replace(found, state=replace(found.state, damping=s.steps.damping))
    for iteration in track(range(stage.iterations), "Adjusting poses"):
        if stage.rough and iteration % s.observe_every == 0:
            found = replace(found, rows=problem.observe(found.state))
        linear = linearise(found.state.rig, found.state.anchors, found.rows, maps)
        r = linear.residuals
        target = s.kernel.medians * frame_medians(r, found.pairs, start.frames)
        noise = noise_of(r, float(torch.minimum(found.widths, target).min()), s.kernel)
        widths = narrowed(found.widths, target, s.kernel).clamp_min(s.kernel.noises * noise)
        kernel = kernel_of(found.state, found.rows, widths, r, problem)
        per_frame = float(r.cross_valid.sum()) / start.frames
        weight = rough_weight(noise, per_frame, s.independent_residuals) if stage.rough else noise**2
        prior = PriorTerm(problem.prior, start, weight)
        free = free_parameters(stage.refine, found.state.rig)
        state = lm_step(found.state, linear, found.rows, maps, kernel, prior, free, s.steps)
        # a step may also be small because it was damped
        small = state.size < s.steps.converged and (state.damping < 1 or state.size == 0)
        settled = bool((widths >= s.steps.settled * found.widths).all()) and small
        found = SearchProgress(state, found.rows, widths, noise, found.iterations + 1)
        if settled:
            break
    return found


# Frames that ended in a wrong minimum while the others agreed: each is placed again on its own.
#
# With all other frames fixed, a frame has six unknowns and thousands of residuals. Starting with a wide kernel, and
# from
# a few poses around its current one, it finds the surface that the others agree on.


@dataclass(frozen=True)
class _Problem:
    """What does not change during a search."""

    anchors: Anchors
    maps: CoordinateMaps
    start: Rig
    prior: PosePrior
    noise: float
    generator: torch.Generator
    settings: AdjustmentSettings
    projector_steps: int  # after those of the frame as a whole

    def support(self, rig: Rig, rows: Observations, anchors: Anchors) -> Float[Tensor, "frames"]:
        """See support_of."""
        return support_of(rig, anchors, rows, self.maps, self.settings.relocalisation.inlier_noises * self.noise)

    def rows(self, rig: Rig, around: int | None = None) -> Observations:
        """Anchors in other frames that may see them; with `around`, only of or in one frame."""
        return rows_of_all(rig, self.anchors, self.maps, self.settings, self.generator, around)


def rows_of_all(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    settings: AdjustmentSettings,
    generator: torch.Generator,
    around: int | None = None,
) -> Observations:
    """Every anchor in other frames that may see it."""
    most, cosine = settings.relocalisation.frames_per_anchor, settings.least_cosine
    if around is None:
        allowed = partners(rig, anchors, maps, settings.partners, cosine, generator)
    else:
        allowed = involving(around, rig.frames)
    return observe(rig, anchors, maps, most, float("inf"), cosine, generator, allowed)


def support_of(
    rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps, within_px: float
) -> Float[Tensor, "frames"]:
    """Share of residuals within the noise, of those each frame takes part in; NaN where there are none."""
    r = residuals_of(rig, anchors, rows, maps)
    inlier = r.cross_valid & (r.cross.norm(dim=-1) < within_px)
    counts = torch.zeros(2, rig.frames, dtype=torch.float64)
    for frame in rows.pairs(anchors):
        for k, counted in enumerate((inlier, r.cross_valid)):
            counts[k] += torch.bincount(frame[counted], minlength=rig.frames)
    return counts[0] / counts[1]


def frame_support(
    rig: Rig, maps: CoordinateMaps, noise: float, settings: AdjustmentSettings
) -> Float[Tensor, "frames"]:
    """Share of residuals within the noise of each frame, the same ones of the same poses; NaN where there are none."""
    s, generator = settings.relocalisation, torch.Generator().manual_seed(settings.seed)
    anchors = place_anchors(rig, maps, s.anchors_per_frame, generator)
    rows = rows_of_all(rig, anchors, maps, settings, generator)
    return support_of(rig, anchors, rows, maps, s.inlier_noises * noise)


def unplaced_frames(rig: Rig, maps: CoordinateMaps, noise: float, settings: AdjustmentSettings) -> tuple[int, ...]:
    """Frames that see too little of the surface on which the others agree, in order."""
    support = frame_support(rig, maps, noise, settings)
    wrong = support.isnan() | (support < settings.relocalisation.least_share * support.nanmedian())
    return tuple(wrong.nonzero().squeeze(-1).tolist())


def least_support(support: Float[Tensor, "frames"], settings: RelocalisationSettings) -> float:
    """The smallest support with which a frame counts as placed.

    It is some robust standard deviations below the median frame's, but always between two shares of that.
    """
    middle = support.nanmedian()
    sigma = MAD_TO_SIGMA * (support - middle).abs().nanmedian()
    return float((middle - settings.sigmas * sigma).clamp(settings.least_share * middle, settings.most_share * middle))


def find_lost_frames(support: Float[Tensor, "frames"], settings: RelocalisationSettings) -> Int[Tensor, "lost"]:
    """Frames with far less support than most others, those with the most support first."""
    lost = (support < least_support(support, settings)).nonzero().squeeze(-1)
    return lost[support[lost].argsort(descending=True)]


@dataclass(frozen=True)
class Relocalised:
    """What a search for lost frames has found."""

    rig: Rig
    found: tuple[int, ...]  # frames that the others support now
    in_vain: tuple[int, ...]  # frames that they do not, even where they are supported better than before


def relocalise(
    rig: Rig,
    start: Rig,
    maps: CoordinateMaps,
    prior: PosePrior,
    refine: RefinePoses,
    noise: float,
    generator: torch.Generator,
    settings: AdjustmentSettings,
    expected: Float[Tensor, "frames"],
) -> Relocalised:
    """The rig with lost frames moved to poses that the other frames support; a frame without a better pose stays.

    The search covers poses around the current one, as far as the prior is uncertain. If projectors are free, the frame
    starts with its original relative pose, because one that was adjusted at a wrong pose of the frame is useless.
    A frame with the support that is `expected` of it, or with enough of it, is not searched for.
    """
    s = settings.relocalisation
    relative_free = refine == "free"
    anchors = place_anchors(rig, maps, s.anchors_per_frame, generator)
    problem = _Problem(
        anchors, maps, start, prior, noise, generator, settings, s.projector_steps if relative_free else 0
    )
    support = problem.support(rig, problem.rows(rig), anchors)
    lost = find_lost_frames(support, s)
    placed = ~torch.isin(torch.arange(rig.frames), lost) & support.isfinite()
    searched = [k for k in lost.tolist() if support[k] < expected[k]]
    usual = least_support(support, s)
    for k in searched:
        enough = min(usual, float(expected[k]))
        best, best_support = rig, float(support[k]) + s.least_gain
        for attempt in range(s.starts):
            delta = torch.zeros(rig.frames, 6, dtype=torch.float64)
            if attempt:
                delta[k] = prior.sigma[k, :6] * torch.randn(6, generator=generator, dtype=torch.float64)
            relative = rig.T_camera_projector.clone()
            if relative_free:
                relative[k] = start.T_camera_projector[k]
            there = replace(rig, T_camera_projector=relative).moved(delta, torch.zeros_like(delta))
            found, found_support = _place_one(there, k, placed, problem)
            if found_support > best_support:
                best, best_support = found, found_support
            if best_support > enough:
                break
        rig = best
        placed[k] = best_support > enough
    return Relocalised(rig, tuple(k for k in searched if placed[k]), tuple(k for k in searched if not placed[k]))


def _place_one(rig: Rig, k: int, placed: Bool[Tensor, "frames"], problem: _Problem) -> tuple[Rig, float]:
    """Move frame k alone, first as a whole, then its projector too; returns the rig and the frame's support in it."""
    settings, n = problem.settings, rig.frames
    s = settings.relocalisation
    allowed = placed.clone()
    allowed[k] = True
    width = torch.full((n,), float("inf"), dtype=torch.float64)
    anchors, near = problem.anchors, _near(rig, k, allowed, problem)
    state = LMState(rig, anchors.chosen(near.number), settings.steps.damping)
    for step in range(s.frame_steps + problem.projector_steps):
        if step and step % s.observe_every == 0:
            anchors = anchors.at(anchors.depth.index_copy(0, near.number, state.anchors.depth))
            near = _near(state.rig, k, allowed, problem)
            state = replace(state, anchors=anchors.chosen(near.number))
        linear = linearise(state.rig, state.anchors, near.rows, problem.maps)
        if not linear.residuals.cross_valid.any():
            return rig, 0.0
        pair = near.rows.pairs(state.anchors)
        target = settings.kernel.medians * float(frame_medians(linear.residuals, pair, n)[k])
        width = narrowed(width, torch.full_like(width, target), settings.kernel)
        width = width.clamp_min(settings.kernel.noises * problem.noise)
        residuals = float(linear.residuals.cross_valid.sum())
        weight = rough_weight(problem.noise, residuals, settings.independent_residuals)
        term = PriorTerm(problem.prior, problem.start, weight)
        kernel = Kernel(width, state.anchors.frame, pair)
        free = of_one_frame(k, n, with_projector=step >= s.frame_steps)
        state = lm_step(state, linear, near.rows, problem.maps, kernel, term, free, settings.steps)
    near = _near(state.rig, k, allowed, problem)
    support = problem.support(state.rig, near.rows, problem.anchors.chosen(near.number))[k]
    return state.rig, float(support.nan_to_num())


@dataclass(frozen=True)
class _Near:
    """The part of the problem that changes while one frame moves alone."""

    number: Int[Tensor, "n"]  # of its anchors among all, in order: those of the frame and those that are looked up
    rows: Observations  # anchors of the frame in others, and of others in the frame


def _near(rig: Rig, k: int, allowed: Bool[Tensor, "frames"], problem: _Problem) -> _Near:
    """Residuals of frame k with the frames that are allowed; a random subset if there are too many."""
    rows, frame = problem.rows(rig, k), problem.anchors.frame
    chosen = (allowed[frame[rows.anchor]] & allowed[rows.frame]).nonzero().squeeze(-1)
    most = problem.settings.relocalisation.most_residuals
    chosen = chosen[torch.randperm(len(chosen), generator=problem.generator)[:most]]
    taking_part = frame == k
    taking_part[rows.anchor[chosen]] = True
    number = torch.cumsum(taking_part, 0) - 1
    return _Near(taking_part.nonzero().squeeze(-1), Observations(number[rows.anchor[chosen]], rows.frame[chosen]))


def search(problem: SearchProblem, refine: RefinePoses) -> tuple[SearchProgress, float] | None:
    """All stages, and the median residual at the beginning; None if there is nothing to search."""
    begin, settings = problem.begin, problem.settings
    state = LMState(begin, problem.anchors, settings.steps.damping)
    rows = problem.observe(state)
    r = residuals_of(begin, state.anchors, rows, problem.maps)
    if settings.max_iterations < 1 or not r.cross_valid.any():
        return None
    before = float(r.cross[r.cross_valid].norm(dim=-1).median())
    widths = torch.full((begin.frames,), float("inf"), dtype=torch.float64)
    found = SearchProgress(state, rows, widths, max(before, settings.kernel.noise_floor_px), 0)
    *rough, last = stages(refine, settings)
    for stage in rough:
        found = run_stage(problem, stage, found)
    found = _relocalised(problem, refine, rough[-1], found)
    found = _away_from_borders(problem, found)
    found = run_stage(problem, replace(last, iterations=max(settings.max_iterations - found.iterations, 1)), found)
    return found, before


def _away_from_borders(problem: SearchProblem, found: SearchProgress) -> SearchProgress:
    """Without look-ups so near to the border of what was decoded that their residuals are larger than usual.

    As wide a strip beside those falls away, too, if windows reach that far: their look-ups average over both.
    """
    state, maps, s = found.state, problem.maps, problem.settings.kernel
    anchors, rows = state.anchors, found.rows
    r = residuals_of(state.rig, anchors, rows, maps)
    frame = torch.cat([anchors.frame, rows.frame])
    uv_own = project(state.rig.camera[anchors.frame], anchors.d_camera)[0]
    uv = torch.cat([uv_own, pixels_of_rows(state.rig, anchors, rows)[0]])
    own, seen = maps.border_distance(frame, uv).tensor_split([len(uv_own)])
    size = r.cross.norm(dim=-1) / noise_ratios(r, viewing_cosines(state.rig, anchors, rows), s)
    nearer = torch.minimum(own[rows.anchor], seen)
    least = useful_distance(nearer[r.cross_valid], size[r.cross_valid], s)
    if least <= 0:
        return found
    least += min(least, maps.settings.half_window)
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
    for _ in range(problem.settings.relocalisation.rounds):
        again = relocalise(
            found.state.rig, problem.start, problem.maps, problem.prior, refine, found.noise, problem.generator,
            problem.settings, expected,
        )  # fmt: skip
        moved = (again.rig.T_world_camera != found.state.rig.T_world_camera).flatten(1).any(1)
        if not moved.any():
            break
        found = run_stage(problem, stage, found.at(again.rig, moved))
        if again.found:
            expected = problem.expected.clone()
        expected[list(again.in_vain)] = float("-inf")
    return found
