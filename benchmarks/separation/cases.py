"""Decoded frames of an object in its surroundings, as noisy as those of real captures, with their truth."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from benchmarks.separation.objects import in_the_room, surroundings
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.triangulation import epipolar_residual
from sl_nerfstudio.object_separation.planes import DecodedFrame
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import CoordinateNoise, DevicePair, disturb_coords, make_devices, make_paths
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, above_the_table, visible_centres
from sl_nerfstudio.synthesis.sdf import Scene
from sl_nerfstudio.synthesis.synthesise import make_cells

_KEPT_PX = 1.5  # epipolar; sl-process drops what contradicts the pose


@dataclass(frozen=True)
class Case:
    """Decoded frames, and where each shows the object."""

    frames: tuple[DecodedFrame, ...]
    is_object: tuple[Bool[ndarray, "h w"], ...]


@dataclass(frozen=True)
class Conditions:
    """How the frames of a case are captured."""

    frames: int = 24
    resolution: int = 300
    zoom: float = 1.0  # below 1, both devices see more of the surroundings
    noise_px: float = 0.3
    pose_deg: float = 0.05  # error of each frame as a whole, about the object, per axis
    seed: int = 0


def make_case(scene: Scene, background: str, given: Conditions) -> Case:
    """Cast and disturb the coordinates of all frames: 15 % of the cells are missing, 2 % wrong."""
    rng = np.random.default_rng([given.seed, 7])
    if background != "none":
        scene = above_the_table(scene)
    caster = RayCaster(scene, surroundings(background, scene, rng))
    poses = _poses(scene, background, given.frames, rng)
    layout = GridPattern()
    devices = make_devices(scene, poses, (layout.w, layout.h), SynthConfig(resolution=given.resolution))
    camera, projector = (
        replace(d, fl_x=given.zoom * d.fl_x, fl_y=given.zoom * d.fl_y) for d in (devices.camera, devices.projector)
    )
    devices = DevicePair(camera, projector)
    cells = make_cells(layout.render(), layout.lattice)
    noise = CoordinateNoise(given.noise_px, 0.15, 0.02)
    frames, objects = [], []
    for T_c, T_p in zip(poses.T_world_camera, poses.T_world_projector, strict=True):
        found = visible_centres(FrameGeometry(caster, devices, T_c, T_p))
        mask, exact = found.lit.reshape(camera.h, camera.w), found.coords(camera)
        exact_frame = DecodedFrame(camera, projector, T_c, T_p, disturb_coords(exact, mask, cells, noise, rng), mask)
        wrong = _wrong_pose(T_c[:3, 3], scene.centre, given.pose_deg, rng)
        frames.append(replace(
            exact_frame, coords=_consistent(exact_frame), T_world_camera=wrong @ T_c, T_world_projector=wrong @ T_p
        ))  # fmt: skip
        objects.append(mask & caster.on_object(found.face).reshape(mask.shape))
    return Case(tuple(frames), tuple(objects))


def _poses(scene: Scene, background: str, frames: int, rng: np.random.Generator) -> DevicePoses:
    """A walk around the object; in a room, only frames from inside it."""
    if background != "room":
        return make_paths(scene, frames, "hand-held", rng)
    poses = make_paths(scene, 3 * frames, "hand-held", rng)
    inside = in_the_room(scene, poses.stacked()[:, :3, 3]).reshape(2, -1).all(0)
    return poses[np.flatnonzero(inside)[:frames]]


def _consistent(frame: DecodedFrame) -> Float32[ndarray, "h w 2"]:
    """The coordinates that agree with the poses, as sl-process keeps them."""
    row, column = np.nonzero(np.isfinite(frame.coords).all(-1))
    residual = epipolar_residual(
        Intrinsics.of(frame.camera, torch.float64), torch.from_numpy(frame.T_world_camera),
        torch.from_numpy(np.stack([column, row], -1) + 0.5), Intrinsics.of(frame.projector, torch.float64),
        torch.from_numpy(frame.T_world_projector), torch.from_numpy(frame.coords[row, column].astype(np.float64)),
    )  # fmt: skip
    coords = frame.coords.copy()
    wrong = ~(residual.abs().numpy() <= _KEPT_PX)
    coords[row[wrong], column[wrong]] = np.nan
    return coords


def _wrong_pose(
    position: Float[ndarray, "3"], centre: Float[ndarray, "3"], degrees: float, rng: np.random.Generator
) -> Float64[ndarray, "4 4"]:
    """A small motion of a frame as a whole, about the object."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal(3)).as_matrix()
    shift = np.radians(degrees) / 9 * np.linalg.norm(position - centre) * rng.standard_normal(3)
    T[:3, 3] = centre - T[:3, :3] @ centre + shift
    return T
