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

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.free_parameters import FreeParameters
from sl_nerfstudio.bundle_adjustment.gauge import gauge_directions
from sl_nerfstudio.bundle_adjustment.joint_covariance.cholesky import Cholesky
from sl_nerfstudio.bundle_adjustment.joint_covariance.draws import is_exact, unit_columns
from sl_nerfstudio.bundle_adjustment.joint_covariance.evidence import BlockGradients, Evidence, block_gradients
from sl_nerfstudio.bundle_adjustment.normal_equations import NormalEquations, normal_equations
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS, SelfCalibration
from sl_nerfstudio.bundle_adjustment.unknowns import by_frame, by_kind

_EXACT = 1e-9  # used for an uncertainty of zero
_PRIOR_SEED = 1  # of its random columns, where there are any: they are independent of others


@dataclass(frozen=True)
class PoseCovariance:
    """Covariance of the poses at the result, and the self-calibration of the intrinsics."""

    factor: Float[Tensor, "joint k"]  # of that of (delta, rho, intrinsics); the gauge is projected out
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
        poses_exact = torch.zeros(12 * n, UNKNOWNS, dtype=torch.float64)
        return PoseCovariance(torch.cat([poses_exact, prior.intrinsics_sigma.diag()]), None)
    weights = e.kernel.weights(e.linear.residuals)
    equations = normal_equations(e.linear, e.rows, *weights)
    known = normal_equations(e.smooth, e.rows, *weights)
    gradients = block_gradients(e, equations.depths, weights)
    problem = _Linear(e, free, equations, known, gradients, _prior_terms(prior, start, e.rig))
    found, own = problem.second_moments(noise), slice(12 * n, None)
    of_intrinsics = found.larger[own, None] * found.formal[own]
    calibration = SelfCalibration(found.step[own].clone(), of_intrinsics @ of_intrinsics.T)
    moves = (found.formal[: 12 * n] != 0).any(1)
    dependence = float(found.larger[: 12 * n][moves].median()) if moves.any() else 1.0
    found = problem.second_moments(dependence * noise)
    factor = torch.cat([found.larger[:, None] * found.formal, found.step[:, None]], 1)
    return PoseCovariance(_by_kind(factor, n), calibration)


@dataclass(frozen=True)
class _PriorTerms:
    """What the prior adds to the normal equations, for a noise of one pixel."""

    frames_H: Float[Tensor, "frames 12 12"]
    common_H: Float[Tensor, "common"]  # diagonal
    g: Float[Tensor, "unknowns"]

    def root(self) -> Float[Tensor, "unknowns c"]:
        """A factor of the information: `H` is it times its transpose, or on average is."""
        n, rows = len(self.frames_H), len(self.g)
        unit = unit_columns(rows, rows, _PRIOR_SEED)
        frames = torch.linalg.cholesky(self.frames_H) @ unit[: 12 * n].reshape(n, 12, -1)
        return torch.cat([frames.flatten(0, 1), self.common_H.sqrt()[:, None] * unit[12 * n :]])


def _prior_terms(prior: PosePrior, start: Rig, rig: Rig) -> _PriorTerms:
    H, g = prior_equations(prior, start, rig)
    weight = 1 / prior.intrinsics_sigma.clamp_min(_EXACT) ** 2
    change = torch.tensor(prior.intrinsics_change.values, dtype=torch.float64)
    return _PriorTerms(H, weight, torch.cat([g.flatten(), weight * change]))


@dataclass(frozen=True)
class _Moments:
    """Errors at the result; unknowns are those of the frames one after the other, then the intrinsics."""

    formal: Float[Tensor, "unknowns c"]  # factor of the covariance for independent residuals
    larger: Float[Tensor, "unknowns"]  # factor by which each sigma is really larger
    step: Float[Tensor, "unknowns"]  # that is left


@dataclass(frozen=True)
class _Linear:
    """The adjustment at its result, as a linear problem."""

    evidence: Evidence
    free: FreeParameters
    equations: NormalEquations
    known: NormalEquations  # with derivatives of wide windows
    gradients: BlockGradients
    prior: _PriorTerms

    def second_moments(self, noise: float) -> _Moments:
        """For a noise of one look-up."""
        e, prior, free, gradients = self.evidence, self.prior, self.free, self.gradients
        prior_H = noise**2 * prior.frames_H, noise**2 * prior.common_H
        g = torch.cat([self.equations.g.flatten(), self.equations.g_common]) + noise**2 * prior.g
        G = _gauge(e.rig, len(g))
        factor = Cholesky.in_place(free.matrix(self.known.matrix(*prior_H)))
        rows = free.count + UNKNOWNS
        formal = noise * _increments(free, G, factor.root(unit_columns(rows, len(g))))
        free_blocks = max(gradients.blocks - rows, gradients.blocks / 4)  # left after the fit of the poses
        curvature = max(e.kernel.curvature(e.linear.residuals), e.least_curvature)
        scale = (gradients.blocks / max(free_blocks, 1.0)) ** 0.5 / curvature
        caused = _together(scale * gradients.columns, noise**2 * prior.root())
        moved = _increments(free, G, factor.solution(_parameters(free, torch.cat([caused, g[:, None]], 1))))
        robust = moved[:, :-1].square().sum(1)
        larger = (robust / formal.square().sum(1).clamp_min(1e-30)).clamp_min(1).sqrt()
        return _Moments(formal, larger, -moved[:, -1])


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
