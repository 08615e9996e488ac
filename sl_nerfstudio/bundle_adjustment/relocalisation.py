"""Frames that ended in a wrong minimum while the others agreed: each is led home by itself.

With all other frames held, a frame is six unknowns and thousands of residuals: from a wide kernel, and from a few
places around where it stands, it finds the surface that the others agree on.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import LMState, PriorTerm, lm_step
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations, rough_trust
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, Rig, linearise, residuals_of
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel, frame_medians, narrowed

_BLIND, _HAIR = 0.75, 0.95  # of the share of residuals within the noise that frames have in the middle
_BETTER = 0.02  # more residuals within the noise, as a share: a better place
_INLIER = 5.0  # times the noise
_STEPS_AS_A_WHOLE, _STEPS = 10, 10
_ANCHORS = 200  # of each frame
_ROWS = 6000  # at most, of one frame with all others
_TRIES = 12  # places from which a frame is led home


@dataclass(frozen=True)
class _Scene:
    """What residuals are measured with."""

    anchors: Anchors
    maps: CoordinateMaps
    noise: float
    generator: torch.Generator
    steps_with_projector: int  # after those of the frame as a whole

    def shares(self, rig: Rig, rows: Observations) -> Float[Tensor, "frames"]:
        """Share of residuals within the noise, of what each frame takes part in; NaN where that is nothing."""
        r = residuals_of(rig, self.anchors, rows, self.maps)
        inlier = r.cross.norm(dim=-1) < _INLIER * self.noise
        out = torch.full((rig.frames,), float("nan"), dtype=torch.float64)
        for k in range(rig.frames):
            mine = r.cross_valid & self.part_of(rows, k)
            if mine.any():
                out[k] = inlier[mine].double().mean()
        return out

    def part_of(self, rows: Observations, k: int) -> Bool[Tensor, "rows"]:
        """Rows that a frame takes part in."""
        return (self.anchors.frame[rows.anchor] == k) | (rows.frame == k)

    def rows(self, rig: Rig, around: int | None = None) -> Observations:
        """Every anchor in every other frame that may see it."""
        return observe(rig, self.anchors, self.maps, rig.frames, float("inf"), self.generator, around)


def least_share(shares: Float[Tensor, "frames"]) -> float:
    """The share of residuals within the noise from which on a frame is where it belongs.

    Four robust sigmas below the frames in the middle, but neither hair-splitting nor blind.
    """
    middle = shares.nanmedian()
    sigma = 1.4826 * (shares - middle).abs().nanmedian()
    return float((middle - 4 * sigma).clamp(_BLIND * middle, _HAIR * middle))


def find_lost_frames(shares: Float[Tensor, "frames"]) -> Int[Tensor, "strays"]:
    """Frames with far fewer residuals within the noise than most, the best of them first."""
    astray = (shares < least_share(shares)).nonzero().squeeze(-1)
    return astray[shares[astray].argsort(descending=True)]


def relocalise(
    rig: Rig,
    start: Rig,
    maps: CoordinateMaps,
    prior: PosePrior,
    refine: RefinePoses,
    noise: float,
    generator: torch.Generator,
) -> Rig:
    """The rig with strays moved to where the other frames want them; who finds no better place stays.

    A stray is looked for around where it stands, as far as the prior is uncertain of frames, with the relative pose it
    started with: what was made of that in a wrong place is worth nothing. (Where the mode leaves projectors free.)
    """
    alone = refine == "free"
    scene = _Scene(place_anchors(rig, maps, _ANCHORS, generator), maps, noise, generator, _STEPS if alone else 0)
    shares = scene.shares(rig, scene.rows(rig))
    strays = find_lost_frames(shares)
    settled = ~torch.isin(torch.arange(rig.frames), strays) & shares.isfinite()
    enough = least_share(shares)
    for k in strays.tolist():
        best, best_share = rig, float(shares[k]) + _BETTER
        sigma = torch.cat([prior.frame_translation[k].expand(3), prior.frame_rotation[k].expand(3)])
        for attempt in range(_TRIES):
            delta = torch.zeros(rig.frames, 6, dtype=torch.float64)
            if attempt:
                delta[k] = sigma * torch.randn(6, generator=generator, dtype=torch.float64)
            relative = rig.T_camera_projector.clone()
            if alone:
                relative[k] = start.T_camera_projector[k]
            there = replace(rig, T_camera_projector=relative).moved(delta, torch.zeros_like(delta))
            found, share = _settle(there, k, settled, start, prior, scene)
            if share > best_share:
                best, best_share = found, share
            if best_share > enough:
                break
        rig = best
        settled[k] = best_share > enough
    return rig


def _settle(
    rig: Rig, k: int, settled: Bool[Tensor, "frames"], start: Rig, prior: PosePrior, scene: _Scene
) -> tuple[Rig, float]:
    """Move frame k alone, as a whole, then its projector too; and the share of its residuals within the noise."""
    n = rig.frames
    B = torch.zeros(12 * n, 12, dtype=torch.float64)
    B[6 * k : 6 * k + 6, :6] = B[6 * (n + k) : 6 * (n + k) + 6, 6:] = torch.eye(6, dtype=torch.float64)
    allowed = settled.clone()
    allowed[k] = True
    width = torch.full((n,), float("inf"), dtype=torch.float64)
    state = LMState(rig, scene.anchors)
    for step in range(_STEPS_AS_A_WHOLE + scene.steps_with_projector):
        if step % 3 == 0:
            rows = _rows_of(state.rig, k, allowed, scene)
        linear = linearise(state.rig, state.anchors, rows, scene.maps)
        if not linear.residuals.cross_valid.any():
            return rig, 0.0
        pair = rows.pairs(scene.anchors)
        median = frame_medians(linear.residuals, pair, n)[k]
        width = narrowed(width, torch.full_like(width, 2 * float(median))).clamp_min(3 * scene.noise)
        H, g = prior_equations(prior, start, state.rig)
        trust = rough_trust(scene.noise, float(linear.residuals.cross_valid.sum()))
        kernel = Kernel(width, scene.anchors.frame, pair)
        free = B[:, :6] if step < _STEPS_AS_A_WHOLE else B
        state = lm_step(state, linear, rows, scene.maps, kernel, free, PriorTerm(trust * H, trust * g))
    return state.rig, float(scene.shares(state.rig, _rows_of(state.rig, k, allowed, scene))[k].nan_to_num())


def _rows_of(rig: Rig, k: int, allowed: Bool[Tensor, "frames"], scene: _Scene) -> Observations:
    rows = scene.rows(rig, k)
    mine = allowed[scene.anchors.frame[rows.anchor]] & allowed[rows.frame]
    chosen = mine.nonzero().squeeze(-1)
    chosen = chosen[torch.randperm(len(chosen), generator=scene.generator)[:_ROWS]]
    return Observations(rows.anchor[chosen], rows.frame[chosen])
