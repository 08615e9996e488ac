"""Gray code: exact coordinates under any albedo and light, and errors that say what cannot be decoded."""

import os
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio.decoding.decoder import DecodingError, drop_small_regions
from sl_nerfstudio.decoding.gray_code import decode_gray_code, take_samples
from sl_nerfstudio.decoding.gray_code_order import check_order
from sl_nerfstudio.pattern.gray_code import GrayCode
from tests.decoding.gray_captures import LAYOUT, exact_coords, figure_before_wall, photographs

COORDS = exact_coords()
LIT = np.isfinite(COORDS).all(-1)


@pytest.fixture(scope="module")
def images():
    return photographs(COORDS)


@pytest.fixture(scope="module")
def decoded(images):
    return decode_gray_code(images, LAYOUT)


def test_coordinates_finer_than_a_cell_and_without_bias(decoded):
    both = decoded.decoded & LIT
    assert both.sum() > 0.96 * LIT.sum()
    error = decoded.coords[both] - COORDS[both]
    assert np.abs(np.median(error, 0)).max() < 0.02  # half a pixel would show
    assert np.median(np.abs(error)) < 0.1
    assert (np.abs(error).max(1) < 1.0).mean() > 0.995


def test_mask_and_pattern_image(decoded):
    assert (decoded.mask ^ LIT).mean() < 0.02
    assert not (decoded.decoded & ~decoded.mask).any()
    assert decoded.pattern.min() >= 0 and decoded.pattern.max() <= 1 and not decoded.pattern[~decoded.mask].any()
    inside = decoded.decoded & LIT
    from sl_nerfstudio.pattern.grid import sample_bilinear

    expected = sample_bilinear(LAYOUT.render(), COORDS)[inside]
    assert np.corrcoef(expected, decoded.pattern[inside])[0, 1] > 0.9


def test_light_is_the_projectors_alone():
    """Twice the light is twice as much; the room's does not count."""
    one, twice, in_room = (
        decode_gray_code(photographs(COORDS, noise=0.0, gain=gain, room=room), LAYOUT).light
        for gain, room in ((0.3, 0.05), (0.6, 0.05), (0.3, 0.25))
    )
    some = np.isfinite(one) & np.isfinite(twice) & np.isfinite(in_room) & LIT
    assert some.sum() > 0.9 * LIT.sum()
    np.testing.assert_allclose(np.median(twice[some] / one[some]), 2, atol=0.1)
    np.testing.assert_allclose(np.median(in_room[some] / one[some]), 1, atol=0.05)


def test_colour_and_16_bit_give_the_same(images, decoded):
    colour = [np.repeat(image[..., None], 3, -1) for image in images]
    deep = [image.astype(np.uint16) * np.uint16(257) for image in images]
    for other in (colour, deep):
        again = decode_gray_code(other, LAYOUT)
        both = again.decoded & decoded.decoded
        assert both.sum() > 0.999 * decoded.decoded.sum()
        np.testing.assert_allclose(again.coords[both], decoded.coords[both], atol=0.02)


def test_strong_global_light_costs_pixels_but_makes_no_wrong_ones():
    decoded = decode_gray_code(photographs(COORDS, glow=0.8, room=0.0, gain=0.4), LAYOUT)
    both = decoded.decoded & LIT
    assert both.sum() > 0.7 * LIT.sum()
    assert (np.linalg.norm(decoded.coords[both] - COORDS[both], axis=1) > 2 * LAYOUT.cell).mean() < 2e-3


def test_noise_costs_pixels_but_makes_few_wrong_ones():
    decoded = decode_gray_code(photographs(COORDS, noise=0.04), LAYOUT)
    both = decoded.decoded & LIT
    assert both.sum() > 0.7 * LIT.sum()
    assert (np.linalg.norm(decoded.coords[both] - COORDS[both], axis=1) > 2 * LAYOUT.cell).mean() < 5e-3


@pytest.mark.parametrize(
    ("light", "size", "note", "largest_error"),
    [
        ({"blur": 1.0}, 2, "decoded to 2 px", 0.03),  # the finest stripes have a contrast of about 10 %
        ({"blur": 3.0}, 4, "decoded to 4 px", 0.2),
        ({"gain": 3.0, "blur": 0.8}, 1, "overexposed", 0.05),
    ],
)
def test_stripes_that_are_not_resolved_are_not_used_and_overexposure_is_named(light, size, note, largest_error):
    coords, layout = exact_coords(400, 300), GrayCode(640, 480, 1)
    decoded = decode_gray_code(photographs(coords, layout=layout, **light), layout)
    assert [text for text in decoded.notes if text.startswith(note)] and len(decoded.notes) == 1
    both = decoded.decoded & np.isfinite(coords).all(-1)
    error = np.abs(decoded.coords[both] - coords[both])
    assert both.sum() > 0.95 * np.isfinite(coords).all(-1).sum()
    assert np.median(error) < largest_error and (error.max(1) < 1.5 * size).mean() > 0.99


