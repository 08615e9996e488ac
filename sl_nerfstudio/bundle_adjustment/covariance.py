"""Covariance of the adjusted poses.

The inverse of the normal matrix assumes independent residuals. Those of one corner of one image are not independent: a
lens that is modelled slightly wrong, or a systematic error of the decoding, pushes all of them the same way. So the
gradient is summed over blocks of each image, and the spread of those sums provides a second estimate (the
cluster-robust "sandwich": Liang and Zeger, Biometrika 1986). The larger of the two is reported. The intrinsics are
uncertain, too (`self_calibration`).

What dependent residuals say counts less against the prior, too: all is computed once with the noise of one look-up, and
again with noise that is larger by the median factor between both estimates (a tempered likelihood: Ribatet, Cooley and
Davison, Statistica Sinica 2012). Otherwise prior and data together would know less than the prior alone. What the
captures say about the intrinsics is reported with the first.

Two things make a normal matrix too large. Weights of a robust kernel are not its second derivative
(`Kernel.curvature`). And derivatives by the poses hold slopes of the decoded maps, whose errors add up in it as
squares: along directions of which residuals know little, they outweigh what is there ("errors in variables"). So its
slopes are those of wide windows.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from numpy import ndarray
from scipy.linalg import get_lapack_funcs
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.free_parameters import FreeParameters
from sl_nerfstudio.bundle_adjustment.gauge import gauge_directions
from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.normal_equations import block_sums
from sl_nerfstudio.bundle_adjustment.normal_equations import DepthCouplings, NormalEquations, normal_equations
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, array, pixels_of_rows
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS, SelfCalibration
from sl_nerfstudio.bundle_adjustment.unknowns import by_frame, matrix_by_kind
from sl_nerfstudio.geometry.devices import project
from sl_nerfstudio.threads import results

_EXACT = 1e-9  # used for an uncertainty of zero
_FRAMES_AT_ONCE = 16  # whose blocks are summed together: bounds memory
_ROWS_AT_ONCE = 512  # of a matrix that are mirrored together
_MOST_BLOCKS, _PROBES = 4096, 512  # blocks of images of which each counts by itself; sums of more


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
class PoseCovariance:
    """Covariance of the poses at the result, and the self-calibration of the intrinsics."""

    joint: Float[Tensor, "joint joint"]  # of (delta, rho, intrinsics); the gauge is projected out
    intrinsics: SelfCalibration | None  # None where nothing was adjusted


def pose_covariance(
    evidence: Evidence, free: FreeParameters, start: Rig, prior: PosePrior, noise: float
) -> PoseCovariance:
    """Second moments of the errors of poses that were found with the current intrinsics.

    `noise` is that of one look-up in pixels. Intrinsics are eliminated as unknowns. How far the poses would move if the
    intrinsics followed the captures counts as an error, too.
    """
    e, n = evidence, evidence.rig.frames
    if free.count == 0:
        poses_exact = torch.zeros(12 * n, 12 * n, dtype=torch.float64)
        return PoseCovariance(torch.block_diag(poses_exact, (prior.intrinsics_sigma**2).diag()), None)
    weights = e.kernel.weights(e.linear.residuals)
    equations = normal_equations(e.linear, e.rows, *weights)
    known = normal_equations(e.smooth, e.rows, *weights)
    problem = _Linear(e, free, weights, equations, known, _prior_terms(prior, start, e.rig))
    formal, larger, step = problem.second_moments(noise)
    own = slice(12 * n, None)
    calibration = SelfCalibration(step[own].clone(), torch.outer(larger[own], larger[own]) * formal[own, own])
    moves = formal.diagonal()[: 12 * n] > 0
    dependence = float(larger[: 12 * n][moves].median()) if moves.any() else 1.0
    formal, larger, step = problem.second_moments(dependence * noise)
    formal *= larger
    formal *= larger[:, None]
    formal.addr_(step, step)
    return PoseCovariance(matrix_by_kind(formal, n), calibration)


@dataclass(frozen=True)
class _PriorTerms:
    """What the prior adds to the normal equations, for a noise of one pixel."""

    frames_H: Float[Tensor, "frames 12 12"]
    common_H: Float[Tensor, "common"]  # diagonal
    g: Float[Tensor, "unknowns"]


def _prior_terms(prior: PosePrior, start: Rig, rig: Rig) -> _PriorTerms:
    H, g = prior_equations(prior, start, rig)
    weight = 1 / prior.intrinsics_sigma.clamp_min(_EXACT) ** 2
    change = torch.tensor(prior.intrinsics_change.values, dtype=torch.float64)
    return _PriorTerms(H, weight, torch.cat([g.flatten(), weight * change]))


@dataclass(frozen=True)
class _Linear:
    """The adjustment at its result, as a linear problem."""

    evidence: Evidence
    free: FreeParameters
    weights: tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]]
    equations: NormalEquations
    known: NormalEquations  # with derivatives of wide windows
    prior: _PriorTerms

    def second_moments(
        self, noise: float
    ) -> tuple[Float[Tensor, "unknowns unknowns"], Float[Tensor, "unknowns"], Float[Tensor, "unknowns"]]:
        """Covariance for independent residuals, the factor by which each sigma is really larger, and the step left."""
        e, prior, count = self.evidence, self.prior, self.free.count
        prior_H = noise**2 * prior.frames_H, noise**2 * prior.common_H
        g = torch.cat([self.equations.g.flatten(), self.equations.g_common]) + noise**2 * prior.g
        G = _gauge(e.rig, len(g))
        C = _expanded_inverse(self.free, self.known, prior_H)
        _remove_gauge(C, G)
        formal = C.T.contiguous()
        _remove_gauge(formal, G)
        squares, blocks = _spread(e, self.equations.depths, self.weights, C)
        free_blocks = max(blocks - count - UNKNOWNS, blocks / 4)  # degrees of freedom left after the fit of the poses
        curvature = max(e.kernel.curvature(e.linear.residuals), e.least_curvature)
        robust = blocks / max(free_blocks, 1.0) / curvature**2 * squares + noise**2 * _quadratic(C, *prior_H)
        formal *= noise**2
        larger = (robust / formal.diagonal().clamp_min(1e-30)).clamp_min(1).sqrt()
        return formal, larger, -C @ g


def _expanded_inverse(
    free: FreeParameters,
    equations: NormalEquations,
    prior: tuple[Float[Tensor, "frames 12 12"], Float[Tensor, "common"]],
) -> Float[Tensor, "unknowns unknowns"]:
    """The inverse of the normal matrix of the free parameters and the intrinsics, as increments of all frames."""
    count, common = free.count, UNKNOWNS
    H = torch.zeros(count + common, count + common, dtype=torch.float64)
    H[:count, :count] = free.matrix(equations.matrix(prior[0]))
    H[:count, count:] = free.vector(equations.border)
    H[count:, :count] = H[:count, count:].T
    H[count:, count:] = equations.H_common + prior[1].diag()
    inverse_H = inverted(H)
    if free.own.shape[2] == 12:
        return inverse_H
    half = _expanded(free, inverse_H)
    return _expanded(free, half.T)


def _expanded(free: FreeParameters, x: Float[Tensor, "count c"]) -> Float[Tensor, "unknowns c"]:
    """Sets of free parameters and intrinsics as increments of all frames and intrinsics."""
    return torch.cat([free.steps(x[: free.count]).flatten(0, 1), x[free.count :]])


def _quadratic(
    C: Float[Tensor, "unknowns unknowns"], frames_H: Float[Tensor, "frames 12 12"], common: Float[Tensor, "common"]
) -> Float[Tensor, "unknowns"]:
    """The diagonal of `C H C^T` for a matrix of blocks of frames and a diagonal."""
    total = C[:, 12 * len(frames_H) :].square() @ common
    for k, H in enumerate(frames_H):
        columns = C[:, 12 * k : 12 * k + 12]
        total += ((columns @ H) * columns).sum(1)
    return total


def _spread(
    e: Evidence, depths: DepthCouplings, weights: tuple[Tensor, Tensor], C: Float[Tensor, "unknowns unknowns"]
) -> tuple[Float[Tensor, "unknowns"], int]:
    """Variances that the gradients of all blocks of images cause through `C`, and the number of blocks with any.

    The squares of many blocks are replaced by those of sums with random signs, whose expectation is the same: with
    `_PROBES` sums, the sigma that follows is off by about 3 %.
    """
    own_block, cross_block = _blocks_of(e)
    frames = range(0, e.rig.frames, _FRAMES_AT_ONCE)
    groups = Groups.of(array(own_block), e.blocks), Groups.of(array(cross_block), e.blocks)
    if e.blocks <= _MOST_BLOCKS:
        parts = results([partial(_spread_of, e, depths, weights, groups, C, first) for first in frames])
        return torch.stack([squares for squares, _ in parts]).sum(0), sum(blocks for _, blocks in parts)
    generator, blocks = torch.Generator().manual_seed(0), 0
    probes = torch.zeros(_PROBES, len(C), dtype=torch.float64)
    for first in frames:
        gradient = _block_gradients(e, depths, weights, groups, len(C), first)
        signs = 2 * torch.randint(2, (_PROBES, len(gradient)), generator=generator).double() - 1
        probes.addmm_(signs, gradient)
        blocks += int((gradient != 0).any(1).sum())
    return (probes @ C.T).square().sum(0) / _PROBES, blocks


def _spread_of(
    e: Evidence,
    depths: DepthCouplings,
    weights: tuple[Tensor, Tensor],
    groups: tuple[Groups, Groups],
    C: Float[Tensor, "unknowns unknowns"],
    first: int,
) -> tuple[Float[Tensor, "unknowns"], int]:
    """Variances by the blocks of some frames' images, and their number."""
    gradient = _block_gradients(e, depths, weights, groups, len(C), first)
    return (gradient @ C.T).square().sum(0), int((gradient != 0).any(1).sum())


