"""Weighted normal equations of the bundle adjustment; the depths of the anchors are eliminated (Schur complement).

Two frames are coupled where one sees an anchor of the other, or both see the same one: time and memory for the sums
grow with the number of residuals, only the matrix itself with the square of the number of frames.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.normal_equations import depth_couplings, depth_steps, frame_sums, mirror
from sl_nerfstudio.bundle_adjustment.residuals import Linearisation, Observations, array

Sums = tuple[ndarray, ndarray, ndarray, ndarray]
"""Residuals, derivatives by pose, derivatives by depth, weights."""


@dataclass(frozen=True)
class DepthCouplings:
    """The parts of the normal matrix that couple depths with other unknowns, and the depths' own."""

    by_own: Float64[ndarray, "anchors 12"]  # with the frame of the anchor
    by_row: Float64[ndarray, "rows 12"]  # with a frame that sees it
    by_common: Float64[ndarray, "anchors common"]
    H: Float64[ndarray, "anchors"]
    g: Float64[ndarray, "anchors"]
    rows: Groups  # of each anchor
    frame: Int[ndarray, "anchors"]
    viewer: Int[ndarray, "rows"]

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray]:
        """For compiled loops."""
        return self.by_own, self.by_row, self.by_common, self.H, self.g


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations of all unknowns except the depths, which are eliminated.

    Unknowns of a frame are delta, then rho; some unknowns may be common to all frames.
    """

    H: Float[Tensor, "m 12 m 12"]  # of the chosen frames, in order
    g: Float[Tensor, "m 12"]
    border: Float[Tensor, "m 12 common"]
    H_common: Float[Tensor, "common common"]
    g_common: Float[Tensor, "common"]
    depths: DepthCouplings

    def depth_step(
        self, step: Float[Tensor, "frames 12"], common: Float[Tensor, "common"] | None = None
    ) -> Float[Tensor, "anchors"]:
        """Change of the depths that follows from a step of the other unknowns."""
        d = self.depths
        out = np.empty(len(d.H))
        both = array(step), np.zeros(0) if common is None else array(common)
        depth_steps(len(out), (d.rows.first, d.rows.entries), d.frame, d.viewer, d.arrays, *both, out)
        return torch.from_numpy(out)


def normal_equations(
    linear: Linearisation,
    observations: Observations,
    own_weight: Float[Tensor, "anchors"],
    cross_weight: Float[Tensor, "rows"],
    chosen: Int[Tensor, "m"] | None = None,
) -> NormalEquations:
    """Weighted normal equations with the Schur complement of the depths; of all frames, or of some that are chosen."""
    frames, common = linear.frames, linear.common
    r, weights = linear.residuals, (own_weight, cross_weight)
    own: Sums = (array(r.own), array(linear.own), array(linear.own_depth), array(weights[0]))
    cross: Sums = (array(r.cross), array(linear.cross), array(linear.cross_depth), array(weights[1]))
    anchor, frame = array(observations.anchor), array(linear.own_frame)
    source, viewer = (array(part) for part in linear.cross_frames)
    depths = _couplings(own, cross, Groups.of(anchor, len(frame)), frame, viewer, common)
    frame_of = np.arange(frames) if chosen is None else array(chosen)
    slot = np.full(frames, -1)
    slot[frame_of] = np.arange(len(frame_of))
    m = len(frame_of)
    H, g, border = np.zeros((12 * m, 12 * m)), np.zeros((m, 12)), np.zeros((m, 12, common))
    groups = [Groups.of(frame, frames), Groups.of(viewer, frames), depths.rows]
    frame_sums(
        m, frame_of, slot, tuple(part for group in groups for part in (group.first, group.entries)),
        (anchor, source, viewer), own, cross, depths.arrays, H, g, border,
    )  # fmt: skip
    mirror(m, H)
    H_common, g_common = _of_common(own, cross, depths)
    return NormalEquations(
        *(torch.from_numpy(part) for part in (H.reshape(m, 12, m, 12), g, border, H_common, g_common)), depths
    )


def _couplings(
    own: Sums, cross: Sums, rows: Groups, frame: Int[ndarray, "anchors"], viewer: Int[ndarray, "rows"], common: int
) -> DepthCouplings:
    n = len(frame)
    parts = np.zeros((n, 12)), np.zeros((len(viewer), 12)), np.zeros((n, common)), np.zeros(n), np.zeros(n)
    depth_couplings(n, (rows.first, rows.entries), own, cross, *parts)
    return DepthCouplings(*parts, rows, frame, viewer)


def _of_common(
    own: Sums, cross: Sums, depths: DepthCouplings
) -> tuple[Float64[ndarray, "common common"], Float64[ndarray, "common"]]:
    """The equations of the unknowns that all frames share."""
    common = depths.by_common.shape[1]
    H, g = np.zeros((common, common)), np.zeros(common)
    if common:
        for (r, J, _, w), first in ((own, 6), (cross, 18)):
            shared = J[:, :, first:].reshape(-1, common)
            weighted = np.repeat(w, 2)[:, None] * shared
            H += weighted.T @ shared
            g += weighted.T @ r.reshape(-1)
        scaled = depths.by_common / depths.H[:, None]
        H -= scaled.T @ depths.by_common
        g -= scaled.T @ depths.g
    return H, g
