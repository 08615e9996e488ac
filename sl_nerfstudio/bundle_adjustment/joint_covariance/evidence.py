"""Residuals at the result of an adjustment, and their gradient by blocks of images."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.joint_covariance.draws import DRAWS, is_exact, unit_columns
from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.normal_equations import block_sums
from sl_nerfstudio.bundle_adjustment.normal_equations import DepthCouplings
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, array, pixels_of_rows
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel
from sl_nerfstudio.geometry.devices import project

_FRAMES_AT_ONCE = 16  # whose blocks are summed together: bounds memory


@dataclass(frozen=True)
class Evidence:
    """Residuals at the result, with their weights and derivatives (including those by the intrinsics)."""

    rig: Rig
    anchors: Anchors
    rows: Observations
    linear: Linearisation
    smooth: Linearisation  # the same with derivatives of wide windows, where there are any
    kernel: Kernel
    image_blocks: int  # along each side of the decoded part of an image
    least_curvature: float  # of the kernel

    @property
    def blocks(self) -> int:
        """Number of blocks of all images."""
        return self.rig.frames * self.image_blocks**2


@dataclass(frozen=True)
class BlockGradients:
    """Gradients whose squares add up to those of all blocks of images, or on average do."""

    columns: Float[Tensor, "unknowns c"]
    blocks: int  # that hold any residual


def block_gradients(e: Evidence, depths: DepthCouplings, weights: tuple[Tensor, Tensor]) -> BlockGradients:
    """Of small scans one column for each block, of large ones sums of all blocks with random signs."""
    groups = tuple(Groups.of(array(block), e.blocks) for block in _blocks_of(e))
    r, unknowns, blocks = e.linear.residuals, e.linear.unknowns, 0
    own, cross = (
        (array(w[:, None] * value), array(J), array(by_depth))
        for w, value, J, by_depth in (
            (weights[0], r.own, e.linear.own, e.linear.own_depth),
            (weights[1], r.cross, e.linear.cross, e.linear.cross_depth),
        )
    )
    indices = tuple(part for g in (*groups, depths.rows) for part in (g.first, g.entries))
    frames = array(e.rows.anchor), depths.frame, depths.viewer
    exact, found = [], torch.zeros(unknowns, DRAWS, dtype=torch.float64)
    for part in np.array_split(np.arange(e.blocks), -(-e.rig.frames // _FRAMES_AT_ONCE)):
        sums = np.zeros((len(part), unknowns))
        block_sums(part, indices, frames, own, cross, depths.arrays, sums)
        gradient = torch.from_numpy(sums)
        blocks += int((gradient != 0).any(1).sum())
        if is_exact(unknowns):
            exact.append(gradient)
        else:
            found.addmm_(gradient.T, unit_columns(len(part), unknowns, seed=int(part[0])))
    return BlockGradients(torch.cat(exact).T if exact else found, blocks)


def _blocks_of(e: Evidence) -> tuple[Int[Tensor, "anchors"], Int[Tensor, "rows"]]:
    """The block that holds an anchor in its own image, and the block of the other image in which it is looked up."""
    rig = e.rig
    at = project(rig.camera[e.anchors.frame], e.anchors.d_camera)[0]
    seen_at, _ = pixels_of_rows(rig, e.anchors, e.rows)
    low, high = torch.zeros(rig.frames, 2).double(), torch.ones(rig.frames, 2).double()
    for k in range(rig.frames):
        mine = at[e.anchors.frame == k]
        if len(mine):
            low[k], high[k] = mine.amin(0), mine.amax(0)

    def block(frame: Int[Tensor, "n"], uv: Float[Tensor, "n 2"]) -> Int[Tensor, "n"]:
        share = (uv - low[frame]) / (high - low).clamp_min(1e-9)[frame]
        cell = (share * e.image_blocks).nan_to_num().clamp(0, e.image_blocks - 1).long()
        return (frame * e.image_blocks + cell[:, 0]) * e.image_blocks + cell[:, 1]

    return block(e.anchors.frame, at), block(e.rows.frame, seen_at)