def _block_gradients(
    e: Evidence,
    depths: DepthCouplings,
    weights: tuple[Tensor, Tensor],
    groups: tuple[Groups, Groups],
    unknowns: int,
    first: int,
) -> Float[Tensor, "blocks unknowns"]:
    """The gradient from each block of some frames' images."""
    per_frame, r = e.image_blocks**2, e.linear.residuals
    blocks = np.arange(first * per_frame, min(first + _FRAMES_AT_ONCE, e.rig.frames) * per_frame)
    own, cross = (
        (array(w[:, None] * value), array(J), array(by_depth))
        for w, value, J, by_depth in (
            (weights[0], r.own, e.linear.own, e.linear.own_depth),
            (weights[1], r.cross, e.linear.cross, e.linear.cross_depth),
        )
    )
    sums = np.zeros((len(blocks), unknowns))
    block_sums(
        blocks, tuple(part for g in (*groups, depths.rows) for part in (g.first, g.entries)),
        (array(e.rows.anchor), depths.frame, depths.viewer), own, cross, depths.arrays, sums,
    )  # fmt: skip
    return torch.from_numpy(sums)


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


def frame_sigmas(sigma: Float[Tensor, "frames 12"], unit: float) -> Float64[ndarray, "frames 4"]:
    """RMS per axis of frame translation (scene units times `unit`) and rotation (degrees), then of relative poses."""
    parts = sigma.reshape(-1, 4, 3).pow(2).mean(-1).sqrt().cpu().numpy()
    return parts * np.array([unit, 180 / np.pi, unit, 180 / np.pi])


