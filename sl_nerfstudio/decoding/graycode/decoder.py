"""The decoder of Gray-code sequences."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.graycode.decode import check_count, decode_gray_code
from sl_nerfstudio.decoding.graycode.order_check import check_order
from sl_nerfstudio.decoding.graycode.photographs import check_sizes
from sl_nerfstudio.decoding.graycode.recognition import order_fault
from sl_nerfstudio.decoding.graycode.samples import take_samples
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.scan.photographs import read_photograph


class GrayCodeDecoder(Decoder[GrayCode]):
    """Decodes a folder of images: one photograph of every pattern of the sequence."""

    name: ClassVar[str] = "graycode"
    version: ClassVar[int] = 3
    reads: ClassVar[str] = GrayCode.kind
    sequence: ClassVar[bool] = True

    def decode(self, paths: Sequence[Path]) -> Decoded:
        """Decode the images of one sequence, in the order of projection."""
        check_count(len(paths), self.layout)  # before reading them all
        images = [read_photograph(path) for path in paths]
        check_sizes(images)
        fault = order_fault(check_order(take_samples(images), self.layout), self.layout, [path.name for path in paths])
        if fault is not None:
            raise fault
        return decode_gray_code(images, self.layout)
