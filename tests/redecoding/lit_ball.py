"""A ball under a coded grid, by the formulas of the scan format alone: coordinates, images, and its mesh."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.pattern.grid import GridPattern, sample_bilinear
from tests.formulas import look_at, on_ball, pixels, rays
from tests.meshing.solids import extracted

RADIUS = 40.0  # mm, about the origin
CAMERA = Device(w=160, h=160, fl_x=460.0, fl_y=460.0, cx=80.0, cy=80.0)
PROJECTOR = Device(w=400, h=400, fl_x=1200.0, fl_y=1200.0, cx=200.0, cy=200.0)
T_CAMERA, T_PROJECTOR = look_at((0, -300, 60)), look_at((90, -290, 40))


@dataclass(frozen=True)
class Lit:
    """What the rays through some camera pixels see."""

    coords: ndarray  # NaN where no light falls
    p_world: ndarray


@cache
def grid(seed: int = 0) -> ndarray:
    """The projected pattern."""
    return GridPattern(w=PROJECTOR.w, h=PROJECTOR.h, seed=seed).render()


@cache
def ball(cells: int = 90) -> Mesh:
    """The ball as a mesh."""
    return extracted(lambda p: p.norm(dim=-1) - RADIUS, cells, 44.0)


def seen_at(x: ndarray, y: ndarray) -> Lit:
    """The nearest point of the ball on the ray of a camera pixel, and where the projector sees it."""
    p = on_ball(*rays(CAMERA, T_CAMERA, np.stack([x, y], -1)), RADIUS)
    uv = pixels(PROJECTOR, T_PROJECTOR, p)
    lit = ((T_PROJECTOR[:3, 3] - p) * p).sum(-1) > 0  # not where NaN
    lit &= (uv >= 0).all(-1) & (uv < (PROJECTOR.w, PROJECTOR.h)).all(-1)
    return Lit(np.where(lit[..., None], uv, np.nan), p)


@cache
def truth() -> ndarray:
    """Exact coordinates at the pixel centres, float32."""
    y, x = np.mgrid[: CAMERA.h, : CAMERA.w] + 0.5
    return seen_at(x, y).coords.astype(np.float32)


@cache
def picture(seed: int = 0) -> ndarray:
    """What the camera sees: the mean of nine rays a pixel, under slanted light of its own."""
    y, x = np.mgrid[: CAMERA.h, : CAMERA.w].astype(float)
    total = np.zeros((CAMERA.h, CAMERA.w))
    for dy in (1 / 6, 3 / 6, 5 / 6):
        for dx in (1 / 6, 3 / 6, 5 / 6):
            total += np.nan_to_num(sample_bilinear(grid(seed), seen_at(x + dx, y + dy).coords)) / 9
    return (0.1 + (0.3 + 0.4 * x / CAMERA.w) * total).astype(np.float32)


def with_holes(coords: ndarray, share: float, seed: int = 0) -> ndarray:
    """The coordinates without whole cells of the grid, chosen at random."""
    rng = np.random.default_rng(seed)
    missing = rng.random((21, 21)) < share
    known = np.isfinite(coords).all(-1)
    cell = np.zeros((*known.shape, 2), dtype=int)
    cell[known] = (coords[known] // 20).astype(int)
    out = coords.copy()
    out[missing[cell[..., 1], cell[..., 0]] & known] = np.nan
    return out
