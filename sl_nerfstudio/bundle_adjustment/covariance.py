"""Covariance of the adjusted poses and of the intrinsics, in any axes and unit.

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
derivatives are by the surface's normals, the means of all frames that see a place. Those are a little blind to wrong
intrinsics, of which derivatives by the slopes of wide windows tell instead.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from numpy import ndarray
from scipy.linalg import get_lapack_funcs
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import Groups
from sl_nerfstudio.bundle_adjustment.normal_equations import (
    DepthCouplings,
    NormalEquations,
    block_sums,
    normal_equations,
)
from sl_nerfstudio.bundle_adjustment.observations import Kernel
from sl_nerfstudio.bundle_adjustment.parameters import (
    UNKNOWNS,
    FreeParameters,
    PosePrior,
    SelfCalibration,
    by_frame,
    by_kind,
    gauge_directions,
    prior_equations,
)
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, Rig, array, pixels_of_rows
from sl_nerfstudio.geometry.devices import project
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.parallel import results, split, threads

# Covariances are products `F F^T`: exact ones of small scans, and of large ones the mean of random draws. The
# covariance of 1,000 frames has 72 million different entries, and none of them is zero: frames that never see the same
# surface are held by the same others. Its factor from D random columns has as many rows as there are unknowns, and D
# columns. A sigma that follows is off by about `1 / sqrt(2 D)` of itself, 3 % here, and what follows from it needs time
# and memory by the number of frames (Hutchinson, Communications in Statistics 1990; Halko, Martinsson and Tropp, SIAM
# Review 2011).

EXACT_UNKNOWNS = 1280  # of a scan, so many as 106 frames have: up to there, nothing is random
DRAWS = 512
_MORE = 8  # columns that are kept besides: of steps and departures, each of which is one


def is_exact(unknowns: int) -> bool:
    """Whether a scan with so many unknowns (of poses and intrinsics) has an exact factor."""
    return unknowns <= EXACT_UNKNOWNS


def unit_columns(rows: int, unknowns: int, seed: int = 0) -> Float[Tensor, "rows c"]:
    """Columns Z for which `Z Z^T` is the identity, or on average is: for a scan with so many unknowns."""
    if is_exact(unknowns):
        return torch.eye(rows, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    signs = 2 * torch.randint(2, (rows, DRAWS), generator=generator) - 1
    return signs.double() / DRAWS**0.5


def stored_columns(unknowns: int) -> int:
    """Columns of a factor as it is stored."""
    return unknowns if is_exact(unknowns) else DRAWS + _MORE


def as_stored(factor: Float[Tensor, "unknowns k"]) -> Float[Tensor, "unknowns c"]:
    """A factor of the same covariance with `stored_columns`: zeros are added, or many columns become fewer.

    Raises ValueError for a factor of many unknowns and more columns.
    """
    unknowns, k = factor.shape
    more = stored_columns(unknowns) - k
    if more >= 0:
        return torch.nn.functional.pad(factor, (0, more))
    if not is_exact(unknowns):
        raise ValueError(f"{k} columns, at most {k + more}")
    return torch.linalg.qr(factor.T, mode="r").R.T


_FEWEST_TOGETHER = 32  # columns that a thread solves at once


@dataclass(frozen=True)
class Cholesky:
    """A symmetric positive definite matrix as `U^T U`."""

    upper: Float64[ndarray, "k k"]  # columns one after the other; below the diagonal is what was there before

    @staticmethod
    def in_place(H: Float[Tensor, "k k"]) -> "Cholesky":
        """Factorise a matrix, which is overwritten: large ones are in memory once.

        Raises ArithmeticError if rounding has left it not positive definite.
        """
        (potrf,) = get_lapack_funcs(("potrf",), (H.numpy(),))
        factor, failed = potrf(H.numpy().T, lower=0, overwrite_a=1, clean=0)  # LAPACK stores columns; H is symmetric
        if failed:
            raise ArithmeticError(f"the leading minor of order {failed} is not positive")
        return Cholesky(factor)

    def root(self, x: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
        """`U^-1 x`: with unit columns, a factor F of the inverse `F F^T`."""
        return self._solved("trtrs", x)

    def solution(self, x: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
        """The inverse times `x`."""
        return self._solved("potrs", x)

    def _solved(self, routine: str, x: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
        """Solve for some columns at a time, on all threads."""
        (solve,) = get_lapack_funcs((routine,), (self.upper,))
        out = np.array(x.numpy(), order="F")

        def columns(first: int, last: int) -> None:
            out[:, first:last] = solve(self.upper, out[:, first:last], lower=0)[0]

        results([partial(columns, *part) for part in split(out.shape[1], threads(), _FEWEST_TOGETHER)])
        return torch.from_numpy(out)


_IMAGE_BLOCKS = 4  # along each side of the decoded part of an image: residuals within a block may depend on each other
_LEAST_CURVATURE = 0.2  # of the kernel, as a share of its weights: with less, most residuals do not fit at all
_FRAMES_AT_ONCE = 16  # whose blocks are summed together: bounds memory


@dataclass(frozen=True)
class CovarianceEvidence:
    """Residuals at the result, with their weights and derivatives (including those by the intrinsics)."""

    rig: Rig
    anchors: Anchors
    rows: Observations
    linear: Linearisation
    smooth: Linearisation  # the same with derivatives of wide windows, where there are any
    along: Linearisation  # the same with derivatives by the mean normals of all frames
    kernel: Kernel

    @property
    def blocks(self) -> int:
        """Number of blocks of all images."""
        return self.rig.frames * _IMAGE_BLOCKS**2


def block_gradients(
    e: CovarianceEvidence, depths: DepthCouplings, weights: tuple[Tensor, Tensor]
) -> tuple[Float[Tensor, "unknowns c"], int]:
    """Columns whose squares add up to those of the gradients of all blocks of images, or on average do.

    Small scans have one column for each block, large ones sums of all blocks with random signs. Returned with the
    number of blocks that hold any residual.
    """
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
    return torch.cat(exact).T if exact else found, blocks


def _blocks_of(e: CovarianceEvidence) -> tuple[Int[Tensor, "anchors"], Int[Tensor, "rows"]]:
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
        cell = (share * _IMAGE_BLOCKS).nan_to_num().clamp(0, _IMAGE_BLOCKS - 1).long()
        return (frame * _IMAGE_BLOCKS + cell[:, 0]) * _IMAGE_BLOCKS + cell[:, 1]

    return block(e.anchors.frame, at), block(e.rows.frame, seen_at)


@dataclass(frozen=True)
class JointCovariance:
    """Second moments of the errors of delta of all frames, then rho of all frames, then the intrinsics.

    They are `factor @ factor.T`; the columns of scans with more than 106 frames are random draws. Increments are those
    of `residuals`, translation before rotation; intrinsics are shares of the focal length, in the order of
    `IntrinsicsChange.values`.
    """

    factor: Float64[ndarray, "joint k"]

    @property
    def matrix(self) -> Float64[ndarray, "joint joint"]:
        """The covariance itself, which takes much memory for many frames."""
        return self.factor @ self.factor.T

    @property
    def frames(self) -> int:
        """Number of frames."""
        return (len(self.factor) - UNKNOWNS) // 12

    def mapped(self, S_target_world: Similarity) -> "JointCovariance":
        """The covariance for the same devices in other axes and another unit.

        A motion (v, w) in the world is, in the target, the rotation R w and the translation s R v - (R w) x t; in the
        axes of a camera only the unit changes.
        """
        s, R, t = S_target_world.scale, S_target_world.R, S_target_world.t
        cross = np.cross(np.eye(3), t).T  # cross @ w = w x t
        frame = np.block([[s * R, -cross @ R], [np.zeros((3, 3)), R]])
        relative = np.diag([s] * 3 + [1.0] * 3)
        half, out = 6 * self.frames, self.factor.copy()
        for first, J in ((0, frame), (half, relative)):
            part = self.factor[first : first + half]
            out[first : first + half] = (J @ part.reshape(-1, 6, part.shape[1])).reshape(half, -1)
        return JointCovariance(out)


def joint_of_prior(prior: PosePrior, start: Rig) -> Float[Tensor, "joint k"]:
    """A factor of the covariance before any residual is computed."""
    H, _ = prior_equations(prior, start, start)
    rows = 12 * start.frames + UNKNOWNS
    unit = unit_columns(rows, rows)
    upper = torch.linalg.cholesky(H).mT
    frames = torch.linalg.solve_triangular(upper, unit[:-UNKNOWNS].reshape(start.frames, 12, -1), upper=True)
    return torch.cat([by_kind(frames), prior.intrinsics_sigma[:, None] * unit[-UNKNOWNS:]])


def with_known_length(
    factor: Float[Tensor, "joint k"], rig: Rig, log_length: Float[Tensor, "unknowns"]
) -> Float[Tensor, "joint k"]:
    """A factor under the scale at which a length does not err; `log_length` is its derivative by the poses.

    The covariance of an adjustment says nothing about the scale, which no residual determines. With a known length l,
    an error x of poses and intrinsics becomes `x - g (c . x)`, where g is the growth of everything by a factor and c
    the derivative of `log l`, so that `c . g = 1`. Lengths that are badly known relative to l become uncertain so.
    """
    growth = torch.zeros(len(factor), dtype=torch.float64)
    growth[: len(log_length)] = gauge_directions(rig)[:, 6]
    known = torch.zeros_like(growth)
    known[: len(log_length)] = log_length
    known = known / (known @ growth)
    return factor - torch.outer(growth, known @ factor)


def of_all_lengths(rig: Rig, prior: PosePrior) -> Float[Tensor, "unknowns"]:
    """Derivative of the logarithm of the scale which agrees best with the starting poses (see `agreeing_scale`)."""
    H, _ = prior_equations(prior, rig, rig)
    G = by_frame(gauge_directions(rig))
    by_step = H @ G
    information = (G.transpose(1, 2) @ by_step).sum(0)
    return torch.linalg.solve(information, by_kind(by_step).T)[6]


# The covariance at the result of an adjustment, as a linear problem.

_EXACT = 1e-9  # used for an uncertainty of zero
_PRIOR_SEED = 1  # of its random columns, where there are any: they are independent of others


def pose_covariance(
    evidence: CovarianceEvidence, free: FreeParameters, start: Rig, prior: PosePrior, noise: float
) -> tuple[Float[Tensor, "joint k"], SelfCalibration | None]:
    """A factor of the covariance of (delta, rho, intrinsics) without the gauge, and the self-calibration.

    The poses were found with the current intrinsics; `noise` is that of one look-up in pixels. Intrinsics are
    eliminated as unknowns. How far the poses would move if the intrinsics followed the captures counts as an error,
    too. The self-calibration is None where nothing was adjusted.
    """
    e, n = evidence, evidence.rig.frames
    if free.count == 0:
        poses_exact = torch.zeros(12 * n, UNKNOWNS, dtype=torch.float64)
        return torch.cat([poses_exact, prior.intrinsics_sigma.diag()]), None
    weights = e.kernel.weights(e.linear.residuals)
    equations, smooth, along = (normal_equations(x, e.rows, *weights) for x in (e.linear, e.smooth, e.along))
    g = torch.cat([equations.g.flatten(), equations.g_common])
    H_frames, g_frames = prior_equations(prior, start, e.rig)
    H_common = 1 / prior.intrinsics_sigma.clamp_min(_EXACT) ** 2  # of the prior, diagonal
    change = torch.tensor(prior.intrinsics_change.values, dtype=torch.float64)
    g_prior = torch.cat([g_frames.flatten(), H_common * change])
    columns, blocks = block_gradients(e, equations.depths, weights)
    rows, G = free.count + UNKNOWNS, _gauge(e.rig, len(g))
    free_blocks = max(blocks - rows, blocks / 4)  # left after the fit of the poses
    curvature = max(e.kernel.curvature(e.linear.residuals), _LEAST_CURVATURE)
    spread = (blocks / max(free_blocks, 1.0)) ** 0.5 / curvature * columns

    def moments(information: NormalEquations, noise: float) -> tuple[Tensor, Tensor, Tensor]:
        """Errors for a noise of one look-up, by the unknowns of each frame, then the intrinsics.

        A factor of the covariance for independent residuals; how much larger each sigma really is; the step that is
        left.
        """
        factor = Cholesky.in_place(free.matrix(information.matrix(noise**2 * H_frames, noise**2 * H_common)))
        formal = noise * _increments(free, G, factor.root(unit_columns(rows, len(g))))
        caused = _together(spread, noise**2 * _prior_root(H_frames, H_common))
        pulls = torch.cat([caused, (g + noise**2 * g_prior)[:, None]], 1)
        moved = _increments(free, G, factor.solution(_parameters(free, pulls)))
        robust = moved[:, :-1].square().sum(1)
        larger = (robust / formal.square().sum(1).clamp_min(1e-30)).clamp_min(1).sqrt()
        return formal, larger, -moved[:, -1]

    formal, larger, step = moments(smooth, noise)
    of_intrinsics = larger[12 * n :, None] * formal[12 * n :]
    calibration = SelfCalibration(step[12 * n :].clone(), of_intrinsics @ of_intrinsics.T)
    moves = (formal[: 12 * n] != 0).any(1)
    dependence = float(larger[: 12 * n][moves].median()) if moves.any() else 1.0
    formal, larger, step = moments(along, dependence * noise)
    return _by_kind(torch.cat([larger[:, None] * formal, step[:, None]], 1), n), calibration


def _prior_root(
    H_frames: Float[Tensor, "frames 12 12"], H_common: Float[Tensor, "common"]
) -> Float[Tensor, "unknowns c"]:
    """A factor of the prior's information, which is it times its transpose, or on average is."""
    n, rows = len(H_frames), 12 * len(H_frames) + len(H_common)
    unit = unit_columns(rows, rows, _PRIOR_SEED)
    frames = torch.linalg.cholesky(H_frames) @ unit[: 12 * n].reshape(n, 12, -1)
    return torch.cat([frames.flatten(0, 1), H_common.sqrt()[:, None] * unit[12 * n :]])