def test_a_textured_figure_before_a_wall():
    """Colour photographs of which a comparison of each image with its inverse alone gives the wall to 0.8 px."""
    layout = GrayCode.in_order("opencv", 1280, 800, 1)
    images, coords, wall = figure_before_wall(layout)
    assert check_order(take_samples(images), layout).fits
    decoded = decode_gray_code(images, layout)
    assert "decoded to 4 px along x and 2 px along y" in decoded.notes[0]
    for part, share, largest in ((wall, 0.99, 0.12), (~wall, 0.97, 0.3)):
        both = decoded.decoded & part
        error = decoded.coords[both] - coords[both]
        assert both.sum() > share * part.sum()
        assert np.sqrt(np.median(error**2, 0)).max() < largest and (np.abs(error).max(1) > 6).mean() < 3e-3


def test_a_turned_camera_makes_no_difference(images, decoded):
    turned = decode_gray_code([np.ascontiguousarray(np.rot90(image, 2)) for image in images], LAYOUT)
    back = np.rot90(turned.coords, 2)
    both = decoded.decoded & np.isfinite(back).all(-1)
    assert both.sum() > 0.99 * decoded.decoded.sum()
    assert (np.abs(back[both] - decoded.coords[both]).max(1) < 0.1).mean() > 0.97  # windows of borders differ a little


@pytest.mark.parametrize(
    ("change", "problem", "remedy"),
    [
        (lambda i: i[:-1], "holds 31 images, the sequence of the pattern has 32", "one image of each of the 32"),
        (lambda i: [*i[:-1], i[-1][:-3]], r"several sizes \(200 x 147, 200 x 150\)", "one folder for each frame"),
        (lambda i: [np.zeros_like(x) for x in i], "no stripes are seen: the images are black", "again"),
        (lambda i: [np.full_like(x, 255) for x in i], "the images are white", "again"),
        (lambda i: [i[0]] * len(i), "the images are not changing", "again"),
    ],
)
def test_sequences_that_cannot_be_decoded_are_explained(images, change, problem, remedy):
    with pytest.raises(DecodingError, match=problem) as caught:
        decode_gray_code(change(images), LAYOUT)
    assert remedy in caught.value.remedy and caught.value.cause


def test_images_in_another_order(images):
    shuffled = [*images[:2], *(images[i] for i in np.random.default_rng(0).permutation(np.arange(2, 32)))]
    with pytest.raises(DecodingError, match="of the lit pixels could be decoded") as caught:
        decode_gray_code(shuffled, LAYOUT)
    assert "not in the order" in caught.value.cause


def test_small_regions_are_dropped_and_large_ones_untouched():
    coords = np.full((40, 60, 2), np.nan, dtype=np.float32)
    coords[5:25, 5:40] = np.stack(np.meshgrid(np.arange(35), np.arange(20)), -1)
    coords[10:13, 10:13] += 50  # nine pixels of another place
    coords[30:33, 50:53] = 7
    kept = drop_small_regions(coords, 3.0, 20)
    expected = coords.copy()
    expected[10:13, 10:13] = expected[30:33, 50:53] = np.nan
    np.testing.assert_array_equal(kept, expected)


def test_real_photographs():
    root = Path(os.environ.get("SL_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
    folder = root / "house_gray" / "view0"
    if not folder.is_dir():
        pytest.skip(f"no real captures at {root} (set SL_REAL_DATA)")
    from sl_nerfstudio.scan.images import read_image

    box = slice(400, 700), slice(900, 1400)
    images = [np.ascontiguousarray(read_image(path)[box]) for path in sorted(folder.glob("*.jpg"))]
    decoded = decode_gray_code(images, GrayCode(1920, 1080, 2))
    assert decoded.rate > 0.95
    x = decoded.coords[..., 0]
    assert np.nanmedian(np.abs(np.diff(x, 2, axis=1))) < 0.2  # smooth below the size of a cell
