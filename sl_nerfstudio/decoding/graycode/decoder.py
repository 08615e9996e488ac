"""The decoder of Gray-code sequences."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.graycode.decode import check_count, decode_gray_code
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.scan.images import read_image


class GrayCodeDecoder(Decoder[GrayCode]):
    """Decodes a folder of images: one photograph of every pattern of the sequence."""

    name: ClassVar[str] = "graycode"
    version: ClassVar[int] = 2
    reads: ClassVar[str] = GrayCode.kind
    sequence: ClassVar[bool] = True

    def decode(self, paths: Sequence[Path]) -> Decoded:
        """Decode the images of one sequence, in the order of projection."""
        check_count(len(paths), self.layout)  # before reading them all
        return decode_gray_code([read_image(path) for path in paths], self.layout)
