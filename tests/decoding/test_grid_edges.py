"""Coordinates continued beside edges: the geometry, what the network is given, and what the shipped network gains."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.decoding.grid_edges import (
    CHANNELS,
    MARGIN,
    EdgeChooser,
    EdgeNetwork,
    EdgeView,
    continued,
    slopes,
    steps,
)
from sl_nerfstudio.decoding.grid_fit import draw_sharpnesses
from sl_nerfstudio.decoding.grid_phases import NetworkOnDevice, from_pattern, to_pattern
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import make_setup
from training.edge_errors import continuation_errors
from training.edges import mirrored

SIZE = 64


def plane(size=SIZE):
    y, x = np.mgrid[:size, :size].astype(np.float32)
    return np.stack([0.07 * x + 0.01 * y + 3, 0.06 * y - 0.02 * x + 5], -1).astype(np.float32)


def everywhere(step):
    return np.broadcast_to(np.asarray(step), (SIZE, SIZE, 2))


def test_steps_begin_at_the_pixel_and_go_all_around():
    found = steps()
    assert not found[0].any() and len({tuple(step) for step in found}) == len(found) == 33
    assert np.abs(found.sum(0)).max() == 0


@pytest.mark.parametrize("step", steps())
def test_a_plane_continues_itself(step):
    truth = plane()
    found = continued(truth, slopes(truth, 1.0), everywhere(step))
    y, x = np.mgrid[:SIZE, :SIZE]
    known = (x + step[0] >= 0) & (x + step[0] < SIZE) & (y + step[1] >= 0) & (y + step[1] < SIZE)
    np.testing.assert_allclose(found[known], truth[known], atol=1e-4)
    np.testing.assert_allclose(slopes(20 * truth, 20.0), 20 * slopes(truth, 1.0), rtol=1e-4, atol=1e-5)
    assert np.isnan(found[~known]).all()


def test_a_surface_is_continued_over_its_border_and_into_the_unknown():
    truth = plane()
    coords = truth.copy()
    coords[:, 30:40] = truth[:, 30:40] + 4.0  # another surface
    coords[:, 40:] = np.nan
    found = continued(coords, slopes(coords, 1.0), everywhere((-13, 0)))
    np.testing.assert_allclose(found[:, 30:43], truth[:, 30:43], atol=1e-3)
    np.testing.assert_allclose(found[:, 43:53], truth[:, 43:53] + 4.0, atol=1e-3)
    assert np.isnan(found[:, 53:]).all()


@given(st.integers(0, 3), st.integers(3, 9), st.integers(3, 9))
def test_turned_places_are_those_of_turned_codes(turn, rows, columns):
    codes = np.arange(rows * columns).reshape(rows, columns) % 5
    grid = GridPattern(w=20 * columns, h=20 * rows, codes=codes.astype(np.int8))
    number = np.arange(rows * columns).reshape(rows, columns)
    seen = np.rot90(number, -turn)  # as `rotate_codes` turns the array
    i, j = np.mgrid[: seen.shape[0], : seen.shape[1]]
    coords = to_pattern(np.stack([j, i], -1).astype(np.float32), grid, turn)
    at = np.rint((coords - [grid.x0, grid.y0]) / grid.period).astype(int)
    np.testing.assert_array_equal(number[at[..., 1], at[..., 0]], seen)
    np.testing.assert_allclose(from_pattern(coords, grid, turn), np.stack([j, i], -1), atol=1e-4)


def random_view(rng):
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    fitted = np.stack([5 * x + np.sin(3 * y), 4 * y + x * x], -1)
    fitted[20:30, 15:40] += 2
    fitted[rng.random((SIZE, SIZE)) < 0.1] = np.nan
    return EdgeView(
        rng.normal(size=(7, SIZE, SIZE)).astype(np.float32),
        fitted.astype(np.float32),
        (fitted + rng.normal(0, 0.1, fitted.shape)).astype(np.float32),
        rng.normal(size=(8, SIZE, SIZE)).astype(np.float32),
    )


@pytest.mark.parametrize("how", range(8))
def test_mirrored_channels_are_those_of_the_mirrored_capture(how):
    view = random_view(np.random.default_rng(0))
    swapped, angle = bool(how & 4), 2 * np.pi * np.arange(8) / 8
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)

    def image(values):  # (h, w, ..)
        values = values[:, ::-1] if how & 1 else values
        values = values[::-1] if how & 2 else values
        return np.swapaxes(values, 0, 1) if swapped else values

    def vector(values):  # (.., 2)
        values = values * np.where([how & 1, how & 2], -1, 1).astype(values.dtype)
        return values[..., ::-1] if swapped else values

    def layers(values):
        return np.moveaxis(image(np.moveaxis(values, 0, -1)), -1, 0)

    order = [int(np.argmax(vector(direction) @ one)) for one in direction]
    other = EdgeView(
        layers(view.measured), image(vector(view.fitted)), image(vector(view.read)), layers(view.continued)[order]
    )
    slope = slopes(view.fitted, 1.0)
    found = mirrored(view.channels(), view.fitted, slope, view.read, how)
    np.testing.assert_allclose(found.channels, other.channels(), atol=1e-5)
    np.testing.assert_allclose(found.fitted, np.moveaxis(other.fitted, -1, 0))
    np.testing.assert_allclose(found.slope, np.moveaxis(slopes(other.fitted, 1.0), (2, 3), (0, 1)), atol=1e-4)


def test_errors_in_training_are_those_of_continued_coordinates():
    rng = np.random.default_rng(1)
    view = random_view(rng)
    slope, true = slopes(view.fitted, 1.0), np.nan_to_num(view.read, nan=3.0)
    parts = [torch.from_numpy(np.ascontiguousarray(np.moveaxis(v, (0, 1), (-2, -1))))[None]
             for v in (view.fitted, slope, true)]  # fmt: skip
    errors = continuation_errors(*parts)[0].numpy()
    for k, step in enumerate(steps()):
        expected = np.linalg.norm(continued(view.fitted, slope, everywhere(step)) - true, axis=-1)
        np.testing.assert_allclose(errors[k], expected, atol=1e-4)


def test_strips_of_an_image_give_what_the_whole_gives():
    """The margin covers all pixels that an output depends on, so no seam shows."""
    torch.manual_seed(0)
    network = EdgeNetwork().double().eval()
    torch.nn.init.normal_(network.head.weight)
    image = torch.randn(1, CHANNELS, 2 * MARGIN + 32, 48, dtype=torch.float64)
    first = MARGIN + 16
    with torch.inference_mode():
        whole, above = network(image), network(image[:, :, : first + MARGIN])
        below = network(image[:, :, first - MARGIN :])
        near = network(image[:, :, first - MARGIN + 32 :])
    for name in ("step", "wrong"):
        a = getattr(whole, name)
        torch.testing.assert_close(getattr(above, name)[..., :first, :], a[..., :first, :], atol=1e-9, rtol=0)
        torch.testing.assert_close(getattr(below, name)[..., MARGIN:, :], a[..., first:, :], atol=1e-9, rtol=0)
    assert (near.step[..., MARGIN - 32 :, :] - whole.step[..., first:, :]).abs().max() > 1e-9  # less is not enough


@pytest.mark.parametrize("rows", [64, 2 * MARGIN + 560])  # one strip, and two
def test_the_step_that_is_chosen_is_the_best_of_the_possible_ones(rows):
    torch.manual_seed(1)
    rng = np.random.default_rng(2)
    network = EdgeNetwork().eval().to(memory_format=torch.channels_last)
    torch.nn.init.normal_(network.head.weight)
    fitted = rng.random((rows, 48, 2)).astype(np.float32)
    fitted[rng.random((rows, 48)) < 0.9] = np.nan
    layers = [rng.normal(size=(count, rows, 48)).astype(np.float32) for count in (7, 8)]
    view = EdgeView(layers[0], fitted, fitted, layers[1])
    grid = GridPattern()
    chooser = EdgeChooser(NetworkOnDevice(network), grid, draw_sharpnesses(grid.render(), grid.period))
    found, odds = chooser._predict(view)
    with torch.inference_mode():
        output = network(torch.from_numpy(view.channels())[None].contiguous(memory_format=torch.channels_last))
    known = np.pad(np.isfinite(fitted[..., 0]), 13)
    can = np.stack([known[13 + y : 13 + y + rows, 13 + x : 13 + x + 48] for x, y in steps()])
    scores = np.where(can, output.step[0].numpy(), -np.inf)
    assert np.take_along_axis(scores, found[None].astype(int), 0)[0] == pytest.approx(scores.max(0), abs=1e-4)
    expected = np.where(can.any(0), output.wrong[0].numpy(), np.inf)
    np.testing.assert_allclose(np.where(can.any(0), odds, np.inf), expected, atol=1e-4)
    assert (odds[~can.any(0)] > 10).all() and 0.5 < can.any(0).mean() < 1


@pytest.mark.slow
def test_the_shipped_network_corrects_more_pixels_than_it_spoils_and_tells_which_are_wrong():
    """A frog before a table: coordinates before and after the choice, and the true ones."""
    truth = make_setup(SynthConfig(scene="frog", background="table", resolution=360, frames=2, seed=3)).render(0, 2)
    image = as_grey(disturb_image(truth.radiance, 1.05, 0.012, np.random.default_rng(0)))
    decoder = GridImageDecoder(GridPattern())
    found = decoder.detect(image)
    evidence = decoder.examine(image, found)
    chosen = decoder.edges.choose(evidence, found.rectified, found.assignment.turn)
    before, right = (np.linalg.norm(coords - truth.coords, axis=-1) < 2 for coords in (evidence.fitted, chosen.coords))
    assert (right & ~before).sum() > 2 * (before & ~right).sum() > 0
    known = np.isfinite(chosen.coords[..., 0])
    wrong = known & ~right
    order = chosen.wrong[right][:, None] < np.random.default_rng(0).choice(chosen.wrong[wrong], 200)
    assert wrong.sum() > 50 and order.mean() > 0.95
    assert chosen.wrong[~known].min() > 0.9  # what nothing reaches