def _together(a: Float[Tensor, "unknowns c"], b: Float[Tensor, "unknowns d"]) -> Float[Tensor, "unknowns k"]:
    """Columns whose squares add up to those of both; of random ones, which are independent, the sums."""
    return torch.cat([a, b], 1) if is_exact(len(a)) else a + b


def _increments(
    free: FreeParameters, G: Float[Tensor, "unknowns 7"], x: Float[Tensor, "count c"]
) -> Float[Tensor, "unknowns c"]:
    """Parameters and intrinsics as increments of all frames and intrinsics, less motion and growth of the scene."""
    out = torch.cat([free.steps(x[: free.count]).flatten(0, 1), x[free.count :]])
    return out.addmm_(G, torch.linalg.solve(G.T @ G, G.T) @ out, alpha=-1)


def _parameters(free: FreeParameters, g: Float[Tensor, "unknowns c"]) -> Float[Tensor, "count c"]:
    """Gradients by increments of all frames and intrinsics as gradients by free parameters and intrinsics."""
    frames = g[: 12 * free.of].reshape(free.of, 12, -1)[free.frames]
    return torch.cat([free.vector(frames), g[12 * free.of :]])


def _by_kind(x: Float[Tensor, "unknowns c"], frames: int) -> Float[Tensor, "unknowns c"]:
    """Rows in the order of `by_kind`; those after the frames' unknowns stay where they are."""
    return torch.cat([by_kind(x[: 12 * frames].reshape(frames, 12, -1)), x[12 * frames :]])


