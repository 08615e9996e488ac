"""Scans of a mesh made with nothing but the formulas of the scan format: the truth for trimming."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import open3d as o3d
from jaxtyping import Bool, Float
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Frame, Scale, Scan, ScanWriter
from sl_nerfstudio.scan.coordinates import CoordinateFiles
from tests.formulas import look_at, pixels, rays

CAMERA = Device(w=96, h=96, fl_x=160.0, fl_y=160.0, cx=48.0, cy=48.0)
PROJECTOR = Device(w=400, h=400, fl_x=800.0, fl_y=800.0, cx=200.0, cy=200.0)
Change = Callable[[int, Float[ndarray, "h w 2"]], Float[ndarray, "h w 2"]]


def pairs_around(
    count: int, elevation_deg: float, distance: float = 300.0, apart_deg: float = 20.0
) -> list[tuple[ndarray, ndarray]]:
    """Poses (camera, projector) on a circle about the z axis; both look at the origin, `apart_deg` apart."""
    height, radius = distance * np.sin(np.radians(elevation_deg)), distance * np.cos(np.radians(elevation_deg))
    poses = []
    for angle in np.arange(count) * 2 * np.pi / count:
        eyes = [(radius * np.cos(a), radius * np.sin(a), height) for a in (angle, angle + np.radians(apart_deg))]
        poses.append((look_at(eyes[0]), look_at(eyes[1])))
    return poses


def scan_of(
    truth: Mesh, poses: list[tuple[ndarray, ndarray]], root: Path, change: Change | None = None, camera: Device = CAMERA
) -> Scan:
    """Write noise-free captures of `truth`, passed through `change(frame number, coords)`, and give them as a Scan."""
    image, pattern = (np.zeros((device.h, device.w), dtype=np.uint8) for device in (camera, PROJECTOR))
    devices = {"projector": PROJECTOR, "pattern": pattern, "camera": camera}
    scale, frames = Scale(True, "test"), []
    with ScanWriter(root, units="mm", scale=scale, **devices) as writer:
        for number, (T_camera, T_projector) in enumerate(poses):
            coords, mask = captured(truth, camera, T_camera, T_projector)
            coords = coords if change is None else change(number, coords)
            name, T = f"frame_{number:05d}", {"T_world_camera": T_camera, "T_world_projector": T_projector}
            writer.add_frame(name, image=image, coords=coords, mask=mask, **T)
            kinds = ("images", "png"), ("coords", "npz"), ("masks", "png")
            image_path, coords_path, mask_path = (root / f"{folder}/{name}.{ending}" for folder, ending in kinds)
            frames.append(Frame(name, camera, image_path, None, CoordinateFiles((coords_path,)), mask_path, **T))
    return Scan(root, "mm", scale, PROJECTOR, root / "pattern.png", tuple(frames))


def captured(
    truth: Mesh, camera: Device, T_camera: Float[ndarray, "4 4"], T_projector: Float[ndarray, "4 4"]
) -> tuple[Float[ndarray, "h w 2"], Bool[ndarray, "h w"]]:
    """Pattern coordinates of each pixel, NaN where the pattern does not fall, and where it does."""
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(truth.vertices.astype(np.float32)), o3d.core.Tensor(truth.faces.astype(np.uint32))
    )
    eye, direction = rays(camera, T_camera)
    origin = np.broadcast_to(eye, direction.shape)
    depth = _cast(scene, origin, direction)
    hit = np.isfinite(depth)
    p_world = origin + np.where(hit, depth, 1.0)[..., None] * direction
    uv = pixels(PROJECTOR, T_projector, p_world)
    light = T_projector[:3, 3] - p_world
    lit = ~np.isfinite(_cast(scene, p_world + 1e-3 * light, light))
    mask = hit & lit & (uv >= 0).all(-1) & (uv < (PROJECTOR.w, PROJECTOR.h)).all(-1)
    return np.where(mask[..., None], uv, np.nan).astype(np.float32), mask


def _cast(scene: o3d.t.geometry.RaycastingScene, origin: ndarray, direction: ndarray) -> ndarray:
    rays = np.concatenate([origin, direction], -1).astype(np.float32)
    return scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
