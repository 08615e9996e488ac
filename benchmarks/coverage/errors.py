"""Errors of an adjustment in units of what it states: of relative poses, camera poses and lengths."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.coverage.cases import Case
from sl_nerfstudio.bundle_adjustment.adjust import Adjustment
from sl_nerfstudio.bundle_adjustment.parameters import (
    baseline_scale,
    gauge_projection,
    of_baselines,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.geometry.lie import hat, inverse, log_se3

_KNOWN = 0  # the frame whose baseline is known


@dataclass(frozen=True)
class Errors:
    """Errors over sigma, and the size of both."""

    relative: Float[Tensor, "n"]
    camera: Float[Tensor, "m"]
    length: Float[Tensor, "k"]
    camera_mm: float  # RMS error of the positions of cameras
    camera_deg: float
    baseline_percent: float  # RMS error of the baselines that are not known
    baseline_sigma_percent: float  # RMS of what is stated

    def shares(self) -> dict[str, tuple[float, float, float]]:
        """Share of errors within 1 and 2 sigma, and RMS of error over sigma."""
        parts = {"relative": self.relative, "camera": self.camera, "length": self.length}
        return {
            name: (float((z.abs() < 1).double().mean()), float((z.abs() < 2).double().mean()), rms(z))
            for name, z in parts.items()
        }


def errors_of(case: Case, found: Adjustment) -> Errors:
    """Where the baseline of the first frame is known, and the frames are aligned with the truth as a whole."""
    n, truth = case.truth.frames, case.truth
    rig = restore(truth, found.rig, baseline_scale(truth, found.rig, _KNOWN))
    P = gauge_projection(rig, _KNOWN)
    C = P @ found.covariance @ P.T
    turn = log_se3(rig.T_world_camera @ inverse(truth.T_world_camera))[:, 3:]
    centre = (rig.T_world_camera - truth.T_world_camera)[:, :3, 3]
    camera = torch.cat([centre, turn], 1) / _sigma(_by_camera(rig), C).reshape(n, 6)
    rho = log_se3(rig.T_camera_projector @ inverse(truth.T_camera_projector))
    others = torch.arange(n) != _KNOWN
    relative = (rho / C.diagonal()[6 * n :].clamp_min(1e-30).sqrt().reshape(n, 6))[others]
    baseline = torch.log(rig.baseline / truth.baseline)[others]
    stated = _sigma(torch.stack([of_baselines(rig, k) for k in range(n)]), C)[others]
    J, lengths = _between_cameras(rig)
    apart = (lengths - _between_cameras(truth)[1]) / _sigma(J, C)
    mm = 1 / case.exact.S_scene_world.scale
    return Errors(
        relative.flatten(),
        camera.flatten(),
        torch.cat([baseline / stated, apart]),
        rms(centre) * 3**0.5 * mm,
        float(np.degrees(rms(turn) * 3**0.5)),
        100 * rms(baseline),
        100 * rms(stated),
    )


def rms(values: Tensor) -> float:
    """Root mean square."""
    return float(values.pow(2).mean().sqrt())


def _sigma(J: Float[Tensor, "k unknowns"], C: Float[Tensor, "unknowns unknowns"]) -> Float[Tensor, "k"]:
    return ((J @ C) * J).sum(1).clamp_min(1e-30).sqrt()


def _by_camera(rig: Rig) -> Float[Tensor, "k unknowns"]:
    """Derivatives of each camera's position and rotation vector."""
    n = rig.frames
    J = torch.zeros(n, 6, 12 * n, dtype=torch.float64)
    for k in range(n):
        own = slice(6 * k, 6 * k + 6)
        J[k, :, own] = torch.eye(6, dtype=torch.float64)
        J[k, :3, 6 * k + 3 : 6 * k + 6] = -hat(rig.T_world_camera[k, :3, 3])
    return J.flatten(0, 1)


def _between_cameras(rig: Rig) -> tuple[Float[Tensor, "pairs unknowns"], Float[Tensor, "pairs"]]:
    """Distances of each camera from the next ones, and their derivatives."""
    n, centre = rig.frames, rig.T_world_camera[:, :3, 3]
    by_centre = _by_camera(rig).reshape(n, 6, -1)[:, :3]
    first = torch.arange(n)
    second = (first + n // 3) % n
    apart = centre[second] - centre[first]
    length = apart.norm(dim=-1)
    J = ((apart / length[:, None])[:, None] @ (by_centre[second] - by_centre[first])).squeeze(1)
    return J, length
