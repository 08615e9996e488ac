"""A sphere under a moving projector, computed analytically and written file by file: a scan folder in 50 ms."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy import ndarray
from PIL import Image

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import Similarity, inverse, transform
from sl_nerfstudio.geometry.triangulation import pixel_centres, pixel_rays

RADIUS = 40.0  # mm
CAMERA = Device(w=48, h=40, fl_x=90.0, fl_y=92.0, cx=23.0, cy=21.0)
PROJECTOR = Device(w=64, h=64, fl_x=110.0, fl_y=110.0, cx=32.0, cy=32.0)


@dataclass(frozen=True)
class TinyScan:
    """What varies between scans; the world is millimetres times `S_world_mm`."""

    frames: int = 3
    camera: Device = CAMERA
    projector: Device = PROJECTOR
    units: str = "mm"
    S_world_mm: Similarity = field(default_factory=Similarity.identity)
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wrong: float = 0.0  # share of pixels with coordinates from elsewhere
    undecoded: float = 0.1
    seed: int = 0

    def write(self, root: Path) -> Path:
        """Write the folder and return it."""
        for name in ("images", "patterns", "coords", "masks"):
            (root / name).mkdir(parents=True)
        pattern = _pattern(self.projector)
        Image.fromarray(pattern).save(root / "pattern.png")
        frames = [self._write_frame(root, i, pattern) for i in range(self.frames)]
        content = {
            "sl_format": 1,
            "units": self.units,
            "camera_model": "OPENCV",
            **_intrinsics(self.camera),
            "projector": {**_intrinsics(self.projector), "model": self.projector.model, "pattern_path": "pattern.png"},
            "scale": {"known": True, "source": "by construction"},
            "frames": frames,
        }
        (root / "transforms.json").write_text(json.dumps(content))
        return root

    def poses_mm(self, frame: int) -> tuple[ndarray, ndarray]:
        """Camera and projector to the millimetre world of one frame."""
        angle = 0.9 * frame
        return _looking_at_origin(250.0, angle, 0.3), _looking_at_origin(230.0, angle + 0.45, 0.1 + 0.1 * frame)

    def _write_frame(self, root: Path, i: int, pattern: ndarray) -> dict:
        rng = np.random.default_rng([self.seed, i])
        T_camera, T_projector = self.poses_mm(i)
        coords, mask = _seen(self.camera, T_camera, self.projector, T_projector, np.array(self.centre))
        value = _look_up(pattern, coords, mask)
        wrong = rng.random(mask.shape) < self.wrong
        coords[wrong] += rng.uniform(-20, 20, (int(wrong.sum()), 2))
        coords[~mask | (rng.random(mask.shape) < self.undecoded)] = np.nan
        name = f"frame_{i:05d}"
        np.savez(root / f"coords/{name}.npz", coords=coords.astype(np.float32))
        Image.fromarray(value).save(root / f"patterns/{name}.png")
        Image.fromarray(value // 2).save(root / f"images/{name}.png")
        Image.fromarray(mask.astype(np.uint8) * 255).save(root / f"masks/{name}.png")
        return {
            "file_path": f"images/{name}.png",
            "sl_pattern_path": f"patterns/{name}.png",
            "sl_coords_path": f"coords/{name}.npz",
            "mask_path": f"masks/{name}.png",
            "transform_matrix": self.S_world_mm.poses(T_camera).tolist(),
            "projector_transform_matrix": self.S_world_mm.poses(T_projector).tolist(),
        }


def _intrinsics(device: Device) -> dict:
    values = asdict(device)
    del values["model"]
    return values


def _pattern(projector: Device) -> ndarray:
    x, y = np.arange(projector.w), np.arange(projector.h)
    return (127.5 + 60 * np.sin(x[None, :] * 0.8) + 60 * np.cos(y[:, None] * 0.7)).astype(np.uint8)


def _looking_at_origin(distance: float, azimuth: float, elevation: float) -> ndarray:
    back = np.array([np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)])
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    T[:3, 3] = distance * back
    return T


def _seen(
    camera: Device, T_camera: ndarray, projector: Device, T_projector: ndarray, centre: ndarray
) -> tuple[ndarray, ndarray]:
    """Coordinates and mask of the lit part of the sphere."""
    uv = pixel_centres(camera, torch.float64)
    o, d = pixel_rays(Intrinsics.of(camera, torch.float64), torch.from_numpy(T_camera).expand(*uv.shape[:2], 4, 4), uv)
    o = o - torch.from_numpy(centre)
    b, c = (o * d).sum(-1), (o * o).sum(-1) - RADIUS**2
    root = b * b - c
    normal = o + (-b - root.clamp_min(0).sqrt())[..., None] * d
    T = torch.from_numpy(T_projector)
    p = normal + torch.from_numpy(centre)
    coords, in_front = project(
        Intrinsics.of(projector, torch.float64), transform(inverse(T).expand(*p.shape[:2], 4, 4), p)
    )
    lit = ((T[:3, 3] - p) * normal).sum(-1) > 0
    inside = (coords > 0).all(-1) & (coords < torch.tensor([projector.w, projector.h])).all(-1)
    return coords.numpy().copy(), ((root > 0) & in_front & lit & inside).numpy()


def _look_up(pattern: ndarray, coords: ndarray, mask: ndarray) -> ndarray:
    x, y = (np.clip(np.nan_to_num(coords[..., i]).astype(int), 0, 63) for i in (0, 1))
    return np.where(mask, pattern[y, x], 0).astype(np.uint8)
