"""A projector that stands still: cameras from its codes, its intrinsics by resection."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.triangulation import pixel_centres
from sl_nerfstudio.registration import static_projector
from sl_nerfstudio.registration.static_projector import (
    NoPlacement,
    StaticPlacement,
    find_cells,
    place_under_static_projector,
    resect,
)
from sl_nerfstudio.relative_pose.unknown_projector import values_of
from tests.relative_pose.two_views import aimed, pose_of

CAMERA = Device(160, 120, 200.0, 197.0, 81.0, 59.0, k1=-0.05)
BEAM = Device(640, 400, 1000.0, 1000.0, 310.0, 680.0)
PLACES = ((0.0, 0.0, 0.0), (1.1, 0.2, 0.1), (-0.9, 0.6, -0.2), (0.3, -1.0, 0.2))


@dataclass(frozen=True)
class StillBeam:
    """Coordinates of all cameras, and what is true."""

    coords: list[np.ndarray]
    T_world_camera: np.ndarray
    T_world_projector: np.ndarray


def still_beam(count: int, noise: float = 0.0) -> StillBeam:
    """The surface is z = -4.5 + bumps(x, y); rays meet it by Newton's iterations."""
    T_projector = aimed((0.5, 0.9, 0.0), BEAM, 5.0)
    cameras = [pose_of(place, (0.05, 0.0, -4.5), 8.0 * k) if k else np.eye(4) for k, place in enumerate(PLACES[:count])]
    coords = []
    for k, T in enumerate(cameras):
        uv = pixel_centres(CAMERA, torch.float64)
        d = unproject(Intrinsics.of(CAMERA, torch.float64), uv).numpy().reshape(-1, 3) @ T[:3, :3].T
        o, along = T[:3, 3], np.full(len(d), 4.5)
        for _ in range(60):
            p = o + along[:, None] * d
            along = along + (_height(p) - p[:, 2]) / d[:, 2] * 0.8
        p = o + along[:, None] * d
        seen, front = project(
            Intrinsics.of(BEAM, torch.float64), torch.from_numpy((p - T_projector[:3, 3]) @ T_projector[:3, :3])
        )
        seen = seen.numpy()
        inside = front.numpy() & (seen > 0).all(1) & (seen < (BEAM.w, BEAM.h)).all(1) & (np.abs(p[:, 2] + 4.5) < 1)
        seen = seen + noise * np.random.default_rng(k).standard_normal(seen.shape)
        seen[~inside] = np.nan
        coords.append(seen.reshape(CAMERA.h, CAMERA.w, 2).astype(np.float32))
    return StillBeam(coords, np.stack(cameras), T_projector)


def _height(p: np.ndarray) -> np.ndarray:
    x, y = p[:, 0], p[:, 1]
    return -4.5 + 0.2 * x + 0.25 * (np.sin(2.1 * x + 0.4) * np.cos(1.7 * y) + 0.5 * np.sin(1.3 * x * y + y))


BLANK = Device(BEAM.w, BEAM.h, 1.5 * BEAM.w, 1.5 * BEAM.w, BEAM.w / 2, BEAM.h / 2)


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(static_projector, "MOST_POINTS", 500)


def placed(beam, projector=BLANK, known=False) -> StaticPlacement:
    found = place_under_static_projector(beam.coords, [CAMERA] * len(beam.coords), projector, known, known)
    assert isinstance(found, StaticPlacement)
    return found


def relative_errors(found: StaticPlacement, beam) -> np.ndarray:
    """Angles, in radian, of the projector's rotation against each camera."""
    ours = np.linalg.inv(found.T_world_camera) @ found.T_world_projector
    true = np.linalg.inv(beam.T_world_camera) @ beam.T_world_projector
    trace = np.einsum("nij,nij->n", ours[:, :3, :3], true[:, :3, :3])
    return np.arccos(((trace - 1) / 2).clip(-1, 1))


def test_the_linear_resection_is_exact_wherever_the_principal_point_is():
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (60, 3)) - [0, 0, 5]
    uv = np.stack([1000 * p[:, 0] / -p[:, 2] + 310, -1000 * p[:, 1] / -p[:, 2] + 1900], 1)
    found = resect(p, uv, BLANK)
    assert found is not None
    device, T = found
    np.testing.assert_allclose([device.fl_x, device.fl_y, device.cx, device.cy], [1000, 1000, 310, 1900], rtol=1e-8)
    np.testing.assert_allclose(T, np.eye(4), atol=1e-8)
    flat = p * [1, 1, 0] - [0, 0, 5]
    assert resect(flat, uv, BLANK) is None


def test_two_cameras_and_a_projector_of_which_nothing_is_known():
    beam = still_beam(2)
    found = placed(beam)
    np.testing.assert_allclose(values_of(found.projector)[[0, 2, 3]], values_of(BEAM)[[0, 2, 3]], atol=2e-3)
    assert relative_errors(found, beam).max() < 2e-3


def test_more_cameras_are_placed_one_by_one_and_stated_sigma_covers():
    beam = still_beam(4, noise=0.3)
    found = placed(beam)
    assert np.isfinite(found.T_world_camera).all()
    error, sigma = values_of(found.projector) - values_of(BEAM), np.sqrt(np.diag(found.covariance))
    known = sigma > 0
    assert known.sum() >= 3 and (np.abs(error[known]) < 3.5 * sigma[known]).all()
    assert sigma[0] < 0.01 and relative_errors(found, beam).max() < 5e-3


def test_known_intrinsics_stay_and_only_poses_are_found():
    beam = still_beam(3, noise=0.2)
    found = placed(beam, BEAM, known=True)
    assert found.projector == BEAM and not found.covariance.any()
    assert relative_errors(found, beam).max() < 3e-3


def test_codes_that_are_mirrored_in_one_frame_are_refused():
    beam = still_beam(2)
    mirrored = [beam.coords[0], np.float32([BEAM.w, 0]) + np.float32([-1, 1]) * beam.coords[1]]
    assert isinstance(place_under_static_projector(mirrored, [CAMERA] * 2, BLANK, False, False), NoPlacement)


def test_cameras_without_common_codes_are_refused():
    beam = still_beam(2)
    left, right = beam.coords[0].copy(), beam.coords[1].copy()
    left[left[..., 0] > BEAM.w / 2] = np.nan
    right[right[..., 0] < BEAM.w / 2] = np.nan
    found = place_under_static_projector([left, right], [CAMERA] * 2, BLANK, False, False)
    assert isinstance(found, NoPlacement) and found.fault == "no pair" and found.common < 60


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_centres_of_squares_are_seen_where_a_linear_map_puts_them(factor):
    """Coordinates that are linear in the pixels, to within float32."""
    row, column = np.mgrid[:90, :120] + 0.5
    uv = np.stack([factor * (2 * column + 0.3 * row + 20), factor * (1.5 * row - 0.2 * column + 40)], -1)
    size = Device(int(400 * factor), int(300 * factor), 1.0, 1.0, 0.0, 0.0)
    cells = find_cells([uv.astype(np.float32)] * 2, size)
    assert len(cells.uv_projector) > 50
    x, y = cells.uv_camera[0].T
    back = np.stack([factor * (2 * x + 0.3 * y + 20), factor * (1.5 * y - 0.2 * x + 40)], -1)
    np.testing.assert_allclose(back, cells.uv_projector, atol=1e-3 * factor)
