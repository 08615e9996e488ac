"""From the maps of the U-Net back to the pixels of the capture, with maps that are known exactly."""

from dataclasses import astuple

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_edges import load_unet
from sl_nerfstudio.decoding.grid_graph import PhaseMaps, build_graph, phase_maps
from sl_nerfstudio.decoding.grid_phases import (
    RECTIFIED_PERIOD,
    STRIDE,
    GridAppearance,
    clear_places,
    map_from_pixels,
    measure_appearance,
    node_places,
    predict_maps,
    rectify,
    sample_pixels,
    to_pixel_coordinates,
)
from sl_nerfstudio.pattern.grid import GridPattern
from tests.decoding.test_rectify import capture

APPEARANCE = GridAppearance(20.0, 0.3)


def maps_of(rectified, period, roll, mask=None):
    """Maps of a grid whose lines have this period and roll in the rectified image; coordinates 0 at its corner."""
    h, w = (side // STRIDE for side in rectified.image.shape)
    x, y = np.meshgrid(STRIDE * (np.arange(w) + 0.5), STRIDE * (np.arange(h) + 0.5))
    coords = np.stack([np.cos(roll) * x + np.sin(roll) * y, -np.sin(roll) * x + np.cos(roll) * y], -1) / period
    angle = 2 * np.pi * coords
    vector = np.stack([np.cos(angle[..., 0]), np.sin(angle[..., 0]), np.cos(angle[..., 1]), np.sin(angle[..., 1])])
    mask = np.ones((h, w)) if mask is None else mask
    return phase_maps(mask.astype(np.float32), vector.astype(np.float32), np.zeros((5, h, w), np.float32))


@pytest.fixture(scope="module")
def rectified():
    return rectify(np.random.default_rng(0).random((150, 210)).astype(np.float32), APPEARANCE)


def test_places_and_pixels_are_inverse(rectified):
    pixels = np.random.default_rng(0).uniform(0, 150, (40, 2))
    centred = np.column_stack([pixels - 0.5, np.ones(40)])  # as in OpenCV
    places = (centred @ map_from_pixels(rectified).T).astype(np.float32)
    np.testing.assert_allclose(to_pixel_coordinates(places, rectified), pixels, atol=1e-3)


@pytest.mark.parametrize(("period", "roll"), [(RECTIFIED_PERIOD, 0.0), (10.0, 0.2), (20.0, -0.25)])
def test_the_appearance_is_measured_from_the_phases(rectified, period, roll):
    maps = maps_of(rectified, period, roll)
    found = measure_appearance(maps, APPEARANCE, clear_places(maps))
    assert found.period == pytest.approx(APPEARANCE.period * period / RECTIFIED_PERIOD, rel=1e-3)
    assert found.roll == pytest.approx(APPEARANCE.roll + roll, abs=1e-3)


def test_without_clear_phases_there_is_no_appearance(rectified):
    maps = maps_of(rectified, 14.0, 0.0)
    unclear = maps_of(rectified, 14.0, 0.0, np.full_like(maps.mask, 0.4))
    assert measure_appearance(unclear, APPEARANCE, clear_places(unclear)) is None


def test_other_textures_do_not_count_where_the_nodes_are_known(rectified):
    """The upper half shows the grid, the lower half something finer that reads like one."""
    maps, other = maps_of(rectified, 16.0, 0.1), maps_of(rectified, 9.0, -0.2)
    half = maps.mask.shape[0] // 2
    mixed = PhaseMaps(
        *(
            np.concatenate([a[..., :half, :], b[..., half:, :]], -2)
            for a, b in zip(astuple(maps), astuple(other), strict=True)
        )
    )
    graph = build_graph(mixed)
    found = measure_appearance(mixed, APPEARANCE, node_places(mixed, graph, graph.place[:, 1] < half - 4))
    assert found.period == pytest.approx(APPEARANCE.period * 16 / RECTIFIED_PERIOD, rel=0.01)


def test_phases_at_pixels_are_those_of_the_pixels_places(rectified):
    mask = np.ones([side // STRIDE for side in rectified.image.shape])
    mask[:, : mask.shape[1] // 2] = 0
    phases = sample_pixels(maps_of(rectified, 14.0, 0.0, mask), rectified, (150, 210))
    x, y = np.meshgrid(np.arange(210) + 0.5, np.arange(150) + 0.5)
    there = np.stack([x, y, np.ones_like(x)], -1) @ rectified.from_image.T
    exact = there / 14.0
    off = np.abs((phases.phase - exact + 0.5) % 1 - 0.5).max(-1)
    side = there[..., 0] - STRIDE * (mask.shape[1] // 2)
    assert off[phases.clear].max() < 0.05 and np.median(off[phases.clear]) < 0.005  # bilinear values
    assert phases.clear.sum() > 0.8 * (side > 0).sum()
    assert not phases.mask[side < -2 * STRIDE].any() and phases.mask[side > 2 * STRIDE].all()
    assert not (phases.clear & ~phases.mask).any() and np.abs(phases.phase).max() <= 0.5


def test_the_network_reads_the_phases_of_a_drawn_grid():
    """The nodes of the pattern are where the phases that were read are zero."""
    image = capture(14, 0)
    rectified = rectify(image, GridAppearance(14.0, 0.0))
    phases = sample_pixels(predict_maps(rectified, load_unet()), rectified, image.shape)
    grid = GridPattern()
    x, y = np.meshgrid(*[np.arange(300) + 0.5 - 150] * 2)
    exact = (np.stack([x, y], -1) * 20 / 14 + 400 - (grid.x0, grid.y0)) / grid.period
    off = np.abs((phases.phase - exact + 0.5) % 1 - 0.5)[20:-20, 20:-20]
    assert phases.clear[20:-20, 20:-20].mean() > 0.98
    assert np.median(off) < 0.03 and np.quantile(off, 0.99) < 0.12
