"""Unit and axes of mesh files: glTF has both, STL has a customary unit, PLY and OBJ have neither."""

import numpy as np

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.scan.types import UNITS

Y_UP_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Turns z up into y up, as programs do that read and write glTF: (x, y, z) becomes (x, z, -y)."""


def file_from_world(suffix: str, units: str) -> Similarity:
    """From a scan's world and unit to what a mesh file holds.

    glTF (.glb) is in metres with y up by its specification; STL (.stl) in millimetres by custom, in the scan's axes.
    One arbitrary unit becomes one of the file's.
    """
    metres = UNITS[units]
    if suffix == ".glb":
        return Similarity(metres or 1.0, Y_UP_Z_UP, np.zeros(3))
    return Similarity.scaling(metres * 1000 if suffix == ".stl" and metres else 1.0)
