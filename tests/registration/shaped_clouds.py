"""Clouds of chosen surfaces, and of rendered scenes, with true poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.pattern.grid import projected_light
from sl_nerfstudio.registration.agreement import LEAST_LIT_COSINE
from sl_nerfstudio.registration.surfaces import EmptyPlaces, FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, directions
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.render import RenderedCapture
from sl_nerfstudio.synthesis.synthesise import Setup, make_setup
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of
from tests.relative_pose.two_views import known_pose


@cache
def _template() -> FrameCloud:
    return clouds_of(rig_of(2, 40), 40)[0]


def cloud_of_points(camera: Device, uv: ndarray, points: ndarray, sigma: float) -> FrameCloud:
    """Points in camera axes seen at some pixels; half of their variance is noise, half that of one pose error."""
    even = np.full(len(uv), sigma / np.sqrt(2))
    errors = np.outer(even, np.eye(5)[0])
    return replace(_template(), camera=camera, uv_camera=uv, points=points, sigma_noise=even, pose_errors=errors)


def pixels_of(size: int) -> tuple[Device, ndarray]:
    """A square camera, and its pixel centres."""
    camera = Device(size, size, 1.35 * size, 1.35 * size, size / 2, size / 2)
    return camera, np.stack(np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), -1).reshape(-1, 2)


def cloud_of_depth(depth: Callable[[ndarray, ndarray], ndarray], size: int = 100, sigma: float = 1e-3) -> FrameCloud:
    """A surface that fills the image: distance along the line of sight by the normalised pixel (x, y), up is +y."""
    camera, uv = pixels_of(size)
    ray = directions(camera, uv)
    x, y = ray[:, 0] / -ray[:, 2], ray[:, 1] / -ray[:, 2]
    return cloud_of_points(camera, uv, ray / -ray[:, 2:] * depth(x, y)[:, None], sigma)


def cloud_of_body(
    outside: Callable[[ndarray], ndarray], S_world_camera: Similarity, size: int = 100, sigma: float = 1e-3
) -> FrameCloud:
    """What a camera sees of a body: `outside` is a function of points of the world, below zero inside.

    The first change of its sign along each ray between half and twice the distance to the origin, then by bisection.
    """
    camera, uv = pixels_of(size)
    ray = directions(camera, uv) / np.linalg.norm(directions(camera, uv), axis=1, keepdims=True)
    way = ray @ S_world_camera.R.T
    middle = float(np.linalg.norm(S_world_camera.t))
    near, far = np.full(len(uv), 0.5 * middle), np.full(len(uv), np.nan)
    for distance in np.linspace(0.5, 2, 300) * middle:
        inside = outside(S_world_camera.t + distance * way) < 0
        far = np.where(np.isnan(far) & inside, distance, far)
        near = np.where(np.isnan(far), distance, near)
    hit = np.isfinite(far)
    near, far, way = near[hit], far[hit], way[hit]
    for _ in range(40):
        half = (near + far) / 2
        inside = outside(S_world_camera.t + half[:, None] * way) < 0
        near, far = np.where(inside, near, half), np.where(inside, half, far)
    return cloud_of_points(camera, uv[hit], ray[hit] * (near / S_world_camera.scale)[:, None], sigma)


def relief(x: ndarray, y: ndarray, odd: float) -> ndarray:
    """Distance of a surface that is the same after half a turn about the line of sight where `odd` is 0."""
    even = np.cos(17 * x) * np.cos(11 * y) + np.sin(9 * x) * np.sin(13 * y) + 4 * x * y
    return 3 + 0.06 * even + odd * np.exp(-((x - 0.12) ** 2 + (y - 0.1) ** 2) / 0.006)


def seen_and_lit(nothing: EmptyPlaces, p: ndarray, n: ndarray) -> ndarray:
    """Whether a frame's camera would see points with normals, and its projector's light reach them."""
    R, t = nothing.T_projector_camera[:3, :3], nothing.T_projector_camera[:3, 3]
    q, m = p @ R.T + t, n @ R.T
    towards = [-(a * b).sum(1) / np.linalg.norm(a, axis=1) for a, b in ((p, n), (q, m))]
    uv, front = project(Intrinsics.of(nothing.projector, torch.float64), torch.from_numpy(q))
    x, y = np.floor(uv.numpy()).astype(int).T
    h, w = nothing.reach.shape
    lit = front.numpy() & (x >= 0) & (y >= 0) & (x < w) & (y < h)
    lit[lit] &= np.linalg.norm(q[lit], axis=1) < nothing.reach[y[lit], x[lit]]
    return lit & (np.min(towards, 0) >= LEAST_LIT_COSINE)


def with_wall(cloud: FrameCloud, distance: float) -> FrameCloud:
    """The frame as if it had also seen a wall, square to its line of sight, wherever it saw nothing."""
    size = cloud.camera.w
    seen = np.zeros((cloud.camera.h, size), dtype=bool)
    column, row = np.floor(cloud.uv_camera).astype(int).T
    seen[row, column] = True
    uv = np.argwhere(~seen)[:, ::-1] + 0.5
    ray = directions(cloud.camera, uv)
    parts = {
        "uv_camera": uv,
        "points": ray / -ray[:, 2:] * distance,
        "sigma_noise": np.full(len(uv), np.median(cloud.sigma_noise)),
        "pose_errors": np.tile(np.median(cloud.sigma_pose) * np.eye(5)[0], (len(uv), 1)),
    }
    return replace(cloud, **{key: np.concatenate([getattr(cloud, key), more]) for key, more in parts.items()})


@dataclass(frozen=True)
class RenderedClouds:
    """Frames of a rendered scene with their true relative poses; lengths of the truth in millimetres."""

    clouds: tuple[FrameCloud, ...]
    setup: Setup
    frames: tuple[int, ...]

    @property
    def S_world_camera(self) -> list[Similarity]:
        """From camera axes in baselines to the world."""
        truth = self.setup.truth
        T = truth.T_world_camera[list(self.frames)]
        return [Similarity(float(b), P[:3, :3], P[:3, 3]) for b, P in zip(self.baseline, T, strict=True)]

    @property
    def T_world_camera(self) -> ndarray:
        """True camera poses."""
        return self.setup.truth.T_world_camera[list(self.frames)]

    @property
    def baseline(self) -> ndarray:
        """True distances of camera and projector."""
        return self.setup.truth.baseline[list(self.frames)]


@cache
def _setup(scene: str, resolution: int, frames: int, seed: int) -> Setup:
    return make_setup(SynthConfig(scene=scene, frames=frames, resolution=resolution, seed=seed))


def _light(setup: Setup, view: RenderedCapture) -> ndarray:
    """As the decoder measures it: in a window of half a period."""
    step = np.abs(np.diff(view.coords, axis=1))[:-1] + np.abs(np.diff(view.coords, axis=0))[:, :-1]
    pixels = setup.layout.lattice.period / float(np.nanmedian(np.linalg.norm(step, axis=-1))) * 2**0.5
    return projected_light(view.radiance, view.coords, [setup.pattern], 0.5 * pixels)


@cache
def rendered(
    scene: str,
    frames: Sequence[int],
    of: int = 24,
    resolution: int = 150,
    noise: float = 0.15,
    seed: int = 3,
    lit: bool = False,
) -> RenderedClouds:
    """Some frames of a walk of `of` frames around a scene, with noise in pattern pixels.

    `lit`: the light that the surface returns is measured in the images; sl-synth's surfaces have faint blotches.
    """
    setup, rng, out = _setup(scene, resolution, of, seed), np.random.default_rng(seed), []
    camera, projector = setup.devices.camera, setup.devices.projector
    for k in frames:
        view = setup.render(k, 1)
        light = _light(setup, view) if lit else None
        coords = view.coords + noise * rng.standard_normal(view.coords.shape).astype(np.float32)
        T = np.linalg.inv(setup.truth.T_world_camera[k]) @ setup.truth.T_world_projector[k]
        pose = known_pose(T, *correspondences_of(coords), camera, projector)
        out.append(frame_cloud(f"{scene} {k}", coords, camera, projector, pose, light=light))
    return RenderedClouds(tuple(out), setup, tuple(frames))


def write_bar(path: Path) -> None:
    """A bar of 90 mm with a boss on each end, 22 and 12 mm high: nearly the same after half a turn."""
    parts = [trimesh.creation.box((90, 40, 24))]
    for x, height in ((30, 22), (-30, 12)):
        boss = trimesh.creation.box((16, 20, height))
        boss.apply_translation((x, 0, 12 + height / 2))
        parts.append(boss)
    trimesh.util.concatenate(parts).export(path)
