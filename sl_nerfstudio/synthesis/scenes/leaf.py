"""A fallen leaf, about 84 x 130 x 38 mm: a thin curved sheet with veins, on a stalk."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.sdf import Field, capsule, mesh_of, union

_HALF_THICKNESS = 1.1  # millimetres
_LENGTH = 118.0
_SLOPE = 1.25  # about the largest length of the gradient of height and veins: keeps values below distances


def leaf(cell: float = 0.65) -> Scene:
    """Lies on z = 0 with its tip towards +y, upper side up; a mesh with edges about `cell` long."""
    tail = _height(np.array([[0.0, -_LENGTH / 2 + 3, 0.0]]))[0]
    stalk = capsule((0, -_LENGTH / 2 + 4, tail), (9, -_LENGTH / 2 - 17, tail + 10.0), 1.7, 2.3)
    found = mesh_of("leaf", union(1.5, _blade(), stalk), (-50, -84, -16), (50, 66, 36), cell, (28.0, 72.0))
    return replace(found, vertices=found.vertices - [0.0, 0.0, found.vertices[:, 2].min()])


def _blade() -> Field:
    """The sheet around `_height`, thicker along the veins, cut to the leaf's outline."""

    def field(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        sheet = (np.abs(p[:, 2] - _height(p)) - _HALF_THICKNESS - _veins(p)) / _SLOPE
        outline = _outline(p)
        # rounded rim: the larger of both values, as a length where both are positive
        outside = np.maximum(sheet, 0) ** 2 + np.maximum(outline, 0) ** 2
        return np.minimum(np.maximum(sheet, outline), 0) + np.sqrt(outside)

    return field


def _height(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Middle of the sheet: a keel along the midrib, an arch from stalk to tip, a curled side, a wavy rim."""
    x, y = p[:, 0], p[:, 1]
    arch = 13.0 * np.cos(np.clip(np.pi * y / 130.0, -2, 2))
    keel = 0.22 * (np.sqrt(x**2 + 36.0) - 6.0)
    curl = 0.0058 * np.maximum(x - 8.0, 0) ** 2
    return arch + keel + curl + 1.3 * np.sin(0.17 * y + 0.6 * np.sign(x)) * np.clip(np.abs(x) / 34.0, 0, 1) ** 2


def _half_width(y: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Of the outline: widest behind the middle, with a drawn-out tip and coarse teeth."""
    t = np.clip((y + _LENGTH / 2) / _LENGTH, 0.0, 1.0)
    smooth = 42.0 * np.sqrt(np.clip(np.sin(np.pi * t**0.8), 0, None)) * (1.12 - 0.55 * t)
    return smooth * (1 + 0.05 * np.sin(2 * np.pi * 9 * t))


def _outline(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Distance outside the outline, roughly; negative inside."""
    beyond = np.abs(p[:, 1]) - _LENGTH / 2
    return np.maximum((np.abs(p[:, 0]) - _half_width(p[:, 1])) / 1.6, beyond)


def _veins(p: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """Extra thickness along the midrib and the side veins that leave it obliquely."""
    x, y = np.abs(p[:, 0]), p[:, 1]
    midrib = 1.2 * np.exp(-((x / 2.2) ** 2))
    along = (y - 0.75 * x) / 13.0
    side = 0.5 * np.exp(-(((along - np.round(along)) * 13.0 / 1.5) ** 2)) * np.clip(x / 4.0, 0, 1)
    return midrib + side
