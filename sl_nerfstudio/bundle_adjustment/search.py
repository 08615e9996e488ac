"""One search for the poses: steps in stages with a narrowing kernel."""

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
    narrowed,
    noise_of,
    noise_ratios,
    observe,
    partners,
    place_anchors,
    useful_distance,
    with_common_normals,
)
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    PriorTerm,
    RefinePoses,
    free_parameters,
    rough_weight,
)
from sl_nerfstudio.bundle_adjustment.residuals import (
    OWN_PLACE_PX,
    Anchors,
    Observations,
    Residuals,
    Rig,
    linearise,
    pixels_of_rows,
    residuals_of,
)
from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.devices import project

FRAMES_MOVE = ("free", "rigid-rig", "known-rig")
"""What may be refined if single frames are to move by themselves."""

LEAST_COSINE = 0.1  # between surface normal and ray; below it a device counts as not seeing a point
PARTNERS = 64  # frames, about, in which anchors of one frame may be looked up: many frames take time by their number
_MORE_ANCHORS = 3  # times as many in the last steps
_LEAST_ANCHORS = 60  # of each frame, however many frames there are
_RIGID_ITERATIONS = 5  # steps in which frames move as a whole, before projectors move relative to their cameras
_OBSERVE_EVERY = 4  # steps between new choices of which frame sees which anchor
_NORMALS_EVERY = 8  # steps between new normals of the surface
INDEPENDENT = 50.0  # residuals of a frame that count as independent of each other while the poses are still rough
_KERNEL_MEDIANS = 2.0  # width that a frame's kernel narrows to, in its median residuals
_KERNEL_NOISES = 3.0  # smallest width, in estimated noises
_CONVERGED = 1e-4  # largest component of a step, scene units or radian, below which the poses have converged
_LEAST_GAIN = 1.0  # of a last step, squared noises, from which even small ones go on: each is a part of the way alone
_SETTLED = 0.98  # share of its last width above which a kernel counts as no longer narrowing

# Frames that agree with the others.
EVERY_FRAME_PER_ANCHOR = 16  # in which an anchor is looked up where every frame that may see it is asked
_JUDGED_ANCHORS = 200  # decoded pixels of each frame that are used
_INLIER_NOISES = 5.0  # largest residual that supports a pose
_LEAST_SUPPORT = 0.75  # share of residuals that support a frame's pose, relative to the median frame's


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
    further_searches: bool = True
    """Whether rough starts, and frames that agree with no others, are searched from more places than where they are."""
    other_minima: bool = True
    """Whether further searches show how far other minima are, if a result turns out to be one of several."""


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

    def observe(self, state: LMState) -> Observations:
        """A new choice of which frame looks up which anchor; no residual is too large to be used."""
        return observe(
            state.rig, state.anchors, self.maps, self.settings.frames_per_anchor, float("inf"), LEAST_COSINE,
            self.generator, self.partners,
        )  # fmt: skip


@dataclass(frozen=True)
class SearchProgress:
    """The current state of an adjustment."""

    state: LMState
    rows: Observations
    widths: Float[Tensor, "frames"]  # of each frame's kernel
    noise: float
    iterations: int
    alike: int = 1  # look-ups that share errors, and count as one against the prior

    @property
    def pairs(self) -> Int[Tensor, "2 rows"]:
        """Frame of the anchor, frame that looks it up."""
        return self.rows.pairs(self.state.anchors)


def kernel_of(state: LMState, rows: Observations, widths: Float[Tensor, "frames"], r: Residuals) -> Kernel:
    """The kernel with the noise that residuals have by how rough the coordinates are."""
    ratios = noise_ratios(r, state.anchors.roughness, rows.anchor)
    return Kernel(widths, state.anchors.frame, rows.pairs(state.anchors), ratios)


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
    return SearchProblem(start, begin, maps, prior, settings, generator, together, anchors)


@dataclass(frozen=True)
class SearchStage:
    """A part of the adjustment."""

    refine: RefinePoses
    rough: bool  # residuals still come from wrong poses: those of one frame are correlated and count as few
    iterations: int  # at most
    own_place_px: float = 0.0  # see `linearise`


def stages(refine: RefinePoses, settings: AdjustmentSettings) -> list[SearchStage]:
    """First frames move as a whole; then everything moves; then everything moves with all residuals at full weight.

    While poses are wrong, the thousands of residuals of a frame amount to only a few independent measurements. If they
    counted as thousands, they would overrule the prior along directions that they hardly determine, and the scene would
    drift.
    """
    found = [SearchStage(refine, True, _rough_steps(settings)), SearchStage(refine, False, settings.max_iterations)]
    if refine in ("free", "rigid-rig"):  # a static projector is already in place
        found.insert(0, SearchStage("known-rig", True, _RIGID_ITERATIONS))
    return found


