"""A third kind of pattern and its decoder, for tests: brightness is the coordinate."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sl_nerfstudio.decoding.decoder import Decoded, Decoder, DecodingError
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.images import Pixels, as_grey


@dataclass(frozen=True)
class Ramps(PatternLayout):
    """Brightness is proportional to x in the first image and to y in the second."""

    kind: ClassVar[str] = "ramps"
    description: ClassVar[str] = "a pair of ramps"
    w: int
    h: int

    def render(self, supersampling: int = 2) -> np.ndarray:
        x, y = self.sequence()
        return (x + y) / 2

    def sequence(self) -> tuple[np.ndarray, np.ndarray]:
        x, y = (np.arange(self.w) + 0.5) / self.w, (np.arange(self.h) + 0.5) / self.h
        shape = (self.h, self.w)
        return np.broadcast_to(x, shape).astype(np.float32), np.broadcast_to(y[:, None], shape).astype(np.float32)

    def fields(self) -> dict[str, Any]:
        return {}

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> "Ramps":
        return cls(int(document["w"]), int(document["h"]))


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
