"""Which images are kept: sharp and well exposed ones that show the pattern elsewhere than those kept before."""

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from sl_nerfstudio.capture.grid_view import GridView


class Verdict(Enum):
    """What is said of an image."""

    KEEP = "keep"
    NO_PATTERN = "no pattern"  # not enough of it
    BLURRED = "blurred"
    SATURATED = "saturated"
    DARK = "dark"
    KNOWN = "known"  # much the same as one that was kept
    WAIT = "wait"  # too soon after the last one
    BY_KEY = "by key"  # without a pattern, nothing is kept by itself


@dataclass(frozen=True)
class Limits:
    """From when on an image is kept."""

    # Of the places that show the pattern.
    least_nodes: int = 48  # four times what decoding needs
    most_blur: float = 0.15  # periods; lines are 0.2 wide, and from 0.18 on captures are refused
    most_saturated: float = 0.15  # the same limit as in decoding
    most_dark: float = 0.3
    # Of the whole image, where no pattern is found.
    most_white: float = 0.5
    most_black: float = 0.9
    widest_edge: float = 1.8  # pixels; the same limit as in decoding
    # Of what is new.
    least_difference: float = 0.5  # from every kept view; that of two images from one place is below 0.02
    pause: float = 1.0  # seconds after the last one


DEFAULT_LIMITS = Limits()


@dataclass
class Selection:
    """The views that were kept, and the judgement of the next."""

    shape: tuple[int, int]  # rows and columns of the pattern
    limits: Limits = DEFAULT_LIMITS
    kept: list[GridView] = field(default_factory=list)
    last: float = -np.inf  # seconds, when the last one was kept

    def judge(self, view: GridView, seconds: float) -> Verdict:
        """Whether to keep a view, or the first reason against it."""
        limits = self.limits
        if view.uv.size == 0:
            return Verdict.BY_KEY
        if view.seen.sum() < limits.least_nodes:
            return self._without_pattern(view)
        if view.light.saturated > limits.most_saturated:
            return Verdict.SATURATED
        if view.light.dark > limits.most_dark:
            return Verdict.DARK
        if view.blur is None or view.blur > limits.most_blur:
            return Verdict.BLURRED
        if min((view.difference(other) for other in self.kept), default=1.0) < limits.least_difference:
            return Verdict.KNOWN
        return Verdict.KEEP if seconds - self.last >= limits.pause else Verdict.WAIT

    def _without_pattern(self, view: GridView) -> Verdict:
        """Light and blur are named as the reason only where they hide a pattern anywhere in the image."""
        if view.light.saturated > self.limits.most_white:
            return Verdict.SATURATED
        if view.light.dark > self.limits.most_black:
            return Verdict.DARK
        blurred = view.edge is not None and view.edge > self.limits.widest_edge
        return Verdict.BLURRED if blurred else Verdict.NO_PATTERN

    def add(self, view: GridView, seconds: float = -np.inf) -> None:
        """Keep a view."""
        self.kept.append(view)
        self.last = max(self.last, seconds)

    @property
    def times_seen(self) -> Int[ndarray, "rows columns"]:
        """In how many kept views each node of the pattern was found."""
        return np.sum([np.zeros(self.shape, dtype=np.int64), *(view.seen for view in self.kept)], axis=0)
