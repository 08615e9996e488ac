"""Covariance of the adjusted poses.

The inverse of the normal matrix assumes independent residuals. Those of one corner of one image are not independent: a
lens that is modelled slightly wrong, or a systematic error of the decoding, pushes all of them the same way. So the
gradient is summed over blocks of each image, and the spread of those sums provides a second estimate (the
cluster-robust "sandwich": Liang and Zeger, Biometrika 1986). The larger of the two is reported. The intrinsics are
uncertain, too (`self_calibration`).
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.gauge import gauge_directions
from sl_nerfstudio.bundle_adjustment.normal_equations import NormalEquations, normal_equations
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS, SelfCalibration
from sl_nerfstudio.geometry.devices import project
from sl_nerfstudio.geometry.se3 import inverse, transform

_EXACT = 1e-9  # used for an uncertainty of zero


@dataclass(frozen=True)
class Evidence:
    """Residuals at the result, with their weights and derivatives (including those by the intrinsics)."""

    rig: Rig
    anchors: Anchors
    rows: Observations
    linear: Linearisation
    kernel: Kernel
    image_blocks: int  # along each side of the decoded part of an image


@dataclass(frozen=True)
class PoseCovariance:
    """Covariance of the poses at the result, and the self-calibration of the intrinsics."""

    joint: Float[Tensor, "joint joint"]  # of (delta, rho, intrinsics); the gauge is projected out
    intrinsics: SelfCalibration | None  # None where nothing was adjusted


def pose_covariance(
    evidence: Evidence, B: Float[Tensor, "unknowns k"], start: Rig, prior: PosePrior, noise: float
) -> PoseCovariance:
    """Second moments of the errors of poses that were found with the current intrinsics.

    `B` spans the free parameters, `noise` is that of one look-up in pixels. Intrinsics are eliminated as unknowns. How
    far the poses would move if the intrinsics followed the captures counts as an error, too.
    """
    e, n = evidence, evidence.rig.frames
    if B.shape[1] == 0:
        poses_exact = torch.zeros(12 * n, 12 * n, dtype=torch.float64)
        return PoseCovariance(torch.block_diag(poses_exact, (prior.intrinsics_sigma**2).diag()), None)
    eye = torch.eye(UNKNOWNS, dtype=torch.float64)
    B = torch.block_diag(B, eye)
    poses_H, poses_g = prior_equations(prior, start, e.rig)
    weight = 1 / prior.intrinsics_sigma.clamp_min(_EXACT) ** 2
    H_prior = noise**2 * torch.block_diag(poses_H, weight.diag())
    g_prior = noise**2 * torch.cat(
        [poses_g, weight * torch.tensor(prior.intrinsics_change.values, dtype=torch.float64)]
    )
    weights = e.kernel.weights(e.linear.residuals)
    equations = normal_equations(e.linear, e.rows, *weights)
    H = B.T @ (equations.H + H_prior) @ B
    H_inverse = torch.linalg.inv(H)
    P = _without_gauge(e.rig, len(B))
    formal = noise**2 * P @ B @ H_inverse @ B.T @ P.T
    sums = _block_sums(e, equations, *weights) @ B
    blocks = int((sums != 0).any(1).sum())
    free = max(blocks - B.shape[1], blocks / 4)  # degrees of freedom left after the fit of the poses
    spread = blocks / max(free, 1.0) * sums.T @ sums + noise**2 * B.T @ H_prior @ B
    robust = P @ B @ H_inverse @ spread @ H_inverse @ B.T @ P.T
    larger = (robust.diagonal() / formal.diagonal().clamp_min(1e-30)).clamp_min(1).sqrt()
    covariance = larger[:, None] * formal * larger
    step = -P @ B @ H_inverse @ B.T @ (equations.g + g_prior)
    intrinsics = slice(12 * n, None)
    return PoseCovariance(
        covariance + torch.outer(step, step),
        SelfCalibration(step[intrinsics], covariance[intrinsics, intrinsics]),
    )


def _block_sums(
    e: Evidence,
    equations: NormalEquations,
    own_weight: Float[Tensor, "anchors"],
    cross_weight: Float[Tensor, "rows"],
) -> Float[Tensor, "blocks unknowns"]:
    """Gradient of the poses from each block of each image, with depths eliminated."""
    n, r, size = e.rig.frames, e.linear.residuals, e.linear.unknowns
    own_block, cross_block = _blocks_of(e)
    out = torch.zeros(n * e.image_blocks**2 * size, dtype=torch.float64)
    pull = torch.zeros(n * e.image_blocks**2, len(e.anchors.frame), dtype=torch.float64)  # on each depth
    every = torch.arange(len(e.anchors.frame))
    own, cross = own_weight[:, None] * r.own, cross_weight[:, None] * r.cross
    for block, J, J_depth, wr, cols, anchor in (
        (own_block, e.linear.own, e.linear.own_depth, own, e.linear.own_columns, every),
        (cross_block, e.linear.cross, e.linear.cross_depth, cross, e.linear.cross_columns, e.rows.anchor),
    ):
        out.index_add_(0, (block[:, None] * size + cols).reshape(-1), (J * wr[..., None]).sum(1).reshape(-1))
        pull.view(-1).index_add_(0, block * pull.shape[1] + anchor, (J_depth * wr).sum(-1))
    return out.reshape(-1, size) - pull @ (equations.depth_by_rest / equations.H_depth[:, None])


def _blocks_of(e: Evidence) -> tuple[Int[Tensor, "anchors"], Int[Tensor, "rows"]]:
    """The block that holds an anchor in its own image, and the block of the other image in which it is looked up."""
    rig, p_camera = e.rig, e.anchors.depth[:, None] * e.anchors.d_camera
    at = project(rig.camera[e.anchors.frame], p_camera)[0]
    p_world = transform(rig.T_world_camera[e.anchors.frame], p_camera)[e.rows.anchor]
    seen_at = project(rig.camera[e.rows.frame], transform(inverse(rig.T_world_camera)[e.rows.frame], p_world))[0]
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


def gauge_free(rig: Rig, B: Tensor, H: Tensor, noise: float) -> Float[Tensor, "unknowns unknowns"]:
    """`noise^2 / H` with the gauge projected out; correct if residuals are independent."""
    if B.shape[1] == 0:
        return torch.zeros(12 * rig.frames, 12 * rig.frames, dtype=torch.float64)
    P = _without_gauge(rig, len(B))
    return noise**2 * P @ B @ torch.linalg.inv(H) @ B.T @ P.T


def _without_gauge(rig: Rig, unknowns: int) -> Float[Tensor, "unknowns unknowns"]:
    """Projection of steps of the poses (and of unknowns after them) that removes motion of the whole scene."""
    G = torch.zeros(unknowns, 7, dtype=torch.float64)
    G[: 12 * rig.frames] = gauge_directions(rig)
    return torch.eye(unknowns, dtype=torch.float64) - G @ torch.linalg.solve(G.T @ G, G.T)
