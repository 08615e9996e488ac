"""The decoders there are, and the choice of one for a pattern."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from sl_nerfstudio.decoding.decoder import Decoded, Decoder
from sl_nerfstudio.decoding.gray_code import check_count, check_sizes, decode_gray_code, take_samples
from sl_nerfstudio.decoding.gray_code_order import check_order, order_fault, other_order
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.images import Pixels

# The decoder of Gray-code sequences.


class GrayCodeDecoder(Decoder[GrayCode]):
    """Decodes a folder of images: one photograph of every pattern of the sequence."""

    name: ClassVar[str] = "graycode"
    version: ClassVar[int] = 4
    reads: ClassVar[str] = GrayCode.kind
    sequence: ClassVar[bool] = True

    def decode(self, images: Sequence[Pixels], names: Sequence[str]) -> Decoded:
        """Decode the images of one sequence, in the order of projection."""
        check_count(len(images), self.layout)
        check_sizes(images)
        samples = take_samples(images)
        check = check_order(samples, self.layout)
        other = None if check.fits else other_order(samples, self.layout)
        fault = order_fault(check, self.layout, names, other)
        if fault is None:
            return decode_gray_code(images, self.layout)
        if not self.order_stated or not check.misplaced or other is not None:
            raise fault
        decoded = decode_gray_code(images, self.layout)
        note = f"{fault.problem}; decoded in the stated order all the same"
        return replace(decoded, notes=(note, *decoded.notes))


DECODERS: dict[str, type[Decoder[Any]]] = {NetworkDecoder.name: NetworkDecoder, GrayCodeDecoder.name: GrayCodeDecoder}
"""By name. The first one that reads a kind of pattern is the default for it."""


def choose_decoder(layout: PatternLayout, name: str | None, path: Path, order_stated: bool = False) -> Decoder[Any]:
    """The decoder called `name`, or by default the first one that reads the pattern; `order_stated` as in `Decoder`.

    Raises UserError if there is no such decoder, or if it cannot decode the pattern in the file `path`.
    """
    if name is not None and name not in DECODERS:
        raise UserError(
            f"--decoder {name}: there is no decoder of this name\n    cause:  a typing error\n"
            f"    remedy: leave --decoder out, or give one of {', '.join(DECODERS)}"
        )
    fitting = [decoder for decoder in DECODERS.values() if decoder.reads == layout.kind]
    if not fitting:
        raise UserError(
            f"{path}: describes {layout.description}, which no decoder reads\n"
            "    cause:  the pattern is not meant for sl-process\n"
            "    remedy: give the pattern.json of a pattern for which there is a decoder"
        )
    chosen = fitting[0] if name is None else DECODERS[name]
    if chosen not in fitting:
        raise UserError(
            f"{path}: describes {layout.description}, which --decoder {name} does not read\n"
            "    cause:  the pattern file is not the one that was projected, or the decoder is the wrong one\n"
            "    remedy: leave --decoder out, or give the pattern.json of what was projected"
        )
    return chosen(layout, order_stated)
