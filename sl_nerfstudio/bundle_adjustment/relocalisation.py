"""Frames that ended in a wrong minimum while the others agreed: each is placed again on its own.

With all other frames fixed, a frame has six unknowns and thousands of residuals. Starting with a wide kernel, and from
a few poses around its current one, it finds the surface that the others agree on.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses, of_one_frame
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import LMState, lm_step
from sl_nerfstudio.bundle_adjustment.observations import involving, observe, partners, place_anchors
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, PriorTerm, rough_weight
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel, frame_medians, narrowed
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings, RelocalisationSettings
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA


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
