"""A third decoder for tests: brightness is the coordinate."""

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

from sl_nerfstudio.decoding.decoder import Decoded, Decoder, DecodingError
from sl_nerfstudio.scan.images import as_grey, read_image
from tests.pattern.ramps import Ramps


class RampsDecoder(Decoder[Ramps]):
    """Decodes two images of 16 bit; a pixel that is black in the first one is not lit."""

    name: ClassVar[str] = "ramps"
    version: ClassVar[int] = 1
    reads: ClassVar[str] = Ramps.kind
    sequence: ClassVar[bool] = True

    def decode(self, paths: Sequence[Path]) -> Decoded:
        if len(paths) != 2:
            raise DecodingError(f"holds {len(paths)} images, not 2", "some are missing", "give both")
        x, y = (as_grey(read_image(path)) for path in paths)
        mask = x > 0
        if not mask.any():
            raise DecodingError("is black", "the projector was off", "switch it on")
        coords = np.stack([x * self.layout.w, y * self.layout.h], -1).astype(np.float32)
        coords[~mask] = np.nan
        return Decoded(coords, mask, np.where(mask, (x + y) / 2, 0).astype(np.float32))
