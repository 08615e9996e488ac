"""From the maps of the U-Net back to the pixels of the capture, with maps that are known exactly."""

from dataclasses import astuple

import cv2
import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_edges import load_unet
from sl_nerfstudio.decoding.grid_graph import PhaseMaps, build_graph, phase_maps
from sl_nerfstudio.decoding.grid_phases import (
    LEAST_MASK,
    MULTIPLE,
    RECTIFIED_PERIOD,
    STRIDE,
    GridAppearance,
    NetworkOnDevice,
    clear_places,
    guess_appearances,
    map_from_pixels,
    measure_appearance,
    network_channels,
    node_places,
    predict_maps,
    rectify,
    sample_pixels,
    spread,
    to_pixel_coordinates,
)
from sl_nerfstudio.pattern.grid import GridPattern

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
    unclear = maps_of(rectified, period, roll, np.full_like(maps.mask, 0.4))
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
    shown = phases.probability > LEAST_MASK
    assert not shown[side < -2 * STRIDE].any() and shown[side > 2 * STRIDE].all()
    assert not (phases.clear & ~shown).any() and np.abs(phases.phase).max() <= 0.5


def test_the_network_reads_the_phases_of_a_drawn_grid():
    """The nodes of the pattern are where the phases that were read are zero."""
    image = capture(14, 0)
    rectified = rectify(image, GridAppearance(14.0, 0.0))
    phases = sample_pixels(predict_maps(rectified, NetworkOnDevice(load_unet())), rectified, image.shape)
    grid = GridPattern()
    x, y = np.meshgrid(*[np.arange(300) + 0.5 - 150] * 2)
    exact = (np.stack([x, y], -1) * 20 / 14 + 400 - (grid.x0, grid.y0)) / grid.period
    off = np.abs((phases.phase - exact + 0.5) % 1 - 0.5)[20:-20, 20:-20]
    assert phases.clear[20:-20, 20:-20].mean() > 0.98
    assert np.median(off) < 0.03 and np.quantile(off, 0.99) < 0.12


# Period and roll of the grid, and the image rectified by them.


GRID = GridPattern(codes=np.random.default_rng(1).integers(0, 5, (40, 40)).astype(np.int8))


def capture(pixels_a_period, roll_deg, size=300):
    """The plain pattern turned clockwise by `roll_deg`."""
    x, y = np.meshgrid(*[np.arange(size) + 0.5 - size / 2] * 2)
    a, scale = np.radians(roll_deg), 20 / pixels_a_period
    uv = np.stack([np.cos(a) * x + np.sin(a) * y, -np.sin(a) * x + np.cos(a) * y], -1) * scale + 400
    return cv2.GaussianBlur((0.05 + 0.7 * GRID.intensity(uv)).astype(np.float32), (0, 0), 0.7)


@pytest.mark.parametrize("pixels", [8, 12, 20, 30])
@pytest.mark.parametrize("roll", [0, 20, -33, 70])
def test_period_and_roll_are_found(pixels, roll):
    image = capture(pixels, roll)
    assert np.allclose(network_channels(image), network_channels(0.3 * image), atol=1e-4)  # whatever the exposure
    found = guess_appearances(image)[0]
    off = (np.degrees(found.roll) - roll + 45) % 90 - 45  # up to quarter turns
    assert abs(off) < 4
    assert abs(np.log(found.period / pixels)) < 0.12
    assert abs(found.roll) <= np.pi / 4


def test_small_images_are_searched_too_and_blank_ones_in_vain():
    for h, w in ((90, 130), (40, 500), (128, 128)):
        found = guess_appearances(capture(12, 0, 500)[:h, :w])[0]
        assert abs(np.log(found.period / 12)) < 0.2 and abs(np.degrees(found.roll)) < 6
    assert guess_appearances(np.full((200, 300), 0.3, np.float32)) == []


def test_the_rectified_image_agrees_with_its_map():
    image = np.zeros((200, 260), np.float32)
    image[150, 70] = 1
    soft = cv2.GaussianBlur(image, (0, 0), 3)
    for appearance in (GridAppearance(10.0, 0.3), GridAppearance(28.0, -0.6), GridAppearance(14.0, 0.0)):
        rectified = rectify(soft, appearance)
        assert rectified.image.shape[0] % MULTIPLE == 0 and rectified.image.shape[1] % MULTIPLE == 0
        y, x = np.mgrid[: rectified.image.shape[0], : rectified.image.shape[1]] + 0.5
        found = np.array([(rectified.image * x).sum(), (rectified.image * y).sum()]) / rectified.image.sum()
        assert np.allclose(found, rectified.from_image @ (70.5, 150.5, 1), atol=0.1)
        assert np.isclose(np.sqrt(np.linalg.det(rectified.from_image[:, :2])), RECTIFIED_PERIOD / appearance.period)


# Phase unwrapping from nodes: exact within reach, and it stops at gaps and tears.
X, Y = np.meshgrid(np.arange(50), np.arange(40))
COORDS = np.stack([X / 10 + 3.2, Y / 10 + 1.1], -1).astype(np.float32)


def spread_from(coords, seen, *places):
    """Nodes at `places` (row, column) of the pattern, which are seen where `COORDS` say."""
    pixels = [np.unravel_index(np.abs(COORDS - place[::-1]).sum(-1).argmin(), X.shape) for place in places]
    phase = (coords - np.rint(coords)).astype(np.float32)
    return spread(phase, seen, np.array(pixels, dtype=np.int32), np.array(places, dtype=np.int32))


def test_one_node_gives_its_surroundings_up_to_two_periods():
    out = spread_from(COORDS, np.ones(X.shape, dtype=bool), (3, 5))
    known = np.isfinite(out[..., 0])
    assert np.allclose(out[known], COORDS[known], atol=1e-5)
    assert (known == (np.abs(COORDS - (5, 3)).max(-1) <= 2.0)).mean() > 0.97


def test_a_gap_and_a_tear_stop_it_and_nodes_outside_say_nothing():
    coords, seen = COORDS.copy(), np.ones(X.shape, dtype=bool)
    coords[:, 30:] += 0.45
    seen[25] = False
    known = np.isfinite(spread_from(coords, seen, (2, 5))[..., 0])
    assert known[:25, :30].all() and not known[25:].any() and not known[:, 30:].any()
    assert np.isnan(spread_from(COORDS, np.zeros_like(seen), (2, 5))).all()  # outside the mask
    outside = np.array([[-1, 5], [100, 2]], dtype=np.int32)
    assert np.isnan(spread(COORDS % 1 - np.float32(0.5), seen, outside, outside * 0)).all()
