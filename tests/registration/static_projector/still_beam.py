"""A projector that stands still with lens shift, and cameras around a bumpy surface: by formula, without rendering."""

from dataclasses import dataclass

import numpy as np
import torch

from sl_nerfstudio.geometry.devices import (
    Device,
    Intrinsics,
    project,
    unproject,
)
from sl_nerfstudio.geometry.triangulation import pixel_centres
from tests.relative_pose.two_views import pose_of
from tests.relative_pose.unknown_views import aimed

CAMERA = Device(160, 120, 200.0, 197.0, 81.0, 59.0, k1=-0.05)
BEAM = Device(640, 400, 1000.0, 1000.0, 310.0, 680.0)
PLACES = ((0.0, 0.0, 0.0), (1.1, 0.2, 0.1), (-0.9, 0.6, -0.2), (0.3, -1.0, 0.2))


@dataclass(frozen=True)
class StillBeam:
    """Coordinates of all cameras, and what is true."""

    coords: list[np.ndarray]
    T_world_camera: np.ndarray
    T_world_projector: np.ndarray


def still_beam(count: int, noise: float = 0.0) -> StillBeam:
    """The surface is z = -4.5 + bumps(x, y); rays meet it by Newton's iterations."""
    T_projector = aimed((0.5, 0.9, 0.0), BEAM, 5.0)
    cameras = [pose_of(place, (0.05, 0.0, -4.5), 8.0 * k) if k else np.eye(4) for k, place in enumerate(PLACES[:count])]
    coords = []
    for k, T in enumerate(cameras):
        uv = pixel_centres(CAMERA, torch.float64)
        d = unproject(Intrinsics.of(CAMERA, torch.float64), uv).numpy().reshape(-1, 3) @ T[:3, :3].T
        o, along = T[:3, 3], np.full(len(d), 4.5)
        for _ in range(60):
            p = o + along[:, None] * d
            along = along + (_height(p) - p[:, 2]) / d[:, 2] * 0.8
        p = o + along[:, None] * d
        seen, front = project(
            Intrinsics.of(BEAM, torch.float64), torch.from_numpy((p - T_projector[:3, 3]) @ T_projector[:3, :3])
        )
        seen = seen.numpy()
        inside = front.numpy() & (seen > 0).all(1) & (seen < (BEAM.w, BEAM.h)).all(1) & (np.abs(p[:, 2] + 4.5) < 1)
        seen = seen + noise * np.random.default_rng(k).standard_normal(seen.shape)
        seen[~inside] = np.nan
        coords.append(seen.reshape(CAMERA.h, CAMERA.w, 2).astype(np.float32))
    return StillBeam(coords, np.stack(cameras), T_projector)


def _height(p: np.ndarray) -> np.ndarray:
    x, y = p[:, 0], p[:, 1]
    return -4.5 + 0.2 * x + 0.25 * (np.sin(2.1 * x + 0.4) * np.cos(1.7 * y) + 0.5 * np.sin(1.3 * x * y + y))
