"""A sphere under a moving projector, computed analytically: a scan folder in 50 ms."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.triangulation import pixel_centres, pixel_rays
from sl_nerfstudio.scan import Scale, ScanWriter
from tests.formulas import look_at, on_ball, pixels

RADIUS = 40.0  # mm, about the origin
CAMERA = Device(w=48, h=40, fl_x=90.0, fl_y=92.0, cx=23.0, cy=21.0)
PROJECTOR = Device(w=64, h=64, fl_x=110.0, fl_y=110.0, cx=32.0, cy=32.0)


@dataclass(frozen=True)
class TinyScan:
    """What varies between scans; the world is millimetres times `S_world_mm`."""

    frames: int = 3
    camera: Device = CAMERA
    units: str = "mm"
    S_world_mm: Similarity = field(default_factory=Similarity.identity)
    wrong: float = 0.0  # share of pixels with coordinates from elsewhere
    undecoded: float = 0.1

    def write(self, root: Path) -> Path:
        """Write the folder and return it."""
        x, y = np.arange(PROJECTOR.w), np.arange(PROJECTOR.h)
        pattern = (127.5 + 60 * np.sin(x[None, :] * 0.8) + 60 * np.cos(y[:, None] * 0.7)).astype(np.uint8)
        known = {"units": self.units, "scale": Scale(True, "by construction"), "camera": self.camera}
        with ScanWriter(root, projector=PROJECTOR, pattern=pattern, **known) as writer:
            for i in range(self.frames):
                self._add_frame(writer, i, pattern)
        return root

    def poses_mm(self, frame: int) -> tuple[ndarray, ndarray]:
        """Camera and projector to the millimetre world of one frame."""
        angle = 0.9 * frame
        return _looking_at_origin(250.0, angle, 0.3), _looking_at_origin(230.0, angle + 0.45, 0.1 + 0.1 * frame)

    def _add_frame(self, writer: ScanWriter, i: int, pattern: ndarray) -> None:
        rng = np.random.default_rng([0, i])
        T_camera, T_projector = self.poses_mm(i)
        coords, mask = _seen(self.camera, T_camera, T_projector)
        x, y = (np.clip(np.nan_to_num(coords[..., i]).astype(int), 0, 63) for i in (0, 1))
        value = np.where(mask, pattern[y, x], 0).astype(np.uint8)
        wrong = rng.random(mask.shape) < self.wrong
        coords[wrong] += rng.uniform(-20, 20, (int(wrong.sum()), 2))
        coords[~mask | (rng.random(mask.shape) < self.undecoded)] = np.nan
        writer.add_frame(
            f"frame_{i:05d}",
            image=value // 2,
            coords=coords.astype(np.float32),
            T_world_camera=self.S_world_mm.poses(T_camera),
            T_world_projector=self.S_world_mm.poses(T_projector),
            pattern=value,
            mask=mask,
        )


def _looking_at_origin(distance: float, azimuth: float, elevation: float) -> ndarray:
    back = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    return look_at(distance * back, up=(0.0, 1.0, 0.0))


def _seen(camera: Device, T_camera: ndarray, T_projector: ndarray) -> tuple[ndarray, ndarray]:
    """Coordinates and mask of the lit part of the sphere."""
    uv = pixel_centres(camera, torch.float64)
    T = torch.from_numpy(T_camera).expand(*uv.shape[:2], 4, 4)
    p = on_ball(T_camera[:3, 3], pixel_rays(Intrinsics.of(camera, torch.float64), T, uv)[1].numpy(), RADIUS)
    coords = pixels(PROJECTOR, T_projector, p)
    lit = ((T_projector[:3, 3] - p) * p).sum(-1) > 0  # not where NaN
    return coords, lit & (coords > 0).all(-1) & (coords < (PROJECTOR.w, PROJECTOR.h)).all(-1)
