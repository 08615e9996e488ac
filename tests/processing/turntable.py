"""An object on a turntable before a wall and on a table that stand still, seen by a camera that stands still."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DISTANCE, DevicePair, _rig, look_at
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, _box, _faceted, visible_centres
from sl_nerfstudio.synthesis.scenes import Scene
from sl_nerfstudio.synthesis.synthesise import make_setup
from tests.processing.ramp_scan import RampScan, make_captures

STEP_DEG = 24.0


@dataclass(frozen=True)
class TurntableScan:
    """The captures, and what each frame shows."""

    scan: RampScan
    is_object: tuple[np.ndarray, ...]  # of every frame
    turns_deg: tuple[float, ...]  # of the object


def make_turntable_scan(
    root: Path,
    frames: int = 6,
    step_deg: float = STEP_DEG,
    moving_projector: bool = False,
    errors_px: np.ndarray | float = 0.0,
) -> TurntableScan:
    """Captures of frames in which the object is turned by `step_deg` more each; 0: nothing moves.

    `errors_px` are added to the coordinates of every frame alike.
    """
    setup = make_setup(SynthConfig(scene="head", frames=frames, resolution=240, path="rigid-rig", seed=0))
    setup = replace(setup, devices=DevicePair(*(_wider(d) for d in (setup.devices.camera, setup.devices.projector))))
    scene, room = setup.scene, _room(setup.scene)
    eye = scene.centre + DISTANCE * scene.size * np.array([0.81, 0.25, 0.53])
    T_camera = look_at(eye, scene.centre, np.array(0.05))
    coords, is_object, turns = [], [], []
    for k in range(frames):
        angle = np.radians(step_deg * k)
        R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        turned = replace(scene, vertices=(scene.vertices - scene.centre) @ R.T + scene.centre)
        T_projector = T_camera @ _rig(scene)
        if moving_projector:
            beside = np.array([0.1, (-0.6, 0.5, 0.7, -0.5)[k % 4], 0.2 * (k % 3)]) * scene.size
            T_projector = look_at(T_projector[:3, 3] + beside, scene.centre, np.array(0.2 * np.sin(k)))
        caster = RayCaster(turned, room)
        seen = visible_centres(FrameGeometry(caster, setup.devices, T_camera, T_projector))
        size = setup.devices.camera.h, setup.devices.camera.w
        uv = np.where(seen.lit[:, None], seen.uv_projector, np.nan).reshape(*size, 2)
        coords.append((uv + errors_px).astype(np.float32))
        is_object.append((caster.on_object(seen.face) & seen.lit).reshape(size))
        turns.append(step_deg * k)
    names = tuple(f"f{k}" for k in range(frames))
    return TurntableScan(make_captures(root, setup, coords, names), tuple(is_object), tuple(turns))


def _wider(device):
    return replace(device, fl_x=device.fl_x / 2, fl_y=device.fl_y / 2)


def _room(scene: Scene) -> Scene:
    """A table, a wall behind it and a box at its side."""
    size, centre = scene.size, scene.centre
    top = scene.vertices[:, 2].min() - 1e-3 * size
    corners = np.concatenate([
        _box(np.array([centre[0], centre[1], top - 0.05 * size]), np.array([1.6, 1.6, 0.05]) * size, 0.4),
        _box(centre + np.array([-1.35, -0.4, 0.1]) * size, np.array([0.03, 1.7, 1.0]) * size, 0.3),
        _box(centre + np.array([-0.85, 0.75, -0.2]) * size, np.array([0.16, 0.2, 0.3]) * size, 0.9),
    ])  # fmt: skip
    return _faceted("room", corners)
