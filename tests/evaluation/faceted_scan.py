"""A scan of a lopsided polyhedron, computed by brute force in float64, without the package's geometry or ray caster."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy import ndarray
from scipy.ndimage import map_coordinates

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import write_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scale, ScanWriter
from tests.formulas import look_at, pixels, rays

from .shapes import blob, turn

CAMERA = Device(w=64, h=56, fl_x=150.0, fl_y=155.0, cx=31.0, cy=28.5)
PROJECTOR = Device(w=96, h=80, fl_x=190.0, fl_y=185.0, cx=48.0, cy=41.0)


@dataclass(frozen=True)
class FacetedScan:
    """What varies; lengths are about 80 `units`."""

    frames: int = 3
    units: str = "mm"
    projector: Device = PROJECTOR
    with_truth: bool = True
    wrong_poses_deg: float = 0.0  # every starting pose is turned about the world's origin by about this much
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the whole world
    scale: float = 40.0
    mesh: Mesh = field(default_factory=lambda: blob(6))

    def truth(self) -> Mesh:
        """The true surface in the world."""
        return Mesh(self.mesh.vertices * self.scale + np.array(self.offset), self.mesh.faces)

    def true_poses(self) -> DevicePoses:
        """Camera and projector of all frames, to the world."""
        unit = self.scale / 40
        cameras = [looking_at_origin(270.0 * unit, 2.1 * i, 0.35 + 0.1 * i) for i in range(self.frames)]
        projectors = [looking_at_origin(240.0 * unit, 2.1 * i + 0.4, 0.2) for i in range(self.frames)]
        both = np.array([cameras, projectors])
        both[..., :3, 3] += np.array(self.offset)
        return DevicePoses(both[0], both[1])

    def start_poses(self) -> DevicePoses:
        """What transforms.json holds: the true ones, or frames turned about the world's origin, each its own way."""
        rng = np.random.default_rng(3)
        true = self.true_poses()
        cameras, projectors = true.T_world_camera.copy(), true.T_world_projector.copy()
        for T_c, T_p in zip(cameras, projectors, strict=True):
            motion = np.eye(4)
            motion[:3, :3] = turn(tuple(rng.normal(size=3)), self.wrong_poses_deg)
            T_c[:], T_p[:] = motion @ T_c, motion @ T_p
        return DevicePoses(cameras, projectors)

    def write(self, root: Path) -> Path:
        """Write the scan folder and return it."""
        pattern = dots(self.projector)
        true, start = self.true_poses(), self.start_poses()
        scale = Scale(known=True, source="by construction")
        with ScanWriter(
            root, units=self.units, scale=scale, projector=self.projector, pattern=pattern, camera=CAMERA
        ) as writer:
            for i in range(self.frames):
                mask, coords = self.observe(true.T_world_camera[i], true.T_world_projector[i])
                value = bilinear(pattern, coords)
                writer.add_frame(
                    f"frame_{i:05d}",
                    image=(value * 0.5).astype(np.uint8),
                    pattern=np.round(value).astype(np.uint8),
                    coords=coords.astype(np.float32),
                    mask=mask,
                    T_world_camera=start.T_world_camera[i],
                    T_world_projector=start.T_world_projector[i],
                    true_poses=(true.T_world_camera[i], true.T_world_projector[i]) if self.with_truth else None,
                )
        if self.with_truth:
            write_mesh(root / "ground_truth" / "mesh.ply", self.truth())
        return root

    def observe(self, T_camera: ndarray, T_projector: ndarray) -> tuple[ndarray, ndarray]:
        """Mask, and pattern coordinates where the mask is set (NaN elsewhere)."""
        eye, d = rays(CAMERA, T_camera)
        shape, d = d.shape[:2], d.reshape(-1, 3)
        truth = self.truth()
        t = first_hit(truth, eye, d)
        p = eye + np.where(np.isfinite(t), t, 0)[:, None] * d
        uv = pixels(self.projector, T_projector, p)
        back = p - T_projector[:3, 3]
        lit = np.isfinite(t) & (first_hit(truth, T_projector[:3, 3], back) > 1 - 1e-9)
        lit &= ((uv >= 0) & (uv < [self.projector.w, self.projector.h])).all(1)
        uv[~lit] = np.nan
        return lit.reshape(shape), uv.reshape(*shape, 2)


MADE = FacetedScan()
TRUTH = MADE.truth()


def first_hit(mesh: Mesh, origin: ndarray, directions: ndarray) -> ndarray:
    """Ray parameter of the first triangle hit, infinity for none (Moeller and Trumbore, all rays and triangles)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    best = np.full(len(directions), np.inf)
    for corner, e1, e2 in zip(a, b - a, c - a, strict=True):
        h = np.cross(directions, e2)
        det = h @ e1
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (h @ (origin - corner)) / det
            q = np.cross(origin - corner, e1)
            v, t = (directions @ q) / det, (e2 @ q) / det
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & (np.abs(det) > 1e-12)
        best = np.where(inside & (t < best), t, best)
    return best


def looking_at_origin(distance: float, angle: float, height: float) -> ndarray:
    """Pose of a device on a sphere about the origin, z up, looking at it."""
    return look_at(
        distance * np.array([np.cos(angle) * np.cos(height), np.sin(angle) * np.cos(height), np.sin(height)])
    )


def dots(device: Device) -> ndarray:
    """A smooth random pattern with much contrast."""
    rng = np.random.default_rng(0)
    coarse = rng.random((device.h // 4 + 2, device.w // 4 + 2))
    fine = np.kron(coarse, np.ones((4, 4)))[: device.h + 4, : device.w + 4]
    smooth = np.mean([np.roll(fine, (i, j), (0, 1)) for i in range(4) for j in range(4)], axis=0)
    return np.round(255 * smooth[4:, 4:]).astype(np.uint8)


def bilinear(image: ndarray, uv: ndarray) -> ndarray:
    """Look-up with pixel centres at .5; 0 for NaN."""
    place = np.moveaxis(np.nan_to_num(uv)[..., ::-1] - 0.5, -1, 0)
    value = map_coordinates(image.astype(np.float64), place, order=1, mode="nearest")
    return np.where(np.isnan(uv[..., 0]), 0.0, value)