def gauge_free(rig: Rig, free: FreeParameters, H: Float[Tensor, "frames 12 12"]) -> Float[Tensor, "unknowns unknowns"]:
    """`1 / H` for information about each frame alone, along the free parameters, with the gauge projected out."""
    n = rig.frames
    if free.count == 0:
        return torch.zeros(12 * n, 12 * n, dtype=torch.float64)
    dense = torch.zeros(n, 12, n, 12, dtype=torch.float64)
    each = torch.arange(n)
    dense[each, :, each] = H
    half = free.steps(inverted(free.matrix(dense))).flatten(0, 1)
    C, G = free.steps(half.T).flatten(0, 1), _gauge(rig, 12 * n)
    _remove_gauge(C, G)
    C = C.T.contiguous()
    _remove_gauge(C, G)
    return matrix_by_kind(C, n)


def _gauge(rig: Rig, unknowns: int) -> Float[Tensor, "unknowns 7"]:
    """Motion and growth of the whole scene, by steps of the poses (frame by frame) and of unknowns after them."""
    G = torch.zeros(unknowns, 7, dtype=torch.float64)
    G[: 12 * rig.frames] = by_frame(gauge_directions(rig)).flatten(0, 1)
    return G


def _remove_gauge(x: Float[Tensor, "unknowns c"], G: Float[Tensor, "unknowns 7"]) -> None:
    """Take motion and growth of the whole scene out of steps (in columns), in place."""
    x.addmm_(G, torch.linalg.solve(G.T @ G, G.T) @ x, alpha=-1)


def inverted(H: Float[Tensor, "k k"]) -> Float[Tensor, "k k"]:
    """The inverse of a symmetric positive definite matrix, in its place: large ones are in memory once.

    Raises ArithmeticError if rounding has left it not positive definite.
    """
    transposed = H.numpy().T  # LAPACK stores columns one after the other: its upper triangle is the lower one here
    potrf, potri = get_lapack_funcs(("potrf", "potri"), (transposed,))
    factor, failed = potrf(transposed, lower=0, overwrite_a=1, clean=0)
    if failed:
        raise ArithmeticError(f"the leading minor of order {failed} is not positive")
    out = torch.from_numpy(potri(factor, lower=0, overwrite_c=1)[0].T)
    for first in range(0, len(out), _ROWS_AT_ONCE):
        rows, below = slice(first, first + _ROWS_AT_ONCE), slice(first + _ROWS_AT_ONCE, None)
        lower = out[rows, rows].tril()
        out[rows, rows] = lower + lower.tril(-1).T
        out[rows, below] = out[below, rows].T
    return out
