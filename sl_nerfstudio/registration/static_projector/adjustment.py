"""Bundle adjustment of cameras, one projector and points; points are eliminated (Schur complement).

The projector is one more device, whose intrinsics may be free. Residuals are pixels of each device, divided by the
noise of its kind. Increments: `T_world_device <- T_world_device exp(v, w)`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64, Int64
from numpy import ndarray
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.robust import geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.registration.static_projector.settings import StaticSettings
from sl_nerfstudio.relative_pose.unknown_projector.parameters import device_with, prior_sigma, values_of


@dataclass(frozen=True)
class Scene:
    """What is adjusted: devices (the projector, if there is one, is the last), their poses, and points."""

    devices: tuple[Device, ...]
    T_world_device: Float64[ndarray, "devices 4 4"]
    points: Float64[ndarray, "points 3"]


@dataclass(frozen=True)
class Sightings:
    """Where devices see points."""

    device: Int64[ndarray, "n"]
    point: Int64[ndarray, "n"]
    uv: Float64[ndarray, "n 2"]
    cameras: int  # devices from this number on are projectors


@dataclass(frozen=True)
class Adjusted:
    """The scene where the robust cost is smallest."""

    scene: Scene
    noise_px: float  # of one coordinate, pixels of all devices
    covariance: Float64[ndarray, "free free"]  # of the projector's free intrinsics


def adjust_scene(scene: Scene, sightings: Sightings, free: tuple[int, ...], settings: StaticSettings) -> Adjusted:
    """Levenberg-Marquardt from a start that is right to within a few pixels."""
    damping, cost, width = 1e-4, np.inf, np.inf
    prior = _Prior.of(scene.devices[-1], free, settings)
    for _ in range(settings.iterations):
        r = residuals(scene, sightings)
        width = min(width, settings.kernel_sigmas * _noise(r, scene, settings))
        cost = _cost(r, sightings, width, prior, scene)
        equations = _equations(scene, sightings, r, width, free, prior)
        for _ in range(8):
            new = _stepped(scene, equations, damping, free)
            new_cost = _cost(residuals(new, sightings), sightings, width, prior, new)
            if new_cost <= cost:
                damping = max(damping / 10, 1e-10)
                break
            damping *= 10
        else:
            break
        scene, gain = new, cost - new_cost
        if gain <= settings.converged * cost:
            break
    r = residuals(scene, sightings)
    noise = _noise(r, scene, settings)
    equations = _equations(scene, sightings, r, settings.kernel_sigmas * noise, free, prior)
    return Adjusted(scene, noise, _covariance(equations, sightings, scene, len(free), settings))


@dataclass(frozen=True)
class _Prior:
    mean: Float64[ndarray, "5"]
    sigma: Float64[ndarray, "5"]
    free: tuple[int, ...]
    difference_step: float

    @staticmethod
    def of(projector: Device, free: tuple[int, ...], settings: StaticSettings) -> "_Prior":
        return _Prior(values_of(projector), prior_sigma(settings.prior), free, settings.difference_step)

    def departure(self, scene: Scene) -> Float64[ndarray, "free"]:
        index = list(self.free)
        return (values_of(scene.devices[-1]) - self.mean)[index] / self.sigma[index]


@dataclass(frozen=True)
class _Equations:
    """Normal equations in units of the noise: devices and intrinsics, points, and what couples them."""

    H: Float64[ndarray, "m m"]
    g: Float64[ndarray, "m"]
    points_H: Float64[ndarray, "points 3 3"]
    points_g: Float64[ndarray, "points 3"]
    gradients: Float64[ndarray, "m points"]  # what each point adds to g
    coupling: Float64[ndarray, "m points*3"]


def _in_devices(scene: Scene, s: Sightings) -> Float64[ndarray, "n 3"]:
    T = scene.T_world_device[s.device]
    return np.einsum("nji,nj->ni", T[:, :3, :3], scene.points[s.point] - T[:, :3, 3])


def _intrinsics(devices: Sequence[Device], s: Sightings) -> list[tuple[Intrinsics, ndarray]]:
    """Devices that share intrinsics are projected together."""
    groups: dict[Device, list[int]] = {}
    for k, device in enumerate(devices):
        groups.setdefault(device, []).append(k)
    return [
        (Intrinsics.of(device, torch.float64), np.flatnonzero(np.isin(s.device, index)))
        for device, index in groups.items()
    ]


def residuals(scene: Scene, s: Sightings) -> Float64[ndarray, "n 2"]:
    """Pixels by which devices see the points elsewhere than they should; far off where a point is behind."""
    p, out = _in_devices(scene, s), np.zeros((len(s.device), 2))
    for intrinsics, rows in _intrinsics(scene.devices, s):
        uv, front = project(intrinsics, torch.from_numpy(p[rows]))
        out[rows] = np.where(front.numpy()[:, None], uv.numpy() - s.uv[rows], 1e6)
    return out


def _noise(r: Float64[ndarray, "n 2"], scene: Scene, settings: StaticSettings) -> float:
    """Robust standard deviation of one coordinate, of all devices together.

    Apart, that of the cameras or that of the projector could fall to nothing, because three numbers of every point are
    free. Those are allowed for.
    """
    free = 3 * len(scene.points)
    lost = np.sqrt(r.size / max(r.size - free, 1))
    size = float(np.quantile(np.abs(r), settings.noise_quantile))
    return max(lost * size / float(norm.ppf((1 + settings.noise_quantile) / 2)), settings.noise_floor_px)


def _cost(r: Float64[ndarray, "n 2"], s: Sightings, width: float, prior: _Prior, scene: Scene) -> float:
    data = 9 * float(geman_mcclure_cost((r**2).sum(-1) / width**2).sum())
    return data + float((prior.departure(scene) ** 2).sum())


def _equations(
    scene: Scene,
    s: Sightings,
    r: Float64[ndarray, "n 2"],
    width: float,
    free: tuple[int, ...],
    prior: _Prior,
) -> _Equations:
    p, n = _in_devices(scene, s), len(s.device)
    by_p = np.zeros((n, 2, 3))
    for intrinsics, rows in _intrinsics(scene.devices, s):
        by_p[rows] = project_jacobian(intrinsics, torch.from_numpy(p[rows])).numpy()
    x, y, z, o = *p.T, np.zeros(n)
    hat = np.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(n, 3, 3)
    by_pose = np.concatenate([-by_p, by_p @ hat], -1)
    by_point = by_p @ scene.T_world_device[s.device, :3, :3].transpose(0, 2, 1)
    w = geman_mcclure_weight((r**2).sum(-1) / width**2) / (width / 3) ** 2
    D, C, m = len(scene.devices), len(scene.points), 6 * len(scene.devices) + len(free)
    columns = np.broadcast_to(6 * s.device[:, None] + np.arange(6), (n, 6))
    J = by_pose
    if free:
        by_free = np.zeros((n, 2, len(free)))
        rows = np.flatnonzero(s.device == D - 1)
        by_free[rows] = _by_intrinsics(scene.devices[-1], p[rows], free, prior.difference_step)
        J = np.concatenate([J, by_free], -1)
        columns = np.concatenate([columns, np.broadcast_to(6 * D + np.arange(len(free)), (n, len(free)))], 1)
    H, gradients, coupling = np.zeros((m, m)), np.zeros((m, C)), np.zeros((m, 3 * C))
    JtW = J.transpose(0, 2, 1) * w[:, None, None]
    np.add.at(H, (columns[:, :, None], columns[:, None, :]), JtW @ J)
    np.add.at(gradients, (columns, s.point[:, None]), (JtW @ r[..., None])[..., 0])
    at = 3 * s.point[:, None] + np.arange(3)
    np.add.at(coupling, (columns[:, :, None], at[:, None, :]), JtW @ by_point)
    points_H, points_g = np.zeros((C, 3, 3)), np.zeros((C, 3))
    PtW = by_point.transpose(0, 2, 1) * w[:, None, None]
    np.add.at(points_H, s.point, PtW @ by_point)
    np.add.at(points_g, s.point, (PtW @ r[..., None])[..., 0])
    index, k = 6 * D + np.arange(len(free)), list(free)
    H[index, index] += 1 / prior.sigma[k] ** 2
    g = gradients.sum(1)
    g[index] += prior.departure(scene) / prior.sigma[k]
    return _Equations(H, g, points_H, points_g, gradients, coupling)


def _by_intrinsics(
    projector: Device, p: Float64[ndarray, "n 3"], free: tuple[int, ...], step: float
) -> Float64[ndarray, "n 2 free"]:
    values, out = values_of(projector), []
    for k in free:
        ahead, behind = (
            project(
                Intrinsics.of(device_with(projector, values + sign * step * np.eye(len(values))[k]), torch.float64),
                torch.from_numpy(p),
            )[0].numpy()
            for sign in (1, -1)
        )
        out.append((ahead - behind) / (2 * step))
    return np.stack(out, -1)


def _reduced(e: _Equations, damping: float) -> tuple[ndarray, ndarray, ndarray]:
    """Equations of the devices with points eliminated, and the inverses of the points' blocks."""
    blocks = (
        e.points_H
        + damping * e.points_H * np.eye(3)
        + 1e-12 * np.eye(3) * e.points_H.trace(axis1=1, axis2=2)[:, None, None]
    )
    inverse = np.linalg.inv(np.where(blocks.any((1, 2))[:, None, None], blocks, np.eye(3)))
    m = len(e.H)
    by_point = e.coupling.reshape(m, -1, 3)
    carried = np.einsum("mci,cij->mcj", by_point, inverse).reshape(m, -1)
    S = e.H - carried @ e.coupling.T
    return (S + S.T) / 2, e.g - carried @ e.points_g.reshape(-1), inverse


