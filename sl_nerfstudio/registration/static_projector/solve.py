"""All frames under a projector that stands still: cameras, then the projector, then everything together."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.registration.static_projector.adjustment import (
    Adjusted,
    Scene,
    Sightings,
    adjust_scene,
    residuals,
)
from sl_nerfstudio.registration.static_projector.cells import Cells, find_cells
from sl_nerfstudio.registration.static_projector.chain import first_pair, place_next, rays_of, triangulated
from sl_nerfstudio.registration.static_projector.resection import place_known, resect
from sl_nerfstudio.registration.static_projector.settings import STATIC_DEFAULTS, StaticSettings
from sl_nerfstudio.relative_pose.unknown_projector.parameters import (
    CX,
    CY,
    K1,
    LOG_ASPECT,
    LOG_FOCAL,
    device_with,
    values_of,
)
from sl_nerfstudio.threads import one_library_thread

Fault = Literal["no pair", "no projector", "uncertain"]
_MODELS = (
    (LOG_FOCAL, CX, CY),
    (LOG_FOCAL, CX, CY, K1),
    (LOG_FOCAL, LOG_ASPECT, CX, CY),
    (LOG_FOCAL, LOG_ASPECT, CX, CY, K1),
)


@dataclass(frozen=True)
class StaticPlacement:
    """Poses in one world; the baseline of the first two cameras' pair is about one."""

    T_world_camera: Float64[ndarray, "frames 4 4"]  # NaN where a camera could not be placed
    projector: Device
    T_world_projector: Float64[ndarray, "4 4"]
    covariance: Float64[ndarray, "5 5"]  # of the projector's `parameters.NAMES`; zero where not free
    noise_px: float  # robust standard deviation of one coordinate, pixels of all devices


@dataclass(frozen=True)
class NoPlacement:
    """What could not be found."""

    fault: Fault
    common: int  # squares that the best two cameras have in common
    sigma_focal: float = np.inf  # share of the focal length


@one_library_thread()
def place_under_static_projector(
    coords: Sequence[Float32[ndarray, "_ _ 2"]],
    cameras: Sequence[Device],
    projector: Device,
    known: bool,
    stated: bool,
    settings: StaticSettings = STATIC_DEFAULTS,
) -> StaticPlacement | NoPlacement:
    """Camera poses from the codes as matches; the projector's intrinsics too, unless they are `known`.

    `stated`: the projector is at least a start for them.
    """
    cells = find_cells(coords, projector, settings.cells)
    rays = rays_of(cells, cameras)
    common = np.isfinite(rays[..., 0]).astype(np.float64)
    most = int((common @ common.T - np.diag(common.sum(1))).max(initial=0)) if len(rays) > 1 else 0
    start = first_pair(rays, cameras, settings.chain)
    if start is None:
        return NoPlacement("no pair", most)
    a, b, T_a_b = start
    T = np.full((len(cameras), 4, 4), np.nan)
    T[a], T[b] = np.eye(4), T_a_b
    T = _grown(T, rays, cells, cameras, settings)
    points = triangulated(rays, T, settings.chain.least_angle_deg)
    firm = _spread(np.isfinite(points[:, 0]), settings.most_points)
    found = _projector(points[firm], cells.uv_projector[firm], projector, known, stated, settings)
    if found is None:
        return NoPlacement("no projector", most)
    device, T_projector = found
    placed = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    scene = Scene((*(cameras[k] for k in placed), device), np.concatenate([T[placed], T_projector[None]]), points[firm])
    sightings = _sightings(cells.chosen(firm), placed, with_projector=True)
    adjusted, free = _best_model(scene, sightings, known, projector.model == "DOE", settings)
    if adjusted.noise_px > settings.largest_noise_share * projector.w:
        return NoPlacement("no projector", most)
    T[placed] = adjusted.scene.T_world_device[:-1]
    covariance = np.zeros((5, 5))
    covariance[np.ix_(free, free)] = settings.dependence**2 * adjusted.covariance
    sigma = float(np.sqrt(covariance[LOG_FOCAL, LOG_FOCAL]))
    if sigma > settings.largest_sigma:
        return NoPlacement("uncertain", most, sigma)
    return StaticPlacement(
        T, adjusted.scene.devices[-1], adjusted.scene.T_world_device[-1], covariance, adjusted.noise_px
    )


def _grown(
    T: Float64[ndarray, "frames 4 4"],
    rays: Float64[ndarray, "frames cells 3"],
    cells: Cells,
    cameras: Sequence[Device],
    settings: StaticSettings,
) -> Float64[ndarray, "frames 4 4"]:
    """Cameras added one by one, those that see most known points first; everything is adjusted as the set doubles."""
    T, failed, adjusted_with = T.copy(), set(), 0
    while True:
        placed = np.isfinite(T[:, 0, 0])
        if placed.sum() >= 2 * adjusted_with or placed.all():
            T = _adjusted_cameras(T, rays, cells, cameras, settings)
            adjusted_with = int(placed.sum())
        points = triangulated(rays, T, settings.chain.least_angle_deg)
        seen = (np.isfinite(rays[..., 0]) & np.isfinite(points[:, 0])).sum(1)
        left = sorted((int(k) for k in np.flatnonzero(~placed) if k not in failed), key=lambda k: -seen[k])
        if not left:
            return T if placed.sum() == adjusted_with else _adjusted_cameras(T, rays, cells, cameras, settings)
        pose = place_next(left[0], rays[left[0]], points, cameras[left[0]], settings.chain)
        if pose is None:
            failed.add(left[0])
        else:
            T[left[0]] = pose
            failed.clear()