def _rough_steps(settings: AdjustmentSettings) -> int:
    return max(settings.max_iterations // 2 - _RIGID_ITERATIONS, 1)


def run_stage(problem: SearchProblem, stage: SearchStage, found: SearchProgress) -> SearchProgress:
    """Take the steps of one stage, until nothing moves any more."""
    start, maps = problem.start, problem.maps
    found = replace(found, state=replace(found.state, damping=DAMPING))
    for iteration in track(range(stage.iterations), "Adjusting poses"):
        if stage.rough and iteration % _OBSERVE_EVERY == 0:
            found = replace(found, rows=problem.observe(found.state))
        if stage.own_place_px and iteration % _NORMALS_EVERY == 0:
            state = found.state
            anchors = with_common_normals(state.rig, state.anchors, found.rows, maps)
            found = replace(found, state=replace(state, anchors=anchors))
        linear = linearise(found.state.rig, found.state.anchors, found.rows, maps, stage.own_place_px)
        r = linear.residuals
        target = _KERNEL_MEDIANS * frame_medians(r, found.pairs, start.frames)
        noise = noise_of(r, float(torch.minimum(found.widths, target).min()))
        widths = narrowed(found.widths, target).clamp_min(_KERNEL_NOISES * noise)
        if stage.rough:  # residuals are those of wrong poses, and largest where there is most to see
            kernel = Kernel(widths, found.state.anchors.frame, found.pairs)
        else:
            kernel = kernel_of(found.state, found.rows, widths, r)
        per_frame = float(r.cross_valid.sum()) / start.frames
        weight = rough_weight(noise, per_frame, INDEPENDENT) if stage.rough else found.alike * noise**2
        prior = PriorTerm(problem.prior, start, weight)
        free = free_parameters(stage.refine, found.state.rig)
        state = lm_step(found.state, linear, found.rows, maps, kernel, prior, free)
        # a step may also be small because it was damped
        small = state.size < _CONVERGED and (state.damping < 1 or state.size == 0)
        if not (stage.rough or stage.own_place_px):  # by noisy slopes, whose noise counts as curvature
            small = small and state.gain < _LEAST_GAIN * weight
        settled = bool((widths >= _SETTLED * found.widths).all()) and small
        found = replace(found, state=state, widths=widths, noise=noise, iterations=found.iterations + 1)
        if settled:
            break
    return found


def unplaced_frames(rig: Rig, maps: CoordinateMaps, noise: float, settings: AdjustmentSettings) -> tuple[int, ...]:
    """Frames that see too little of the surface on which the others agree, in order."""
    generator = torch.Generator().manual_seed(settings.seed)
    anchors = place_anchors(rig, maps, _JUDGED_ANCHORS, generator)
    allowed = partners(rig, anchors, maps, PARTNERS, LEAST_COSINE, generator)
    rows = observe(rig, anchors, maps, EVERY_FRAME_PER_ANCHOR, float("inf"), LEAST_COSINE, generator, allowed)
    r, frames = residuals_of(rig, anchors, rows, maps), rows.pairs(anchors)
    inlier = r.cross_valid & (r.cross.norm(dim=-1) < _INLIER_NOISES * noise)
    agreeing, judged = (
        torch.bincount(frames[:, kept].flatten(), minlength=rig.frames) for kept in (inlier, r.cross_valid)
    )
    support = agreeing.double() / judged
    wrong = support.isnan() | (support < _LEAST_SUPPORT * support.nanmedian())
    return tuple(wrong.nonzero().squeeze(-1).tolist())


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
    found = _away_from_borders(problem, found)
    found = run_stage(problem, replace(last, iterations=max(settings.max_iterations - found.iterations, 1)), found)
    return found, before


def along_surface(problem: SearchProblem, refine: RefinePoses, found: SearchProgress) -> SearchProgress:
    """More steps from the end of a search, along directions in which the surface slides.

    There the noise of slopes looks like information, so steps by the slopes of single look-ups are a hundredth of what
    they should be. These are by the surface's normals.
    """
    here, found = _observed_anew(problem, problem.settings, found)
    return run_stage(here, SearchStage(refine, True, _rough_steps(problem.settings), OWN_PLACE_PX), found)


def with_more_anchors(problem: SearchProblem, refine: RefinePoses, found: SearchProgress) -> SearchProgress:
    """The last steps of a search, with so many decoded pixels that the choice of them hardly matters.

    First by the surface's normals, then by the slopes of single look-ups: details of the surface that are smaller than
    the windows of normals show in those alone.
    """
    s = problem.settings
    many = replace(s, anchors_per_frame=_MORE_ANCHORS * s.anchors_per_frame, max_anchors=_MORE_ANCHORS * s.max_anchors)
    here, found = _observed_anew(problem, many, found)
    found = _away_from_borders(here, replace(found, alike=_MORE_ANCHORS))
    for steps, own_place_px in ((s.max_iterations // 8, OWN_PLACE_PX), (s.max_iterations // 2, 0.0)):
        found = run_stage(here, SearchStage(refine, False, steps, own_place_px), found)
    return found


def _observed_anew(
    problem: SearchProblem, settings: AdjustmentSettings, found: SearchProgress
) -> tuple[SearchProblem, SearchProgress]:
    """The same search from where it has come to, with new anchors."""
    here = problem_of(problem.start, problem.maps, problem.prior, settings, found.state.rig)
    state = LMState(found.state.rig, here.anchors, DAMPING)
    return here, replace(found, state=state, rows=here.observe(state))


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
    size = r.cross.norm(dim=-1) / noise_ratios(r, anchors.roughness, rows.anchor)[1]
    nearer = torch.minimum(own[rows.anchor], seen)
    least = useful_distance(nearer[r.cross_valid], size[r.cross_valid])
    if least <= 0:
        return found
    least += min(least, maps.half_window)
    anchors, rows = away_from_borders(anchors, rows, (own, seen), least, state.rig.frames)
    return replace(found, state=replace(state, anchors=anchors), rows=rows)
