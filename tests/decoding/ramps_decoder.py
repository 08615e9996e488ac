"""A third decoder for tests: brightness is the coordinate."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from sl_nerfstudio.decoding.decoder import Decoded, Decoder, DecodingError
from sl_nerfstudio.scan.images import Pixels, as_grey
from tests.pattern.ramps import Ramps


class RampsDecoder(Decoder[Ramps]):
    """Decodes two images of 16 bit; a pixel that is black in the first one is not lit."""

    name: ClassVar[str] = "ramps"
    version: ClassVar[int] = 1
    reads: ClassVar[str] = Ramps.kind
    sequence: ClassVar[bool] = True

    def decode(self, images: Sequence[Pixels], names: Sequence[str]) -> Decoded:
        if len(images) != 2:
            raise DecodingError(f"holds {len(images)} images, not 2", "some are missing", "give both")
        x, y = map(as_grey, images)
        mask = x > 0
        if not mask.any():
            raise DecodingError("is black", "the projector was off", "switch it on")
        coords = np.stack([x * self.layout.w, y * self.layout.h], -1).astype(np.float32)
        coords[~mask] = np.nan
        return Decoded(coords, mask, np.where(mask, (x + y) / 2, 0).astype(np.float32))
