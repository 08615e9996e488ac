"""A step between two planes, one before the other, under the pattern: everything is known."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import exp_se3
from sl_nerfstudio.matching.lines import EpipolarLines
from sl_nerfstudio.pattern.grid import GridPattern

PATTERN = GridPattern(w=500, h=500, codes=np.random.default_rng(5).integers(0, 5, (25, 25)).astype(np.int8))
PERIOD = PATTERN.period
_FINER = 3  # samples of the image a pixel and axis


@dataclass(frozen=True)
class Scene:
    """One capture of it."""

    camera: Device
    projector: Device
    T_camera_projector: Float64[ndarray, "4 4"]  # baseline 1
    image: Float32[ndarray, "h w"]
    inverse_distance: Float64[ndarray, "h w"]
    coords: Float32[ndarray, "h w 2"]
    lines: EpipolarLines


def step_scene(side: int = 200, noise: float = 0.01, seed: int = 0) -> Scene:
    """`side` pixels wide, with about `side / 15` of them a period; the upper bar is nearer, its lower edge at 55 %."""
    camera = Device(w=side, h=side, fl_x=2.6 * side, fl_y=2.6 * side, cx=0.5 * side, cy=0.5 * side)
    projector = Device(w=500, h=500, fl_x=700.0, fl_y=700.0, cx=250.0, cy=250.0)
    T = exp_se3(torch.tensor([1.0, 0.06, 0.0, 0.01, 0.24, 0.03], dtype=torch.float64)).numpy()
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    fine = _at(camera.scaled(float(_FINER)), projector, T)
    whole = _at(camera, projector, T)
    light = PATTERN.intensity(fine.lines.at(fine.inverse_distance)).astype(np.float32)
    light = cv2.resize(light, (side, side), interpolation=cv2.INTER_AREA)
    shade = np.linspace(0.5, 0.8, side, dtype=np.float32)
    image = cv2.GaussianBlur(0.1 + shade * light, (0, 0), 0.7)
    image = image + noise * np.random.default_rng(seed).standard_normal(image.shape).astype(np.float32)
    w = whole.inverse_distance
    return Scene(camera, projector, T, image, w, whole.lines.at(w), whole.lines)


@dataclass(frozen=True)
class _Geometry:
    lines: EpipolarLines
    inverse_distance: Float64[ndarray, "h w"]


def _at(camera: Device, projector: Device, T: Float64[ndarray, "4 4"]) -> _Geometry:
    """Planes have inverse distances that are linear over the image, but for the length of a ray."""
    row, column = (np.mgrid[: camera.h, : camera.w] + 0.5) / camera.h - 0.5
    length = np.sqrt(1 + (row / 2.6) ** 2 + (column / 2.6) ** 2)
    far, near = 0.245 + 0.03 * column + 0.015 * row, 0.27 - 0.02 * column
    return _Geometry(EpipolarLines.of(camera, projector, T), np.where(row < 0.05, near, far) / length)


def across(lines: EpipolarLines, w: Float64[ndarray, "h w"]) -> Float64[ndarray, "h w 2"]:
    """Unit vectors perpendicular to the lines in the pattern's image."""
    slope = lines.slopes(w)
    return np.stack([-slope[..., 1], slope[..., 0]], -1) / np.linalg.norm(slope, axis=-1, keepdims=True)
