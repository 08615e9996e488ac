"""The decoder of the coded grid."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.grid.image_decoder import GridImageDecoder
from sl_nerfstudio.decoding.grid.trained import weight_files
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.photographs import read_photograph


class NetworkDecoder(Decoder[GridPattern]):
    """Decodes single images with the trained networks of this package."""

    name: ClassVar[str] = "network"
    version: ClassVar[int] = 4
    reads: ClassVar[str] = GridPattern.kind
    sequence: ClassVar[bool] = False

    def decode(self, paths: Sequence[Path]) -> Decoded:
        """Decode the one image of a frame."""
        return self._images.decode(read_photograph(paths[0]))

    def weights(self) -> Iterable[Path]:
        """The files of the trained networks."""
        return weight_files()

    @cached_property
    def _images(self) -> GridImageDecoder:
        return GridImageDecoder(self.layout)
