"""Weighted normal equations of the bundle adjustment; the depths of the anchors are eliminated (Schur complement).

Two frames are coupled where one sees an anchor of the other, or both see the same one. Time and memory grow with the
number of residuals; only the whole matrix, which many frames do without, grows with the square of their number.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.normal_equations import (
    depth_couplings,
    depth_steps,
    frame_products,
    frame_sums,
    mirror,
    pair_sums,
    row_products,
)
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

    def step(
        self, step: Float64[ndarray, "frames 12"], common: Float64[ndarray, "common"], g: Float64[ndarray, "anchors"]
    ) -> Float64[ndarray, "anchors"]:
        """Changes of the depths that follow from a step of the other unknowns, with `g` as the depths' gradient."""
        out, (by_own, by_row, by_common, H, _) = np.empty(len(self.H)), self.arrays
        couplings = by_own, by_row, by_common, H, g
        depth_steps(
            len(out), (self.rows.first, self.rows.entries), self.frame, self.viewer, couplings, step, common, out
        )
        return out


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations of all unknowns except the depths, which are eliminated.

    Unknowns of a frame are delta, then rho; some unknowns may be common to all frames. What couples different frames is
    not stored: `matrix` sums it, `times` multiplies with it.
    """

    chosen: Int[ndarray, "m"]  # the frames whose equations these are, in order
    H: Float[Tensor, "m 12 12"]  # blocks on the diagonal of the normal matrix
    g: Float[Tensor, "m 12"]
    border: Float[Tensor, "m 12 common"]
    H_common: Float[Tensor, "common common"]
    g_common: Float[Tensor, "common"]
    rows: tuple[ndarray, ndarray, ndarray]  # anchor of each row, its frame, the frame that sees it
    groups: tuple[ndarray, ...]  # anchors and rows of each frame, rows of each anchor
    own: Sums
    cross: Sums
    depths: DepthCouplings

    def matrix(
        self, prior: Float[Tensor, "m 12 12"], common: Float[Tensor, "common"]
    ) -> Float[Tensor, "unknowns unknowns"]:
        """The whole normal matrix, unknowns common to all frames last.

        Information about each frame alone is added, and `common` to the diagonal of the others.
        """
        m, frames, more = len(self.chosen), len(self.groups[0]) - 1, len(common)
        slot = np.full(frames, -1)
        slot[self.chosen] = np.arange(m)
        H = np.zeros((12 * m + more, 12 * m + more))
        if m > 1:
            pair_sums(m, self.chosen, slot, self.groups, self.rows, self.cross, self.depths.arrays, H)
            mirror(m, H)
        out, first = torch.from_numpy(H), 12 * m
        for k, block in enumerate(self.H + prior):
            out[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] = block
        out[:first, first:] = self.border.flatten(0, 1)
        out[first:, :first] = out[:first, first:].T
        out[first:, first:] = self.H_common + common.diag()
        return out

    def times(self, step: Float[Tensor, "frames 12"]) -> Float[Tensor, "frames 12"]:
        """The normal matrix of all frames times a step."""
        x, (anchor, source, viewer), d = array(step), self.rows, self.depths
        by_rows, out = np.empty((len(anchor), 2)), np.empty(x.shape)
        row_products(len(anchor), source, viewer, self.cross, x, by_rows)
        change = d.step(x, np.zeros(0), np.zeros(len(d.g)))
        frame_products(len(x), self.groups, anchor, self.own, self.cross, d.arrays, x, by_rows, change, out)
        return torch.from_numpy(out)

    def depth_step(self, step: Float[Tensor, "frames 12"]) -> Float[Tensor, "anchors"]:
        """Change of the depths that follows from a step of the poses."""
        return torch.from_numpy(self.depths.step(array(step), np.zeros(0), self.depths.g))


def normal_equations(
    linear: Linearisation,
    observations: Observations,
    own_weight: Float[Tensor, "anchors"],
    cross_weight: Float[Tensor, "rows"],
    chosen: Int[Tensor, "m"] | None = None,
) -> NormalEquations:
    """Weighted normal equations with the Schur complement of the depths; of all frames, or of some that are chosen."""
    frames, common = linear.frames, linear.common
    r = linear.residuals
    own: Sums = (array(r.own), array(linear.own), array(linear.own_depth), array(own_weight))
    cross: Sums = (array(r.cross), array(linear.cross), array(linear.cross_depth), array(cross_weight))
    anchor, frame = array(observations.anchor), array(linear.own_frame)
    source, viewer = (array(part) for part in linear.cross_frames)
    depths = _couplings(own, cross, Groups.of(anchor, len(frame)), frame, viewer, common)
    frame_of = np.arange(frames) if chosen is None else array(chosen)
    grouped = Groups.of(frame, frames), Groups.of(viewer, frames), depths.rows
    groups = tuple(part for group in grouped for part in (group.first, group.entries))
    m = len(frame_of)
    H, g, border = np.zeros((m, 12, 12)), np.zeros((m, 12)), np.zeros((m, 12, common))
    frame_sums(m, frame_of, groups, anchor, own, cross, depths.arrays, H, g, border)
    H_common, g_common = _of_common(own, cross, depths)
    return NormalEquations(
        frame_of, torch.from_numpy(H), torch.from_numpy(g), torch.from_numpy(border), torch.from_numpy(H_common),
        torch.from_numpy(g_common), (anchor, source, viewer), groups, own, cross, depths,
    )  # fmt: skip


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