def _covariance(
    e: _Equations, s: Sightings, scene: Scene, free: int, settings: StaticSettings
) -> Float64[ndarray, "free free"]:
    """Of the projector's intrinsics, cluster-robust: errors of points in one part of the pattern may be shared.

    Lenses that are modelled slightly wrong, and edges that are decoded wrong, push neighbouring points the same way.
    """
    if not free:
        return np.zeros((0, 0))
    S, _, inverse = _reduced(e, 0.0)
    m, C = len(S), len(scene.points)
    H_inverse = np.linalg.pinv(S, rcond=1e-13, hermitian=True)
    pull = np.einsum("mci,cij,cj->mc", e.coupling.reshape(m, C, 3), inverse, e.points_g)
    part = _parts(s, scene, settings.parts_along)
    scores = np.stack([np.bincount(part, row) for row in e.gradients - pull], 1)
    n = len(scores)
    meat = scores.T @ scores * (n / max(n - m, n / 4))
    formal, robust = (matrix[m - free :, m - free :] for matrix in (H_inverse, H_inverse @ meat @ H_inverse))
    growth = np.sqrt(np.maximum(np.diag(robust) / np.diag(formal), 1.0))
    return growth[:, None] * formal * growth


def _parts(s: Sightings, scene: Scene, along: int) -> Int64[ndarray, "points"]:
    """Number of the square part of the projector's image in which each point lies; one part without a projector."""
    part = np.zeros(len(scene.points), dtype=np.int64)
    beam = s.device >= s.cameras
    uv = s.uv[beam]
    if len(uv):
        low, high = uv.min(0), uv.max(0)
        cell = ((uv - low) / (high - low).max() * along).astype(np.int64).clip(0, along - 1)
        part[s.point[beam]] = cell[:, 1] * along + cell[:, 0]
    return part


def _stepped(scene: Scene, e: _Equations, damping: float, free: tuple[int, ...]) -> Scene:
    S, g, inverse = _reduced(e, damping)
    S = S + damping * np.diag(np.diag(e.H)) + 1e-12 * np.trace(S) / len(S) * np.eye(len(S))
    step = -np.linalg.solve(S, g)
    D, C = len(scene.devices), len(scene.points)
    pull = e.points_g + (e.coupling.T @ step).reshape(C, 3)
    points = scene.points - np.einsum("cij,cj->ci", inverse, pull)
    T = scene.T_world_device.copy()
    v, w = step[: 6 * D].reshape(D, 6)[:, :3], step[: 6 * D].reshape(D, 6)[:, 3:]
    T[:, :3, 3] += np.einsum("dij,dj->di", T[:, :3, :3], v)
    T[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(w).as_matrix()
    devices = scene.devices
    if free:
        values = values_of(devices[-1])
        values[list(free)] += step[6 * D :].clip(-0.3, 0.3)
        devices = (*devices[:-1], device_with(devices[-1], values))
    return replace(scene, devices=devices, T_world_device=T, points=points)
