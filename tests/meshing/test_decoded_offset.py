"""The compiled comparison of vertices with decoded images, against the same formulas for arrays."""

from itertools import product

import numpy as np
import pytest
import torch
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.triangulation import pixel_rays, world_pixels
from sl_nerfstudio.meshing.visibility import compare_decoded, packed_device
from tests.meshing.ray_cast_scan import look_at

MOST_PX = 16.0
COUNT = 3000
LENS = {"k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -2e-3}
PLAIN = Device(96, 80, 160.0, 150.0, 48.0, 40.0), Device(400, 300, 800.0, 780.0, 200.0, 150.0)
BENT = Device(96, 80, 160.0, 150.0, 48.0, 40.0, **LENS), Device(400, 300, 800.0, 780.0, 200.0, 150.0, model="DOE")


def jacobian(points, normals, uv, devices, poses) -> Float[ndarray, "n 2 2"]:
    """Derivative of the predicted coordinate by the camera pixel's x and y, on the tangent plane."""
    columns = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        camera = Intrinsics.of(devices[0], torch.float64)
        origin, direction = pixel_rays(camera, torch.from_numpy(poses[0]), torch.from_numpy(uv[:, 0] + step))
        o, d = origin.numpy(), direction.numpy()
        towards = (d * normals).sum(1)
        distance = ((points - o) * normals).sum(1) / np.where(towards < 0, towards, -1e-12)
        there, _ = world_pixels(devices[1], poses[1], o + distance[:, None] * d)
        columns.append((there - uv[:, 1]).clip(-MOST_PX, MOST_PX))
    return np.stack(columns, -1)


def at(coords: ndarray, row: ndarray, column: ndarray) -> ndarray:
    return coords[np.clip(row, 0, coords.shape[0] - 1), np.clip(column, 0, coords.shape[1] - 1)].astype(float)


def bounds(coords: ndarray, uv: ndarray, J: ndarray) -> tuple[ndarray, ndarray]:
    """Bounds of the distance, by the rule that the compiled file states; which of them are bilinear."""
    slope = np.linalg.norm(J, axis=(1, 2))
    column, row = np.floor(uv[:, 0] - 0.5).astype(int).T
    corners = np.stack([at(coords, row + dy, column + dx) - uv[:, 1] for dy, dx in product((0, 1), repeat=2)])
    spread = np.linalg.norm(corners.max(0) - corners.min(0), axis=1)
    x, y = (uv[:, 0] - 0.5 - np.stack([column, row], 1)).T[:, :, None]
    value = (1 - y) * ((1 - x) * corners[0] + x * corners[1]) + y * ((1 - x) * corners[2] + x * corners[3])
    whole = spread <= 2 * slope + 1
    column, row = np.floor(uv[:, 0]).astype(int).T
    nine = []
    for dy, dx in product((-1, 0, 1), repeat=2):
        away = np.stack([column + dx, row + dy], 1) + 0.5 - uv[:, 0]
        off = at(coords, row + dy, column + dx) - uv[:, 1] - np.einsum("nij,nj->ni", J, away)
        distance, bend = np.linalg.norm(off, axis=1), 0.5 * slope * np.linalg.norm(away, axis=1)
        nine.append(((distance - bend).clip(min=0), distance))
    best = np.fmin.reduce(np.array(nine))
    return np.where(whole, np.linalg.norm(value, axis=1), best).T, whole


@pytest.mark.parametrize("devices", [PLAIN, BENT], ids=["plain", "lens and DOE"])
def test_bounds_are_those_of_the_formulas_for_arrays(devices: tuple[Device, Device]) -> None:
    rng = np.random.default_rng(8)
    poses = look_at((60.0, 0.0, 290.0)), look_at((-40.0, 30.0, 290.0))
    points = np.column_stack([rng.uniform(-80, 80, (COUNT, 2)), rng.uniform(-10, 10, COUNT)])
    normals = rng.normal(size=(COUNT, 3)) * 0.5 + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = [world_pixels(device, T, points) for device, T in zip(devices, poses, strict=True)]
    which = np.flatnonzero(seen[0][1])
    uv = np.stack([pixels for pixels, _ in seen], 1)[which]
    # The coordinates of the plane z = 0, a step across the image, noise, and holes.
    h, w = devices[0].h, devices[0].w
    v, u = np.mgrid[:h, :w] + 0.5
    origin, d = pixel_rays(
        Intrinsics.of(devices[0], torch.float64), torch.from_numpy(poses[0]), torch.from_numpy(np.stack([u, v], -1))
    )
    ground = (origin - origin[..., 2:] / d[..., 2:] * d).numpy().reshape(-1, 3)
    coords = world_pixels(devices[1], poses[1], ground)[0].reshape(h, w, 2) + rng.normal(0, 0.3, (h, w, 2))
    coords[:, 50:] += 25
    coords[rng.random((h, w)) < 0.2] = np.nan
    coords[:20, :20] = np.nan
    mask = rng.random((h, w)) < 0.8
    grown = mask | (rng.random((h, w)) < 0.5)
    coords = coords.astype(np.float32)

    offsets, outside = np.full((len(which), 2), np.nan), np.empty((len(which), 2), dtype=bool)
    packed = np.stack([packed_device(device, T) for device, T in zip(devices, poses, strict=True)])
    compare_decoded(
        *(len(which), points, normals, which, uv, coords, mask, grown, packed, MOST_PX, offsets, outside),
    )
    J = jacobian(points[which], normals[which], uv, devices, poses)
    wanted, whole = bounds(coords, uv, J)
    column, row = np.floor(uv[:, 0]).astype(int).T
    assert np.array_equal(outside, np.stack([~grown[row, column], ~mask[row, column]], 1))
    on = mask[row, column]
    assert min((whole & on).sum(), (~whole & on).sum(), (on & np.isnan(wanted[:, 0])).sum()) > 40
    assert (np.abs(J) == MOST_PX).any()
    np.testing.assert_allclose(offsets[on], wanted[on], rtol=1e-7, atol=1e-7)
    assert np.isnan(offsets[~on]).all()
