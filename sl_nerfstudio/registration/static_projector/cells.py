"""Where every camera sees the centres of small squares of the pattern: matches between all cameras at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.registration.static_projector.settings import CellSettings
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of


@dataclass(frozen=True)
class Cells:
    """Centres of the squares that two cameras or more see."""

    uv_projector: Float64[ndarray, "cells 2"]
    uv_camera: Float64[ndarray, "frames cells 2"]  # NaN where a camera does not see it

    @property
    def seen(self) -> Bool[ndarray, "frames cells"]:
        """Which camera sees which square."""
        return np.isfinite(self.uv_camera[..., 0])

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "cells"]) -> "Cells":
        """Some of the squares."""
        return Cells(self.uv_projector[index], self.uv_camera[:, index])


def find_cells(coords: Sequence[Float32[ndarray, "_ _ 2"]], projector: Device, settings: CellSettings) -> Cells:
    """Squares of equal size; in each, a linear map from coordinates to pixels gives the place of the centre."""
    matches = [correspondences_of(uv) for uv in coords]
    side = _side(matches, projector, settings)
    columns, rows = int(np.ceil(projector.w / side)), int(np.ceil(projector.h / side))
    number = np.arange(columns * rows)
    centres = (np.stack([number % columns, number // columns], -1) + 0.5) * side
    seen = np.stack([_centres_seen(*match, centres, side, columns, rows, settings) for match in matches])
    used = np.isfinite(seen[..., 0]).sum(0) > 1
    return Cells(centres[used], seen[:, used])


def _side(matches: Sequence[tuple[ndarray, ndarray]], projector: Device, settings: CellSettings) -> float:
    """Side of the squares, so that they hold enough camera pixels in most frames."""
    least = max(projector.w, projector.h) / settings.most_along
    density = []
    for _, uv in matches:
        if len(uv):
            column, row = np.floor(uv / (4 * least)).astype(np.int64).clip(0, 4 * settings.most_along).T
            squares = np.count_nonzero(np.bincount(row * (4 * settings.most_along + 1) + column))
            density.append(len(uv) / (squares * 16 * least**2))
    return max(least, float(np.sqrt(settings.pixels / np.median(density)))) if density else least


def _centres_seen(
    uv_camera: Float64[ndarray, "n 2"],
    uv_projector: Float64[ndarray, "n 2"],
    centres: Float64[ndarray, "cells 2"],
    side: float,
    columns: int,
    rows: int,
    settings: CellSettings,
) -> Float64[ndarray, "cells 2"]:
    """Least squares in every square at once, from sums over its pixels."""
    column, row = np.floor(uv_projector / side).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    cell = (row * columns + column)[inside]
    away = (uv_projector[inside] - centres[cell]) / side
    basis = np.concatenate([np.ones((len(away), 1)), away], 1)
    uv = uv_camera[inside]
    count = np.bincount(cell, minlength=len(centres))
    middle = _sums(cell, uv, len(centres)) / count.clip(1)[:, None]
    from_middle = uv - middle[cell]
    A = _sums(cell, basis[:, :, None] * basis[:, None, :], len(centres))
    b = _sums(cell, basis[:, :, None] * from_middle[:, None, :], len(centres))
    squares = _sums(cell, from_middle**2, len(centres))
    out = np.full((len(centres), 2), np.nan)
    good = (count >= settings.fewest) & (np.linalg.det(A) > 1e-6 * count.astype(float) ** 3)
    if not good.any():
        return out
    inverse = np.linalg.inv(A[good])
    linear = inverse @ b[good]
    left = (squares[good] - (linear * b[good]).sum(1)).clip(0).sum(1) / (2 * count[good])
    rough = np.sqrt(left)
    lever = inverse[:, 0, 0] * count[good]  # 1 if the pixels lie around the centre, larger if they lie beside it
    firm = (rough <= settings.roughness_medians * max(float(np.median(rough)), 1e-9)) & (lever < settings.largest_lever)
    index = np.flatnonzero(good)[firm]
    out[index] = middle[index] + linear[firm, 0]
    return out


def _sums(cell: Int64[ndarray, "n"], values: Float64[ndarray, "n *k"], cells: int) -> Float64[ndarray, "cells *k"]:
    """Sums of values over the pixels of each square."""
    flat = values.reshape(len(values), -1)
    columns = [np.bincount(cell, flat[:, k], minlength=cells) for k in range(flat.shape[1])]
    return np.stack(columns, 1).reshape(cells, *values.shape[1:])
