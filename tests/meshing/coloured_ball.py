"""A ball whose colour is a function of the place, in pictures made by formula."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.images import encode_png
from tests.formulas import on_ball, rays

from .ray_cast_scan import pairs_around, scan_of
from .solids import mesh_of

RADIUS = 40.0
BALL = mesh_of(trimesh.creation.icosphere(4, RADIUS))
PINHOLE = Device(w=128, h=112, fl_x=300.0, fl_y=310.0, cx=60.0, cy=58.0)
Colour = Callable[[np.ndarray], np.ndarray]


def colour_at(p: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1]: three different gradients, of which none is symmetric in the image."""
    return 0.5 + p / (2.5 * RADIUS)


def picture(T_world_camera: np.ndarray, camera: Device = PINHOLE, colour: Colour = colour_at) -> np.ndarray:
    """What a pinhole camera sees of the ball, by the formulas of the format; black beside it."""
    p = on_ball(*rays(camera, T_world_camera), RADIUS)
    return np.round(np.nan_to_num(colour(p)) * 255).astype(np.uint8)


def coloured_scan(root: Path, pictures: int, camera: Device = PINHOLE, colour: Colour = colour_at) -> Scan:
    """Four captures from above, of which the first ones were also taken without the pattern."""
    scan = scan_of(BALL, pairs_around(4, 40), root, camera=camera)
    (root / "color").mkdir()
    frames = list(scan.frames)
    for k, frame in enumerate(frames[:pictures]):
        path = root / f"color/{frame.name}.png"
        path.write_bytes(encode_png(picture(frame.T_world_camera, camera, colour)))
        frames[k] = replace(frame, color_path=path)
    return replace(scan, frames=tuple(frames))


def angle_cosines(scan: Scan, frames: range, points: np.ndarray) -> np.ndarray:
    """Cosine between the ball's normal and the line of sight, of each frame and point of the ball."""
    eyes = np.stack([scan.frames[k].T_world_camera[:3, 3] for k in frames])
    way = eyes[:, None] - points
    return (way * points).sum(2) / np.linalg.norm(way, axis=2) / RADIUS
