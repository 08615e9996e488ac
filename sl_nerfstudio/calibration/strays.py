"""Frames that ended in a wrong minimum while the others agreed: each is led home by itself.

With all other frames held, a frame is six unknowns and thousands of residuals: from a wide kernel, and from a few
places around where it stands, it finds the surface that the others agree on.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.calibration.coordinate_maps import CoordinateMaps
from sl_nerfstudio.calibration.kernel import Kernel, frame_medians, narrowed
from sl_nerfstudio.calibration.linearisation import Anchors, Observations, Rig, linearise, residuals_of
from sl_nerfstudio.calibration.observations import observe, place_anchors
from sl_nerfstudio.calibration.steps import Descent, descend

_FEW_INLIERS = 0.75  # of the share of residuals within the noise that frames have in the middle: astray
_HOME = 0.9  # of that share: the frame is where it belongs
_INLIER = 5.0  # times the noise
_STEPS = 14
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


def find_strays(shares: Float[Tensor, "frames"]) -> Int[Tensor, "strays"]:
    """Frames with far fewer residuals within the noise than most, the best of them first."""
    astray = (shares < _FEW_INLIERS * shares.nanmedian()).nonzero().squeeze(-1)
    return astray[shares[astray].argsort(descending=True)]


def lead_home(
    rig: Rig,
    maps: CoordinateMaps,
    noise: float,
    rotation: Float[Tensor, "frames"],
    translation: Float[Tensor, "frames"],
    generator: torch.Generator,
) -> Rig:
    """The rig with strays moved, as wholes, to where the other frames want them; who finds no better place stays.

    `rotation` (radian) and `translation` (scene units), 1 sigma per axis, say how far from where it stands a frame is
    looked for.
    """
    scene = _Scene(place_anchors(rig, maps, _ANCHORS, generator), maps, noise, generator)
    shares = scene.shares(rig, scene.rows(rig))
    strays = find_strays(shares)
    settled = ~torch.isin(torch.arange(rig.frames), strays) & shares.isfinite()
    enough = _HOME * float(shares.nanmedian())
    for k in strays.tolist():
        best, best_share = rig, float(shares[k])
        for attempt in range(_TRIES):
            sigma = torch.cat([translation[k].expand(3), rotation[k].expand(3)]) * (attempt > 0)
            delta = torch.zeros(rig.frames, 6, dtype=torch.float64)
            delta[k] = sigma * torch.randn(6, generator=generator, dtype=torch.float64)
            found, share = _settle(rig.moved(delta, torch.zeros_like(delta)), k, settled, scene)
            if share > best_share:
                best, best_share = found, share
            if best_share > enough:
                break
        rig = best
        settled[k] = best_share > enough
    return rig


def _settle(rig: Rig, k: int, settled: Bool[Tensor, "frames"], scene: _Scene) -> tuple[Rig, float]:
    """Move frame k alone; the rig and the share of the frame's residuals that end within the noise."""
    B = torch.zeros(12 * rig.frames, 6, dtype=torch.float64)
    B[6 * k : 6 * k + 6] = torch.eye(6, dtype=torch.float64)
    allowed = settled.clone()
    allowed[k] = True
    width = torch.full((rig.frames,), float("inf"), dtype=torch.float64)
    state = Descent(rig, scene.anchors)
    for step in range(_STEPS):
        if step % 3 == 0:
            rows = _rows_of(state.rig, k, allowed, scene)
            if not len(rows.anchor):
                return rig, 0.0
        pair = torch.stack([scene.anchors.frame[rows.anchor], rows.frame])
        linear = linearise(state.rig, state.anchors, rows, scene.maps)
        if not linear.residuals.cross_valid.any():
            return rig, 0.0
        median = frame_medians(linear.residuals, pair, rig.frames)[k]
        width = narrowed(width, torch.full_like(width, 2 * float(median))).clamp_min(3 * scene.noise)
        state = descend(state, linear, rows, scene.maps, Kernel(width, scene.anchors.frame, pair), B)
    rows = _rows_of(state.rig, k, allowed, scene)
    return state.rig, float(scene.shares(state.rig, rows)[k].nan_to_num())


def _rows_of(rig: Rig, k: int, allowed: Bool[Tensor, "frames"], scene: _Scene) -> Observations:
    rows = scene.rows(rig, k)
    mine = allowed[scene.anchors.frame[rows.anchor]] & allowed[rows.frame]
    chosen = mine.nonzero().squeeze(-1)
    chosen = chosen[torch.randperm(len(chosen), generator=scene.generator)[:_ROWS]]
    return Observations(rows.anchor[chosen], rows.frame[chosen])
