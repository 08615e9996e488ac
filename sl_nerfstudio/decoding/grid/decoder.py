"""The decoder of the coded grid."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from jaxtyping import UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.grid.image_decoder import GridImageDecoder
from sl_nerfstudio.decoding.grid.trained import weight_files
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.photographs import read_photograph


class NetworkDecoder(Decoder[GridPattern]):
    """Decodes single images with the trained networks of this package."""

    name: ClassVar[str] = "network"
    version: ClassVar[int] = 9
    reads: ClassVar[str] = GridPattern.kind
    sequence: ClassVar[bool] = False

    def decode(self, paths: Sequence[Path]) -> Decoded:
        """Decode the one image of a frame."""
        return self.decode_image(read_photograph(paths[0]))

    def decode_image(self, image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]) -> Decoded:
        """The same for an image that was read, or computed."""
        return self.images.decode(image)

    def weights(self) -> Iterable[Path]:
        """The files of the trained networks."""
        return weight_files()

    @cached_property
    def images(self) -> GridImageDecoder:
        """What decodes single images."""
        return GridImageDecoder(self.layout)
