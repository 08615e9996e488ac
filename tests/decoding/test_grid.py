"""Captures with exact truth, decoded by the shipped networks."""

from pathlib import Path

import cv2
import numpy as np
import pytest

import sl_nerfstudio.decoding
from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.pattern.grid import GridPattern, projected_light
from sl_nerfstudio.scan.images import shrunk
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import make_setup

PIXELS_A_PERIOD = 7.0


@pytest.fixture(scope="module")
def decoder():
    return GridImageDecoder(GridPattern())


@pytest.fixture(scope="module")
def truth():
    return make_setup(SynthConfig(resolution=280, frames=2, seed=3)).render(0, 2)


@pytest.fixture(scope="module")
def image(truth):
    return disturb_image(truth.radiance, 1.05, 0.012, np.random.default_rng(0))


@pytest.fixture(scope="module")
def decoded(decoder, image):
    return decoder.decode(image)


def test_most_lit_pixels_are_decoded_and_hardly_any_wrongly(decoded, truth):
    both = decoded.decoded & truth.mask
    error = np.linalg.norm(decoded.coords[both] - truth.coords[both], axis=-1)
    assert both.sum() > 0.85 * truth.mask.sum()
    assert np.median(error) < 0.4
    assert (error > 10).mean() < 0.01  # half a period
    assert (decoded.decoded & ~truth.mask).sum() < 0.03 * both.sum()


def test_mask_and_pattern_are_what_they_say(decoded, truth):
    assert (decoded.mask | ~decoded.decoded).all()
    assert (decoded.mask & truth.mask).sum() > 0.93 * truth.mask.sum()
    assert (decoded.mask & ~truth.mask).sum() < 0.08 * truth.mask.sum()
    assert decoded.pattern.min() >= 0 and decoded.pattern.max() <= 1 and not decoded.pattern[~decoded.mask].any()
    assert decoded.pattern[decoded.mask].std() > 0.1


def test_light_is_what_the_surface_returns_of_the_projectors(decoder, decoded, truth, image):
    """As measured without noise and with the true coordinates; more room light does not change it."""
    expected = projected_light(truth.radiance, truth.coords, [decoder.pattern.render()], 0.5 * PIXELS_A_PERIOD)
    brighter = decoder.decode(np.clip(image.astype(np.int16) + 30, 0, 255).astype(np.uint8))
    both = np.isfinite(expected) & np.isfinite(decoded.light) & np.isfinite(brighter.light)
    assert both.sum() > 0.95 * decoded.decoded.sum() and not np.isfinite(decoded.light[~decoded.decoded]).any()
    assert np.corrcoef(decoded.light[both], expected[both])[0, 1] > 0.9
    dark = both & (image < 220)
    np.testing.assert_allclose(np.median(brighter.light[dark] / decoded.light[dark]), 1, atol=0.03)


@pytest.mark.parametrize(("scale", "factor"), [(3.2, 5), (0.9, 1)])
@pytest.mark.slow
def test_a_photograph_is_shrunk_as_far_as_its_periods_allow(decoder, scale, factor):
    """Whatever it is enlarged by, and wherever its grid is first looked for."""
    shown = np.rint(255 * decoder.pattern.render()[100:700, 50:750]).astype(np.uint8)
    large = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    framed = np.pad(large, [(0, max(0, 1300 - side)) for side in large.shape])
    assert decoder.shrink_factor(framed) == factor
    found = decoder.decode(shrunk(framed, factor)).coords[: int(600 * scale) // factor, : int(700 * scale) // factor]
    y, x = np.mgrid[: found.shape[0], : found.shape[1]] + 0.5
    error = np.linalg.norm(found - (np.stack([x, y], -1) * factor / scale + [50, 100]), axis=-1)
    assert np.isfinite(error).mean() > 0.9 and np.nanmedian(error) < 0.2


@pytest.mark.slow
def test_what_shows_no_grid_or_is_small_is_not_shrunk(decoder, image):
    assert decoder.shrink_factor(image) == 1
    noise = np.random.default_rng(0).integers(0, 255, (1300, 1300)).astype(np.uint8)
    assert decoder.shrink_factor(noise) is decoder.shrink_factor(np.zeros_like(noise)) is None


def test_the_shipped_weights_are_small():
    weights = Path(sl_nerfstudio.decoding.__file__).parent / "weights"
    assert 0 < sum(path.stat().st_size for path in weights.iterdir()) < 15e6


@pytest.mark.parametrize("turns", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_a_camera_held_on_its_side_or_upside_down(decoder, image, truth, turns):
    turned = decoder.decode(np.ascontiguousarray(np.rot90(image, turns)))
    coords = np.rot90(turned.coords, -turns)
    both = np.isfinite(coords[..., 0]) & truth.mask
    error = np.linalg.norm(coords[both] - truth.coords[both], axis=-1)
    assert both.sum() > 0.85 * truth.mask.sum() and np.median(error) < 0.4 and (error > 10).mean() < 0.01


@pytest.mark.slow
def test_the_same_capture_again_in_colour_or_sixteen_bits_means_the_same(decoder, image, decoded):
    assert np.array_equal(decoder.decode(image).coords, decoded.coords, equal_nan=True)
    deep = image.astype(np.uint16) * 257
    assert np.array_equal(decoder.decode(deep).decoded, decoded.decoded)
    colour = decoder.decode(np.repeat(image[..., None], 3, -1))
    both = colour.decoded & decoded.decoded
    assert both.sum() > 0.98 * decoded.decoded.sum()
    assert np.median(np.abs(colour.coords[both] - decoded.coords[both])) < 0.01


NOISE = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
BLANK = r"blank.*\n.*projector was off.*\n.*capture it again"


@pytest.mark.parametrize(
    ("image", "message"),
    [
        *((np.full((240, 320), value, np.uint8), BLANK) for value in (0, 130, 255)),
        (NOISE, r"cause:.*\n *remedy:"),
        (cv2.GaussianBlur(NOISE, (0, 0), 12), r"cause:.*\n *remedy:"),
        (np.tile((np.arange(320) % 16 < 4) * np.uint8(200), (240, 1)), r"cause:.*\n *remedy:"),
        (NOISE[:20, :30], r"cause:.*\n *remedy:"),
    ],
    ids=["black", "grey", "white", "noise", "smooth", "stripes", "tiny"],
)
def test_an_image_without_the_grid_is_refused(decoder, image, message):
    with pytest.raises(DecodingError, match=message):
        decoder.decode(image)
