"""Noise of captured images and of decoded coordinates; nothing here renders."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8
from numpy import ndarray
from scipy.ndimage import gaussian_filter

_LARGEST_SLIP = 5  # periods by which a wrong cell may be shifted


@dataclass(frozen=True)
class Cells:
    """The cells of a pattern, one around each node: a decoder finds or misses them as a whole."""

    period: float  # pattern pixels
    x0: float  # of the first node
    y0: float
    rows: int
    columns: int
    w: int  # of the pattern
    h: int

    def index(self, coords: Float[ndarray, "n 2"]) -> Int64[ndarray, "n"]:
        """Number of the cell that holds each pattern pixel (x, y)."""
        j = np.clip(np.rint((coords[:, 0] - self.x0) / self.period), 0, self.columns - 1)
        i = np.clip(np.rint((coords[:, 1] - self.y0) / self.period), 0, self.rows - 1)
        return (i * self.columns + j).astype(np.int64)


@dataclass(frozen=True)
class CoordinateNoise:
    """The errors of a decoder."""

    sigma: float  # pattern pixels, each coordinate of each pixel
    missing: float  # fraction of the visible cells that are not decoded
    wrong: float  # fraction of the visible cells that are mistaken for others


def disturb_coords(
    coords: Float32[ndarray, "h w 2"],
    mask: Bool[ndarray, "h w"],
    cells: Cells,
    noise: CoordinateNoise,
    rng: np.random.Generator,
) -> Float32[ndarray, "h w 2"]:
    """Coordinates as decoded: missing cells, cells shifted by whole periods, and jitter everywhere else.

    Of the cells that the frame sees, exactly the given fractions (rounded) are missing and wrong. Missing cells are
    clustered; wrong ones are single or in small groups that share their shift of 1 to 5 periods.
    """
    out = coords.astype(np.float64)
    index = cells.index(coords[mask])
    seen = np.unique(index)
    missing = _missing_cells(seen, cells, round(noise.missing * len(seen)), rng)
    slips = _wrong_cells(np.setdiff1d(seen, missing), cells, round(noise.wrong * len(seen)), rng)
    value = out[mask] + noise.sigma * rng.standard_normal((len(index), 2))
    value += slips[index] * cells.period
    value = np.clip(value, 0, [cells.w, cells.h])  # a decoder never gives coordinates outside the pattern
    value[np.isin(index, missing)] = np.nan
    out[mask] = value
    return out.astype(np.float32)


def disturb_image(
    radiance: Float32[ndarray, "h w"], gain: float, noise: float, rng: np.random.Generator
) -> UInt8[ndarray, "h w"]:
    """An 8-bit image: exposure, shot and read noise (`noise` is their sum at full scale), saturation, rounding."""
    signal = np.clip(radiance * gain, 0, None)
    sigma = noise * np.sqrt(0.15 + 0.85 * signal)
    return np.clip(np.rint(255 * (signal + sigma * rng.standard_normal(signal.shape))), 0, 255).astype(np.uint8)


def _missing_cells(
    seen: Int64[ndarray, "n"], cells: Cells, count: int, rng: np.random.Generator
) -> Int64[ndarray, "m"]:
    """The cells where a smooth random field plus a rough one is highest."""
    rough = rng.standard_normal((cells.rows, cells.columns))
    smooth = gaussian_filter(rng.standard_normal((cells.rows, cells.columns)), 1.2)
    score = (smooth / smooth.std() + 0.7 * rough).reshape(-1)[seen]
    return np.sort(seen[np.argsort(-score, kind="stable")[:count]])


def _wrong_cells(
    candidates: Int64[ndarray, "n"], cells: Cells, count: int, rng: np.random.Generator
) -> Int64[ndarray, "all 2"]:
    """Shift of every cell of the pattern in periods (x, y); zero except for `count` of the candidates."""
    slips = np.zeros((cells.rows * cells.columns, 2), dtype=np.int64)
    free = set(candidates.tolist())
    while count > 0 and free:
        start = int(rng.choice(sorted(free)))
        slip = _slip(start, cells, rng)
        group = [c for c in _block(start, cells, int(rng.integers(1, 5))) if c in free][:count]
        inside = [c for c in group if _stays_inside(c, slip, cells)]
        for cell in inside:
            slips[cell] = slip
        free -= set(inside)
        count -= len(inside)
    return slips


def _block(start: int, cells: Cells, size: int) -> list[int]:
    """Up to four cells in a square of 2 x 2, the first being `start`."""
    i, j = divmod(start, cells.columns)
    square = [(i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)]
    return [r * cells.columns + c for r, c in square[:size] if r < cells.rows and c < cells.columns]


def _slip(cell: int, cells: Cells, rng: np.random.Generator) -> Int64[ndarray, "2"]:
    """A whole number of periods in x and y, not both zero, small ones more often, that keeps `cell` inside."""
    while True:
        size = np.minimum(rng.geometric(0.5, 2) - 1, _LARGEST_SLIP)
        slip = size * rng.choice([-1, 1], 2)
        if slip.any() and _stays_inside(cell, slip, cells):
            return slip


def _stays_inside(cell: int, slip: Int64[ndarray, "2"], cells: Cells) -> bool:
    i, j = divmod(cell, cells.columns)
    return bool(0 <= i + slip[1] < cells.rows and 0 <= j + slip[0] < cells.columns)
