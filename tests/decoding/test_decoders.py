"""Decoders behind one interface: how one is chosen, when its key changes, and that a new one is a file and an entry."""

import numpy as np
import pytest

from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.decoders import DECODERS, GrayCodeDecoder, choose_decoder
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import LAYOUTS
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from tests.decoding.gray_captures import LAYOUT, exact_coords, photographs
from tests.decoding.ramps_decoder import Ramps, RampsDecoder

GRID = GridPattern(w=160, h=120)
GRAY = GrayCode(32, 24, 2)
NAMES = [f"{k:02d}.png" for k in range(LAYOUT.images)]


def test_every_kind_of_pattern_has_a_default_decoder(tmp_path):
    assert choose_decoder(GRID, None, tmp_path).name == "network"
    assert choose_decoder(GRAY, None, tmp_path).name == "graycode"
    assert {decoder.reads for decoder in DECODERS.values()} == set(LAYOUTS)
    assert all(decoder.name == name for name, decoder in DECODERS.items())
    assert [DECODERS[name].sequence for name in ("network", "graycode")] == [False, True]


@pytest.mark.parametrize(
    ("layout", "name", "message"),
    [
        (GRAY, "network", r"p\.json: describes a Gray-code sequence, which --decoder network does not read"),
        (GRID, "graycode", r"p\.json: describes a coded grid, which --decoder graycode does not read"),
        (GRID, "best", r"--decoder best: there is no decoder of this name.*\n.*\n.*one of network, graycode"),
        (Ramps(4, 3), None, r"p\.json: describes a pair of ramps, which no decoder reads"),
    ],
)
def test_a_decoder_that_does_not_suit_is_refused(tmp_path, layout, name, message):
    with pytest.raises(UserError, match=message) as caught:
        choose_decoder(layout, name, tmp_path / "p.json")
    assert "cause:" in str(caught.value) and "remedy:" in str(caught.value)


def test_of_two_decoders_of_one_pattern_the_first_is_the_default_and_the_other_can_be_named(monkeypatch, tmp_path):
    class Other(DECODERS["graycode"]):
        name = "other"

    monkeypatch.setitem(DECODERS, "other", Other)
    assert choose_decoder(GRAY, None, tmp_path).name == "graycode"
    assert choose_decoder(GRAY, "other", tmp_path).name == "other"


def test_the_key_changes_with_everything_that_changes_results(monkeypatch, tmp_path):
    def key():
        return RampsDecoder(Ramps(40, 30)).key

    first = key()
    assert first == key() != RampsDecoder(Ramps(41, 30)).key
    monkeypatch.setattr(RampsDecoder, "version", 2)
    second = key()
    weights = tmp_path / "w.safetensors"
    weights.write_bytes(b"1")
    monkeypatch.setattr(RampsDecoder, "weights", lambda self: [weights])
    third = key()
    weights.write_bytes(b"2")
    fourth = key()
    monkeypatch.setattr(RampsDecoder, "name", "slopes")
    assert len({first, second, third, fourth, key()}) == 5


def test_a_stated_order_is_believed_unless_the_images_show_another():
    """The camera exposes its brightest image less: white is darker than stripes, and no known order fits."""
    coords, layout = exact_coords(), GrayCode.in_order("opencv", LAYOUT.w, LAYOUT.h, LAYOUT.cell)
    images = photographs(coords, layout=layout)
    images[-2] = (0.6 * images[-2]).astype(np.uint8)
    with pytest.raises(
        DecodingError, match=r"not in the order of the sequence.*30\.png \(white\) is not the brightest"
    ):
        GrayCodeDecoder(layout).decode(images, NAMES)
    decoded = GrayCodeDecoder(layout, order_stated=True).decode(images, NAMES)
    assert "30.png (white) is not the brightest" in decoded.notes[0] and "in the stated order" in decoded.notes[0]
    both = decoded.decoded & np.isfinite(coords).all(-1)
    assert both.mean() > 0.5 and np.median(np.abs(decoded.coords[both] - coords[both])) < 0.1
    images = photographs(coords, layout=layout)
    for stated in (False, True):
        with pytest.raises(DecodingError, match="in the order of opencv, procam, not of sl-pattern") as caught:
            GrayCodeDecoder(LAYOUT, stated).decode(images, NAMES)
        assert caught.value.remedy == "give --sequence opencv"
    mirrored = [image[:, ::-1] for image in images]
    with pytest.raises(DecodingError, match="as in a mirror") as caught:
        GrayCodeDecoder(layout, order_stated=True).decode(mirrored, NAMES)
    assert "from rear to front projection" in caught.value.remedy


def test_the_network_decoder_reads_the_one_image_of_a_frame():
    grid = GridPattern(w=400, h=400)
    image = np.rint(255 * grid.render()[40:300, 60:340]).astype(np.uint8)
    found, expected = DECODERS["network"](grid).decode([image], ["a.png"]), GridImageDecoder(grid).decode(image)
    np.testing.assert_array_equal(found.coords, expected.coords)
    np.testing.assert_array_equal(found.pattern, expected.pattern)
    x, y = np.meshgrid(np.arange(280) + 60.5, np.arange(260) + 40.5)
    error = np.linalg.norm(found.coords - np.stack([x, y], -1), axis=-1)[10:-10, 10:-10]
    assert np.isfinite(error).mean() > 0.95 and np.nanmax(error) < 1 and np.nanmedian(error) < 0.1
