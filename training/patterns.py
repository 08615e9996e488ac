"""A stock of random grid patterns, so that no network memorises a code array."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int8
from numpy import ndarray

from sl_nerfstudio.pattern.codes import SYMBOLS
from sl_nerfstudio.pattern.grid import GridPattern

CELLS = 34  # nodes along each side
_PERIOD = 20  # pixels, of the picture that is sampled
_BLURS = (0.0, 0.05, 0.1, 0.2)  # sigma, periods: degrees of the projector's defocus


@dataclass(frozen=True)
class DrawnPattern:
    """A random pattern as a picture; node (i, j) lies at ((j + 0.5) * period, (i + 0.5) * period)."""

    pictures: Float32[ndarray, "h w 4"]  # each as blurred as `_BLURS` says
    codes: Int8[ndarray, "rows columns"]
    period: float

    def defocused(self, coords: Float32[ndarray, "n n 2"], sigma: Float32[ndarray, "n n"]) -> Float32[ndarray, "n n"]:
        """Brightness at coordinates (x, y) in periods, where the projector blurs by `sigma` periods; 0 outside."""
        place = ((coords + 0.5) * self.period - 0.5).astype(np.float32)
        seen = cv2.remap(self.pictures, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        level = np.interp(sigma, _BLURS, range(len(_BLURS))).astype(np.float32)
        weight = np.clip(1 - np.abs(level[..., None] - np.arange(len(_BLURS), dtype=np.float32)), 0, 1)
        return (seen * weight).sum(-1)


def random_grid(rng: np.random.Generator) -> GridPattern:
    """Random symbols, line width, gap and darkness."""
    side = CELLS * _PERIOD
    return GridPattern(
        w=side, h=side, period=float(_PERIOD), line_width=_PERIOD * rng.uniform(0.14, 0.28),
        gap=_PERIOD * rng.uniform(0.22, 0.36), dark=float(rng.uniform(0, 0.08)),
        codes=rng.integers(0, SYMBOLS, (CELLS, CELLS)).astype(np.int8),
    )  # fmt: skip


def seeded_grid(rng: np.random.Generator) -> GridPattern:
    """The grid with the symbols of a seed, as a pattern.json can hold them, and with more or fewer nodes."""
    side = int(rng.integers(28, 50)) * _PERIOD
    one = random_grid(rng)
    return GridPattern(side, side, one.period, one.line_width, one.gap, one.dark, int(rng.integers(1 << 20)))


def draw_pattern(grid: GridPattern) -> DrawnPattern:
    """The pictures of a random grid."""
    assert grid.codes is not None
    picture = grid.render(supersampling=1)
    blurred = [cv2.GaussianBlur(picture, (0, 0), blur * _PERIOD) if blur > 0 else picture for blur in _BLURS]
    return DrawnPattern(np.stack(blurred, -1), grid.codes, grid.period)


class PatternStock:
    """Patterns to choose from; each `renew` replaces one of them."""

    def __init__(self, rng: np.random.Generator, count: int) -> None:
        self._rng = rng
        self._patterns = [draw_pattern(random_grid(rng)) for _ in range(count)]
        self._next = 0

    def pick(self) -> DrawnPattern:
        """A random pattern of the stock."""
        return self._patterns[self._rng.integers(len(self._patterns))]

    def renew(self) -> None:
        """Replace the oldest pattern by a new one."""
        self._patterns[self._next] = draw_pattern(random_grid(self._rng))
        self._next = (self._next + 1) % len(self._patterns)
