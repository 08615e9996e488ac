"""Gray code: exact coordinates under any albedo and light, sequences of other programs, and errors that say why."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_nerfstudio.decoding.decoder import DecodingError, drop_small_regions
from sl_nerfstudio.decoding.gray_code import decode_gray_code, take_samples
from sl_nerfstudio.decoding.gray_code_order import check_order, layout_of_images
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import sample_bilinear
from sl_nerfstudio.scan.images import read_image
from tests.decoding.gray_captures import LAYOUT, exact_coords, figure_before_wall, photographs

COORDS = exact_coords()
LIT = np.isfinite(COORDS).all(-1)


@pytest.fixture(scope="module")
def images():
    return photographs(COORDS)


@pytest.fixture(scope="module")
def decoded(images):
    return decode_gray_code(images, LAYOUT)


@pytest.mark.parametrize(
    ("light", "most_wrong"), [({"glow": 0.8, "room": 0.0, "gain": 0.4}, 2e-3), ({"noise": 0.04}, 5e-3)]
)
def test_global_light_and_noise_cost_pixels_but_make_hardly_any_wrong_ones(light, most_wrong):
    decoded = decode_gray_code(photographs(COORDS, **light), LAYOUT)
    both = decoded.decoded & LIT
    assert both.sum() > 0.7 * LIT.sum()
    assert (np.linalg.norm(decoded.coords[both] - COORDS[both], axis=1) > 2 * LAYOUT.cell).mean() < most_wrong


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


@pytest.mark.parametrize(
    ("light", "size", "note", "largest_error"),
    [
        ({"blur": 1.0}, 2, "decoded to 2 px", 0.03),  # the finest stripes have a contrast of about 10 %
        ({"blur": 3.0}, 4, "decoded to 4 px", 0.2),
        ({"gain": 3.0, "blur": 0.8}, 1, "overexposed", 0.05),
    ],
)
@pytest.mark.slow
def test_stripes_that_are_not_resolved_are_not_used_and_overexposure_is_named(light, size, note, largest_error):
    coords, layout = exact_coords(400, 300), GrayCode(640, 480, 1)
    decoded = decode_gray_code(photographs(coords, layout=layout, **light), layout)
    assert [text for text in decoded.notes if text.startswith(note)] and len(decoded.notes) == 1
    both = decoded.decoded & np.isfinite(coords).all(-1)
    error = np.abs(decoded.coords[both] - coords[both])
    assert both.sum() > 0.95 * np.isfinite(coords).all(-1).sum()
    assert np.median(error) < largest_error and (error.max(1) < 1.5 * size).mean() > 0.99


@pytest.mark.slow
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


# Sequences of other programs are decoded as well as ours, and are recognised from their images.

SIZE = (320, 240)


@cache
def pictures(kind, **light):
    """Photographs of one of the kinds."""
    return photographs(COORDS, layout=KINDS[kind], **light)


KINDS = [
    GrayCode.in_order("sl-pattern", *SIZE, 2),
    GrayCode.in_order("opencv", *SIZE, 1),
    GrayCode.in_order("no-inverses", *SIZE, 2),
    GrayCode.in_order("phase-gray", *SIZE, 16),
    GrayCode.in_order("phase-gray", *SIZE, 8, (16.0, 32.0)),
    GrayCode.in_order("slstudio", *SIZE, 1, (20.0, 15.0)),
    GrayCode.in_order("scan3d-capture", *SIZE, 1),  # columns in cells of 2, numbered from 96; rows from 8
]
kinds = pytest.mark.parametrize("layout", KINDS, ids=lambda layout: f"{layout.order} {layout.cell}")


@kinds
def test_every_kind_is_decoded_without_bias(layout):
    decoded = decode_gray_code(photographs(COORDS, layout=layout), layout)
    both = decoded.decoded & LIT
    assert both.sum() > 0.97 * LIT.sum() and (decoded.mask ^ LIT).mean() < 0.03
    assert not (decoded.decoded & ~decoded.mask).any()
    error = decoded.coords[both] - COORDS[both]
    assert np.abs(np.median(error, 0)).max() < 0.02 and np.median(np.abs(error)) < 0.12  # half a pixel would show
    assert (np.abs(error).max(1) < 1.5).mean() > 0.998
    assert not decoded.pattern[~decoded.mask].any() and decoded.pattern.min() >= 0 and decoded.pattern.max() <= 1
    expected = sample_bilinear(layout.render(), COORDS)[both]
    assert np.corrcoef(expected, decoded.pattern[both])[0, 1] > 0.9


@pytest.mark.parametrize(
    "layout", [k for k in KINDS if k.sines(0) != [(4, 16.0)] or k.cell == 16], ids=lambda k: k.order
)
@pytest.mark.parametrize("light", [{"noise": 0.02, "glow": 0.4, "gain": 0.5}], ids=["noise and glow"])
def test_the_order_is_recognised_from_the_images(layout, light):
    cell = layout.cell if "phase-gray" in layout.order else None  # cells of 15 and 16 give as many images
    assert layout_of_images(photographs(COORDS, layout=layout, **light), SIZE, cell=cell) == layout


def test_a_turned_camera_changes_nothing_and_a_mirrored_image_is_refused():
    images = pictures(1)
    assert layout_of_images([np.ascontiguousarray(np.rot90(image)) for image in images], SIZE) == KINDS[1]
    with pytest.raises(DecodingError, match="as in a mirror"):
        layout_of_images([np.ascontiguousarray(image[:, ::-1]) for image in images], SIZE)


def _exchanged(images, a, b):
    out = list(images)
    out[a], out[b] = images[b], images[a]
    return out


def test_misplaced_images_are_named_by_their_place():
    images, layout = pictures(1), KINDS[1]
    assert check_order(take_samples(images), layout).fits
    white, black = layout.images - 2, layout.images - 1
    found = check_order(take_samples(_exchanged(images, 0, white)), layout).misplaced
    assert (found[0].place, found[0].expected) == (0, "x bit 8") and white in [item.place for item in found]
    found = check_order(take_samples(_exchanged(images, white, black)), layout).misplaced
    assert {item.place: item.seen for item in found} == {white: "is not the brightest", black: "is not the darkest"}
    # Bits and their inverses exchanged as pairs: nothing but the cells' neighbours shows it.
    found = check_order(take_samples(_exchanged(_exchanged(images, 4, 8), 5, 9)), layout)
    assert found.misplaced and not found.fits


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda i: i[:-1], "holds 35 images; for a projector of 320 x 240 .*opencv, procam: 36"),
        (lambda i: [*i[:18], *i[-2:]], "stripes in one direction only"),
        (lambda i: i[18:], "stripes in one direction only"),
        (lambda i: [i[-1]] * 36, "shows no stripes"),
        (lambda i: [*i[:-1], i[-1][:-3]], "several sizes"),
        (lambda i: [cv2.multiply(x, 6) for x in _exchanged(i, 3, 10)], r"overexposed \(\d\d% of the lit .* image 10"),
        (lambda i: _exchanged(i, 3, 10), r"nearest is opencv, procam .*image 2 \(x bit 7\) .*image 3 .*image 10"),
    ],
)
def test_what_is_not_recognised_is_explained(change, message):
    with pytest.raises(DecodingError, match=message) as caught:
        layout_of_images(change(pictures(1)), SIZE)
    assert caught.value.cause and caught.value.remedy


@pytest.mark.parametrize("named", ["opencv", None])
def test_cells_numbered_from_the_middle_are_recognised_by_codes_that_would_lie_outside(named):
    size = (320, 200)
    layout = replace(GrayCode.in_order("opencv", *size, 1), centred=True)
    coords = COORDS * (1, 200 / 240)
    images = photographs(coords, layout=layout)
    assert layout_of_images(images, size, named) == layout
    decoded = decode_gray_code(images, layout)
    both = decoded.decoded & LIT
    assert both.sum() > 0.97 * LIT.sum() and np.median(np.abs(decoded.coords[both] - coords[both])) < 0.1
    plain = replace(layout, centred=False)
    assert layout_of_images(photographs(coords, layout=plain), size, named) == plain


def test_what_fits_several_sequences_is_refused():
    with pytest.raises(DecodingError, match=r"may show phase-gray \(cells of 15\) or phase-gray \(cells of 16\)"):
        layout_of_images(pictures(3), SIZE)


def test_a_camera_much_coarser_than_the_projector():
    coords = exact_coords() * 6
    layout = GrayCode.in_order("opencv", 1920, 1440, 1)
    decoded = decode_gray_code(photographs(coords, layout=layout, blur=0.3), layout)
    both = decoded.decoded & LIT
    assert both.sum() > 0.5 * LIT.sum()
    assert np.median(np.abs(decoded.coords[both] - coords[both])) < 2.5


def test_lists_of_a_kind_of_its_own_are_decoded():
    ours = KINDS[0]
    order = np.random.default_rng(1).permutation(ours.images)
    layout = replace(ours, shown=tuple(ours.shown[k] for k in order))
    images = photographs(COORDS, layout=ours)
    mixed = decode_gray_code([images[k] for k in order], layout)
    np.testing.assert_array_equal(mixed.coords, decode_gray_code(images, ours).coords)
    assert layout.order == "its own"


def real_images(folder):
    root = Path(os.environ.get("SL_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not (root / folder).is_dir():
        pytest.skip(f"no real captures at {root} (set SL_REAL_DATA)")
    return [read_image(path) for path in sorted((root / folder).glob("*.jpg"))]


HOUSE = GrayCode.in_order("sl-pattern", 1920, 1080, 2)


def test_real_sequences_are_recognised_and_decoded():
    board, house = real_images("board/captures/pose_2"), real_images("house_gray/view0")
    assert layout_of_images(board, (1024, 768)) == GrayCode.in_order("opencv", 1024, 768, 1)
    assert layout_of_images(house, (1920, 1080)) == HOUSE
    decoded = decode_gray_code([np.ascontiguousarray(image[400:700, 900:1400]) for image in house], HOUSE)
    assert decoded.rate > 0.95
    assert np.nanmedian(np.abs(np.diff(decoded.coords[..., 0], 2, axis=1))) < 0.2  # smooth below the size of a cell


def test_real_photographs_whose_finest_stripes_are_blurred():
    """Half the size and a blur of 1 px leave the finest stripes 3 % of contrast, and the next ones 34 %."""
    images = real_images("house_gray/view0")
    half = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in images]
    half = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in half]
    assert check_order(take_samples(half), HOUSE).fits
    decoded = decode_gray_code(half, HOUSE)
    assert decoded.notes[0].startswith("decoded to 4 px:") and decoded.rate > 0.92
    exchanged = _exchanged(_exchanged(half, 4, 6), 5, 7)
    found = check_order(take_samples(exchanged), HOUSE).misplaced
    assert found[0].expected in ("x bit 8", "x bit 7") and found[0].seen == "does not continue the coarser bits"
