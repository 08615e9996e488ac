"""What a decoder is: from the image files of one frame to pattern coordinates."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.pattern.layout import PatternLayout

L = TypeVar("L", bound=PatternLayout)


class Decoder(ABC, Generic[L]):
    """Decodes captures of one pattern.

    Creating one must be quick, because it is also created where only its key is needed, and it is sent to worker
    processes: load networks at the first call of `decode`. A new decoder is a class that derives from this one, and an
    entry in `decoders.DECODERS`.
    """

    name: ClassVar[str]  # of the flag --decoder
    version: ClassVar[int]  # raise it when the decoder gives other results
    reads: ClassVar[str]  # kind of the patterns it decodes
    sequence: ClassVar[bool]  # a frame is a folder of images, not a single image

    def __init__(self, layout: L) -> None:
        self.layout = layout

    @abstractmethod
    def decode(self, paths: Sequence[Path]) -> Decoded:
        """Read and decode the images of one frame.

        Raises FileError for an image that cannot be read, and DecodingError for a capture that cannot be decoded.
        """

    @property
    def key(self) -> str:
        """A text that changes whenever the decoder would give other results."""
        digest = hashlib.sha256(f"{self.name} {self.version}".encode() + self.layout.encode())
        for path in self.weights():
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def weights(self) -> Iterable[Path]:
        """Files, besides the code, on which the results depend."""
        return ()
