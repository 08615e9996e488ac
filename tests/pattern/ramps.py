"""A third kind of pattern for tests: two images, whose brightness rises from left to right and from top to bottom."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sl_nerfstudio.pattern.layout import PatternLayout


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
