"""A projector that stands still: cameras from its codes, its intrinsics by resection."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.registration.static_projector import (
    STATIC_DEFAULTS,
    NoPlacement,
    StaticPlacement,
    find_cells,
    place_under_static_projector,
    resect,
)
from sl_nerfstudio.relative_pose.unknown_projector import values_of
from tests.registration.static_projector.still_beam import BEAM, CAMERA, still_beam

BLANK = Device(BEAM.w, BEAM.h, 1.5 * BEAM.w, 1.5 * BEAM.w, BEAM.w / 2, BEAM.h / 2)
QUICK = replace(STATIC_DEFAULTS, most_points=500)


def placed(beam, projector=BLANK, known=False) -> StaticPlacement:
    found = place_under_static_projector(beam.coords, [CAMERA] * len(beam.coords), projector, known, known, QUICK)
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
    assert isinstance(place_under_static_projector(mirrored, [CAMERA] * 2, BLANK, False, False, QUICK), NoPlacement)


def test_cameras_without_common_codes_are_refused():
    beam = still_beam(2)
    left, right = beam.coords[0].copy(), beam.coords[1].copy()
    left[left[..., 0] > BEAM.w / 2] = np.nan
    right[right[..., 0] < BEAM.w / 2] = np.nan
    found = place_under_static_projector([left, right], [CAMERA] * 2, BLANK, False, False, QUICK)
    assert isinstance(found, NoPlacement) and found.fault == "no pair" and found.common < 60


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_centres_of_squares_are_seen_where_a_linear_map_puts_them(factor):
    """Coordinates that are linear in the pixels, to within float32."""
    row, column = np.mgrid[:90, :120] + 0.5
    uv = np.stack([factor * (2 * column + 0.3 * row + 20), factor * (1.5 * row - 0.2 * column + 40)], -1)
    size = Device(int(400 * factor), int(300 * factor), 1.0, 1.0, 0.0, 0.0)
    cells = find_cells([uv.astype(np.float32)] * 2, size, STATIC_DEFAULTS.cells)
    assert len(cells.uv_projector) > 50
    x, y = cells.uv_camera[0].T
    back = np.stack([factor * (2 * x + 0.3 * y + 20), factor * (1.5 * y - 0.2 * x + 40)], -1)
    np.testing.assert_allclose(back, cells.uv_projector, atol=1e-3 * factor)
