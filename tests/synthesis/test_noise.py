"""Noise: as much as was asked for, where it was asked for, and nothing else."""

import numpy as np
import pytest

from sl_nerfstudio.synthesis.devices import CoordinateNoise, NoisyCells, disturb_coords, disturb_image

_CELLS = NoisyCells(period=20.0, x0=10.0, y0=10.0, rows=40, columns=40, w=800, h=800)
_SIZE = 240


@pytest.fixture(scope="module")
def clean():
    """A turned plane under the pattern, seen on a disc."""
    y, x = np.mgrid[:_SIZE, :_SIZE] + 0.5
    coords = np.stack([60 + 2.4 * x + 0.3 * y, 50 - 0.25 * x + 2.6 * y], -1)
    mask = (x - 120) ** 2 + (y - 110) ** 2 < 100**2
    coords[~mask] = np.nan
    return coords.astype(np.float32), mask


def _disturbed(clean, sigma=0.0, missing=0.0, wrong=0.0, seed=0):
    return disturb_coords(*clean, _CELLS, CoordinateNoise(sigma, missing, wrong), np.random.default_rng(seed))


def _cell_of(clean):
    coords, mask = clean
    return np.floor(coords[mask] / 20).astype(int)  # cells of the default grid tile the pattern from 0


def _by_cell(clean, flags):
    """Share of flagged pixels in each cell that is seen."""
    cells, index = np.unique(_cell_of(clean), axis=0, return_inverse=True)
    return cells, np.bincount(index, flags) / np.bincount(index)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 2.0])
def test_jitter_is_white_and_has_its_standard_deviation(clean, sigma):
    coords, mask = clean
    error = (_disturbed(clean, sigma) - coords)[mask]
    n = len(error)
    assert np.abs(error.std(0) / sigma - 1).max() < 4 / np.sqrt(2 * n)
    assert np.abs(error.mean(0)).max() < 4 * sigma / np.sqrt(n)
    assert abs(np.corrcoef(error.T)[0, 1]) < 4 / np.sqrt(n)
    assert np.abs(np.corrcoef(error[:-1, 0], error[1:, 0])[0, 1]) < 4 / np.sqrt(n)
    assert np.isnan(_disturbed(clean, sigma)[~mask]).all()


@pytest.mark.parametrize("missing", [0.05, 0.15, 0.6])
def test_missing_cells_are_whole_and_as_many_as_asked(clean, missing):
    out = _disturbed(clean, missing=missing)
    coords, mask = clean
    gone = np.isnan(out[mask])
    assert np.array_equal(gone[:, 0], gone[:, 1])
    _, share = _by_cell(clean, gone[:, 0])
    assert set(np.unique(share)) == {0.0, 1.0}
    assert share.sum() == round(missing * len(share))
    assert np.array_equal(out[mask][~gone[:, 0]], coords[mask][~gone[:, 0]])


def test_missing_cells_gather_in_patches(clean):
    cells, share = _by_cell(clean, np.isnan(_disturbed(clean, missing=0.15)[clean[1]][:, 0]))
    gone = np.zeros((42, 42))
    gone[cells[:, 0] + 1, cells[:, 1] + 1] = share
    seen = np.zeros((42, 42))
    seen[cells[:, 0] + 1, cells[:, 1] + 1] = 1
    right = (gone[:-1] * gone[1:]).sum() / (gone[:-1] * seen[1:]).sum()  # of a missing cell's neighbours
    assert right > 1.5 * 0.15


@pytest.mark.parametrize("wrong", [0.02, 0.10])
def test_wrong_cells_are_whole_periods_off_as_many_as_asked_and_inside_the_pattern(clean, wrong):
    coords, mask = clean
    slip = (_disturbed(clean, wrong=wrong) - coords)[mask] / 20
    assert np.abs(slip - np.rint(slip)).max() < 1e-4
    slip = np.rint(slip)
    assert 1 <= np.abs(slip).max() <= 5
    _, share = _by_cell(clean, slip.any(1))
    assert set(np.unique(share)) == {0.0, 1.0}
    assert share.sum() == round(wrong * len(share))
    _, mean_x = _by_cell(clean, slip[:, 0])
    assert np.array_equal(mean_x, np.rint(mean_x)), "all pixels of a cell slip together"
    out = _disturbed(clean, wrong=wrong)[mask]
    assert out.min() >= 0 and out.max() <= 800


def test_all_three_together(clean):
    coords, mask = clean
    error = (_disturbed(clean, 0.3, 0.15, 0.02) - coords)[mask]
    gone = np.isnan(error[:, 0])
    off = np.abs(np.nan_to_num(error)).max(1) > 10
    _, missing = _by_cell(clean, gone)
    _, wrong = _by_cell(clean, off)
    assert missing.sum() == round(0.15 * len(missing)) and wrong.sum() == round(0.02 * len(wrong))
    right = ~gone & ~off
    assert error[right].std() == pytest.approx(0.3, rel=0.02)
    assert (error[off] - 20 * np.rint(error[off] / 20)).std() == pytest.approx(0.3, rel=0.15)


def test_no_coordinate_leaves_the_pattern():
    coords = np.zeros((30, 30, 2), np.float32) + np.array([0.1, 799.9], np.float32)
    out = disturb_coords(
        coords, np.ones((30, 30), bool), _CELLS, CoordinateNoise(1.0, 0.0, 0.0), np.random.default_rng(0)
    )
    assert out.min() >= 0 and out.max() <= 800 and out.std(axis=(0, 1)).min() > 0.3


def test_an_empty_mask():
    coords = np.full((8, 8, 2), np.nan, np.float32)
    out = disturb_coords(
        coords, np.zeros((8, 8), bool), _CELLS, CoordinateNoise(0.3, 0.15, 0.02), np.random.default_rng(0)
    )
    assert np.isnan(out).all()


def test_images_have_shot_noise_saturation_and_eight_bits():
    rng = np.random.default_rng(0)
    levels = np.repeat(np.array([0.0, 0.2, 0.8, 3.0], np.float32), 40_000).reshape(4, 40_000)
    image = disturb_image(levels, 0.9, 0.02, rng) / 255
    assert image[1].mean() == pytest.approx(0.18, abs=1e-3) and image[2].mean() == pytest.approx(0.72, abs=1e-3)
    assert image[1].std() == pytest.approx(0.02 * np.sqrt(0.15 + 0.85 * 0.18), rel=0.05)
    assert image[2].std() == pytest.approx(0.02 * np.sqrt(0.15 + 0.85 * 0.72), rel=0.05)
    assert (image[3] == 1).all()
    assert np.array_equal(disturb_image(levels, 0.9, 0.0, rng)[1], np.full(40_000, round(0.18 * 255)))