def frame_sigmas(sigma: Float[Tensor, "frames 12"], unit: float) -> Float64[ndarray, "frames 4"]:
    """RMS per axis of frame translation (scene units times `unit`) and rotation (degrees), then of relative poses."""
    parts = sigma.reshape(-1, 4, 3).pow(2).mean(-1).sqrt().cpu().numpy()
    return parts * np.array([unit, 180 / np.pi, unit, 180 / np.pi])


def gauge_free(rig: Rig, free: FreeParameters, H: Float[Tensor, "frames 12 12"]) -> Float[Tensor, "unknowns c"]:
    """A factor of `1 / H` for information about each frame alone, along the free parameters, without the gauge."""
    n = rig.frames
    if free.count == 0:
        return torch.zeros(12 * n, 1, dtype=torch.float64)
    factor = Cholesky.in_place(free.matrix(torch.block_diag(*H)))
    root = factor.root(unit_columns(free.count, 12 * n + UNKNOWNS))
    return _by_kind(_increments(free, _gauge(rig, 12 * n), root), n)


def _gauge(rig: Rig, unknowns: int) -> Float[Tensor, "unknowns 7"]:
    """Motion and growth of the whole scene, by steps of the poses (frame by frame) and of unknowns after them."""
    G = torch.zeros(unknowns, 7, dtype=torch.float64)
    G[: 12 * rig.frames] = by_frame(gauge_directions(rig)).flatten(0, 1)
    return G
