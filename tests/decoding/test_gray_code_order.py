"""Sequences of other programs are decoded as well as ours, and are recognised from their images."""

import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.gray_code import decode_gray_code, take_samples
from sl_nerfstudio.decoding.gray_code_order import check_order, layout_of_images
from sl_nerfstudio.pattern.gray_code import GrayCode
from tests.decoding.gray_captures import exact_coords, photographs

COORDS = exact_coords()
LIT = np.isfinite(COORDS).all(-1)
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
    error = decoded.coords[both] - COORDS[both]
    assert np.abs(np.median(error, 0)).max() < 0.02 and np.median(np.abs(error)) < 0.12
    assert (np.abs(error).max(1) < 1.5).mean() > 0.998
    assert not decoded.pattern[~decoded.mask].any() and decoded.pattern.min() >= 0 and decoded.pattern.max() <= 1


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


def test_real_sequences_are_recognised():
    root = Path(os.environ.get("SL_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not (root / "board").is_dir() or not (root / "house_gray").is_dir():
        pytest.skip(f"no real captures at {root} (set SL_REAL_DATA)")
    from sl_nerfstudio.scan.images import read_image

    sets = (("board/captures/pose_2", (1024, 768), "opencv", 1), ("house_gray/view0", (1920, 1080), "sl-pattern", 2))
    for folder, size, name, cell in sets:
        images = [read_image(path) for path in sorted((root / folder).glob("*.jpg"))]
        assert layout_of_images(images, size) == GrayCode.in_order(name, *size, cell)


def test_real_photographs_whose_finest_stripes_are_blurred():
    """Half the size and a blur of 1 px leave the finest stripes 3 % of contrast, and the next ones 34 %."""
    root = Path(os.environ.get("SL_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not (root / "house_gray").is_dir():
        pytest.skip(f"no real captures at {root} (set SL_REAL_DATA)")
    from sl_nerfstudio.scan.images import read_image

    layout = GrayCode.in_order("sl-pattern", 1920, 1080, 2)
    images = [read_image(path) for path in sorted((root / "house_gray" / "view0").glob("*.jpg"))]
    half = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in images]
    half = [cv2.GaussianBlur(image, (0, 0), 1.0) for image in half]
    assert check_order(take_samples(half), layout).fits
    decoded = decode_gray_code(half, layout)
    assert decoded.notes[0].startswith("decoded to 4 px:") and decoded.rate > 0.92
    exchanged = _exchanged(_exchanged(half, 4, 6), 5, 7)
    found = check_order(take_samples(exchanged), layout).misplaced
    assert found[0].expected in ("x bit 8", "x bit 7") and found[0].seen == "does not continue the coarser bits"


def test_lists_of_a_kind_of_its_own_are_decoded():
    ours = KINDS[0]
    order = np.random.default_rng(1).permutation(ours.images)
    layout = replace(ours, shown=tuple(ours.shown[k] for k in order))
    images = photographs(COORDS, layout=ours)
    mixed = decode_gray_code([images[k] for k in order], layout)
    np.testing.assert_array_equal(mixed.coords, decode_gray_code(images, ours).coords)
    assert layout.order == "its own"
