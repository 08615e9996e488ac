"""Decoders by name: from the files of a frame to its coordinates."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import encode_gray_code, encode_grid
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import read_image

DecoderName = Literal["network", "graycode"]
Layout = GridPattern | GrayCode
_VERSION = {"network": 3, "graycode": 1}  # raised when a decoder comes to other results


def decoder_for(layout: Layout, asked: DecoderName | None, path: Path) -> DecoderName:
    """The decoder of a pattern. Raises UserError, naming the pattern's file, if `asked` cannot decode it."""
    suits: DecoderName = "graycode" if isinstance(layout, GrayCode) else "network"
    if asked not in (None, suits):
        kind = "a Gray-code sequence" if suits == "graycode" else "a coded grid"
        raise UserError(
            f"{path}: describes {kind}, which --decoder {asked} does not read\n"
            "    cause:  the pattern file is not the one that was projected, or the decoder is the other one\n"
            f"    remedy: leave --decoder out, or give the pattern.json of what was projected"
        )
    return suits


def make_decoder(name: DecoderName, layout: Layout) -> Callable[[Sequence[Path]], Decoded]:
    """A function that reads and decodes the images of one frame. It raises DecodingError or FileError."""
    if isinstance(layout, GrayCode):
        return lambda paths: _decode_sequence(paths, layout)
    from sl_nerfstudio.decoding.grid.network_decoder import NetworkDecoder

    network = NetworkDecoder(layout)
    return lambda paths: network.decode(read_image(paths[0]))


def _decode_sequence(paths: Sequence[Path], layout: GrayCode) -> Decoded:
    from sl_nerfstudio.decoding.graycode.decode import check_count, decode_gray_code

    check_count(len(paths), layout)  # before they are all read
    return decode_gray_code([read_image(path) for path in paths], layout)


def decoder_key(name: DecoderName, layout: Layout) -> str:
    """A text that changes whenever the decoder would come to other results."""
    description = encode_gray_code(layout) if isinstance(layout, GrayCode) else encode_grid(layout)
    digest = hashlib.sha256(f"{name} {_VERSION[name]}".encode() + description)
    if name == "network":
        from sl_nerfstudio.decoding.grid import network_decoder

        for weights in sorted((Path(network_decoder.__file__).parent / "weights").glob("*.safetensors")):
            digest.update(weights.read_bytes())
    return digest.hexdigest()