def _adjusted_cameras(
    T: Float64[ndarray, "frames 4 4"],
    rays: Float64[ndarray, "frames cells 3"],
    cells: Cells,
    cameras: Sequence[Device],
    settings: StaticSettings,
) -> Float64[ndarray, "frames 4 4"]:
    """The placed cameras adjusted with the points that they see, without a projector."""
    placed = np.flatnonzero(np.isfinite(T[:, 0, 0]))
    points = triangulated(rays, T, settings.chain.least_angle_deg)
    firm = _spread(np.isfinite(points[:, 0]), settings.most_points)
    scene = Scene(tuple(cameras[k] for k in placed), T[placed], points[firm])
    found = adjust_scene(scene, _sightings(cells.chosen(firm), placed, with_projector=False), (), settings).scene
    T = T.copy()
    T[placed] = found.T_world_device
    return T


def _spread(good: Bool[ndarray, "cells"], most: int) -> Int64[ndarray, "m"]:
    """At most `most` of the good cells, evenly among them."""
    index = np.flatnonzero(good)
    return index if len(index) <= most else index[np.linspace(0, len(index) - 1, most).astype(np.int64)]


def _sightings(cells: Cells, placed: Int64[ndarray, "m"], *, with_projector: bool) -> Sightings:
    frame, cell = np.nonzero(cells.seen[placed])
    uv = cells.uv_camera[placed][frame, cell]
    if with_projector:
        every = np.arange(len(cells.uv_projector))
        frame = np.concatenate([frame, np.full(len(every), len(placed))])
        cell, uv = np.concatenate([cell, every]), np.concatenate([uv, cells.uv_projector])
    return Sightings(frame, cell, uv, len(placed))


def _projector(
    points: Float64[ndarray, "n 3"],
    uv: Float64[ndarray, "n 2"],
    projector: Device,
    known: bool,
    stated: bool,
    settings: StaticSettings,
) -> tuple[Device, Float64[ndarray, "4 4"]] | None:
    """Intrinsics and pose to start from."""
    if known or projector.model == "DOE":
        T = place_known(points, uv, projector)
        return None if T is None else (projector, T)
    found = resect(points, uv, projector, settings.resection)
    if found is None and stated:
        T = place_known(points, uv, projector)
        return None if T is None else (projector, T)
    return found


def _best_model(
    scene: Scene, sightings: Sightings, known: bool, doe: bool, settings: StaticSettings
) -> tuple[Adjusted, tuple[int, ...]]:
    """The smallest model that no larger one beats on left-out points by more than chance."""
    if known:
        return adjust_scene(scene, sightings, (), settings), ()
    models = _MODELS[:1] if doe else _MODELS
    best = adjust_scene(scene, sightings, models[0], settings)
    chosen, best_loss = models[0], None
    for model in models[1:]:
        larger = adjust_scene(_restarted(best.scene, scene, model), sightings, model, settings)
        extra = [k for k in model if k not in models[0]]
        away = np.abs(_further(larger.scene.devices[-1], extra) - _further(scene.devices[-1], extra))
        sigma = np.sqrt(np.diag(larger.covariance))[[model.index(k) for k in extra]]
        if (away < settings.standard_errors * settings.dependence * sigma).any():
            continue  # what does not differ from its usual value by more than chance cannot help
        base = _left_out(best.scene, sightings, chosen, settings) if best_loss is None else best_loss
        loss = _left_out(larger.scene, sightings, model, settings)
        gain = base - loss
        if gain.sum() > settings.standard_errors * np.sqrt((gain**2).sum()):
            best, chosen, best_loss = larger, model, loss
    return best, chosen


def _restarted(found: Scene, start: Scene, free: tuple[int, ...]) -> Scene:
    """The scene that was found, with the projector's intrinsics as in the start where they are not free."""
    values = values_of(start.devices[-1])
    values[list(free)] = values_of(found.devices[-1])[list(free)]
    return replace(found, devices=(*found.devices[:-1], device_with(start.devices[-1], values)))


def _further(device: Device, names: Sequence[int]) -> Float64[ndarray, "m"]:
    values = {LOG_ASPECT: np.log(device.fl_y / device.fl_x), K1: device.k1}
    return np.array([values[k] for k in names])


def _left_out(
    scene: Scene, sightings: Sightings, free: tuple[int, ...], settings: StaticSettings
) -> Float64[ndarray, "points"]:
    """Error of the projector's view of every point (capped), when its coordinate takes no part in the fit."""
    out = np.zeros(len(scene.points))
    projector = sightings.device == sightings.cameras
    short = replace(settings, iterations=5)
    for fold in range(settings.folds):
        left = projector & (sightings.point % settings.folds == fold)
        kept = Sightings(sightings.device[~left], sightings.point[~left], sightings.uv[~left], sightings.cameras)
        found = adjust_scene(scene, kept, free, short)
        loss = view_error(found.scene, sightings, left, settings.kernel_sigmas * found.noise_px)
        out[sightings.point[left]] = loss
    return out


def view_error(scene: Scene, sightings: Sightings, rows: Bool[ndarray, "n"], width: float) -> Float64[ndarray, "m"]:
    """Robust cost of some sightings, 0 to 1."""
    r = residuals(
        scene, Sightings(sightings.device[rows], sightings.point[rows], sightings.uv[rows], sightings.cameras)
    )
    x = (r**2).sum(-1) / width**2
    return x / (1 + x)
