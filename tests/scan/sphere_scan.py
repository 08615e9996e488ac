"""A sphere under a moving camera and projector, by formula: a valid scan folder of a few frames in milliseconds."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from scipy.ndimage import gaussian_filter, map_coordinates

from sl_nerfstudio.errors import Fault
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan import Scale, ScanWriter, check_scan
from tests.formulas import look_at, on_ball, pixels, rays

RADIUS = 40.0
CAMERA = Device(w=72, h=60, fl_x=150.0, fl_y=152.0, cx=35.0, cy=31.0)
PROJECTOR = Device(w=128, h=96, fl_x=260.0, fl_y=255.0, cx=66.0, cy=45.0)
NAMES = ("frame_00000", "frame_00001", "frame_00002", "frame_00003")


def poses(frames: int = len(NAMES)) -> list[tuple[ndarray, ndarray]]:
    """(T_world_camera, T_world_projector) of frames around the sphere, each with another baseline."""
    out, up = [], (0.1, 0.2, 1.0)
    for i in range(frames):
        angle = 2 * np.pi * i / max(frames, 3)
        position = 250 * np.array([np.cos(angle), np.sin(angle), 0.5 + 0.1 * i])
        T_world_camera = look_at(position, (2.0 * i, 0, 0), 0.2 * i, up)
        offset = T_world_camera[:3, :3] @ np.array([60.0 + 5 * i, 20.0 - 10 * i, 4.0])
        out.append((T_world_camera, look_at(position + offset, (0, 3.0 * i, 0), 0.2 * i + 0.1, up)))
    return out


def pattern_image() -> ndarray:
    """A smooth random pattern, uint8."""
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(PROJECTOR.h, PROJECTOR.w)), 2.0)
    return np.clip(128 + 100 * noise / np.abs(noise).max(), 1, 255).astype(np.uint8)


def correspondences(T_world_camera: ndarray, T_world_projector: ndarray) -> ndarray:
    """Coordinates (h, w, 2) of the sphere by the formulas of the format, float32, NaN off the sphere and in shadow."""
    p = on_ball(*rays(CAMERA, T_world_camera), RADIUS)
    lit = (p * (T_world_projector[:3, 3] - p)).sum(-1) > 0  # not where NaN
    return np.where(lit[..., None], pixels(PROJECTOR, T_world_projector, p), np.nan).astype(np.float32)


def look_up(pattern: ndarray, coords: ndarray) -> ndarray:
    """The pattern at the coordinates, 10 where there are none."""
    known = np.isfinite(coords[..., 0])
    uv = np.where(known[..., None], coords, 0)
    values = map_coordinates(pattern.astype(float), [uv[..., 1] - 0.5, uv[..., 0] - 0.5], order=1, mode="nearest")
    return np.where(known, values, 10).round().astype(np.uint8)


def write_sphere(root: Path, frames: int = len(NAMES), color: ndarray | None = None, **settings: Any) -> Path:
    """Write a valid scan; `color` is the picture of every frame, `settings` replace those of ScanWriter."""
    pattern = pattern_image()
    given = {"units": "mm", "scale": Scale(False), "projector": PROJECTOR, "pattern": pattern, "camera": CAMERA}
    with ScanWriter(root, **{**given, **settings}) as writer:
        for i, (T_world_camera, T_world_projector) in enumerate(poses(frames)):
            coords = correspondences(T_world_camera, T_world_projector)
            seen = look_up(pattern, coords)
            writer.add_frame(
                f"frame_{i:05d}", image=seen // 2 + 5, coords=coords, pattern=seen, mask=np.isfinite(coords[..., 0]),
                color=color, T_world_camera=T_world_camera, T_world_projector=T_world_projector,
            )  # fmt: skip
    return root


def edit(root: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change transforms.json as a user's faulty program might: nothing is checked."""
    path = root / "transforms.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    change(document)
    path.write_text(json.dumps(document), encoding="utf-8")


def edit_coords(root: Path, name: str, change: Callable[[ndarray], ndarray]) -> None:
    """Change the coordinates of one frame."""
    path = root / "coords" / f"{name}.npz"
    with np.load(path) as archive:
        coords = archive["coords"]
    np.savez(path, coords=change(coords))


def only_fault(root: Path) -> Fault:
    """The fault of a folder that must have exactly one."""
    faults = check_scan(root)
    assert len(faults) == 1, "\n".join(map(str, faults)) or "no fault"
    return faults[0]
