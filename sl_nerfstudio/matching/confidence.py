"""How probable it is that a matched pixel is right, by a logistic model of what is known about it.

Its weights come from `python -m training.matching`.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.decoding.regions import torn
from sl_nerfstudio.matching.semi_global import Matches

FEATURES = (
    "margin over the best rival, logarithm",
    "cost of the match",
    "matched where it was decoded",
    "matched elsewhere than it was decoded",
    "in the decoder's mask",
    "distance from a jump, periods, logarithm",
    "correlation after the fit",
    "share of opposite neighbours with it between them",
)
_REACH, _STRIDE = 4, 2  # of those neighbours, pixels
_BETWEEN = 2.0  # steps of the inverse distance from the middle of two neighbours
_FARTHEST = 2.0  # distance from a jump beyond which it does not count, periods
_NEAREST = 0.07  # added to that distance, periods
_NOWHERE = -1e6  # in place of unknown coordinates, so that known ones jump there


@dataclass(frozen=True)
class Logistic:
    """A constant, and a weight for each of `FEATURES`."""

    constant: float
    weights: tuple[float, ...]

    def probability(self, features: Float32[ndarray, "*pixels f"]) -> Float32[ndarray, "*pixels"]:
        """That a pixel is right."""
        odds = features @ np.array(self.weights, dtype=np.float32) + np.float32(self.constant)
        return 1 / (1 + np.exp(-odds))


RIGHT = Logistic(-3.697, (0.0923, -0.0068, 2.4458, -0.9122, 2.3262, 0.6447, 2.7155, 0.9038))


def features_of(
    matches: Matches,
    fitted: Float32[ndarray, "h w 2"],
    correlation: Float32[ndarray, "h w"],
    decoded: Float32[ndarray, "h w 2"],
    mask: Bool[ndarray, "h w"],
    near: float,
    jump: float,
    pixels_a_period: float,
) -> Float32[ndarray, "h w f"]:
    """`FEATURES` of every pixel; `near` and `jump` are in pattern pixels. Unknown where nothing was fitted."""
    apart = np.linalg.norm(fitted - decoded, axis=-1)
    between = np.zeros(mask.shape, dtype=np.float32)
    _count_between(matches.index, np.float32(_BETWEEN), between)
    from_jump = np.minimum(_distance_from_jumps(fitted, jump) / pixels_a_period, _FARTHEST)
    return np.stack(
        [
            np.log1p(np.maximum(matches.margin, 0)),
            matches.cost,
            apart < near,
            apart >= near,  # both False for NaN
            mask,
            np.log(from_jump + _NEAREST),
            np.nan_to_num(correlation),
            between,
        ],
        axis=-1,
    ).astype(np.float32)


def _distance_from_jumps(coords: Float32[ndarray, "h w 2"], jump: float) -> Float64[ndarray, "h w"]:
    """Pixels to the nearest one beside which coordinates jump or end."""
    ended = np.where(np.isfinite(coords[..., :1]), coords, np.float32(_NOWHERE))
    smooth = (~torn(ended, jump)).astype(np.uint8)
    return cv2.distanceTransform(smooth, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)


@compiled
def _count_between(index: ndarray, most: float, out: ndarray) -> None:
    """Share of the pairs of opposite pixels around, on a lattice, whose mean is nearly the pixel's own match.

    All are on a plane, however steep it is.
    """
    h, w = index.shape
    for row in range(h):
        for column in range(w):
            count, pairs = 0, 0
            for dr in range(0, _REACH + 1, _STRIDE):
                for dc in range(-_REACH, _REACH + 1, _STRIDE):
                    if dr == 0 and dc <= 0:
                        continue
                    a, b = min(row + dr, h - 1), min(max(column + dc, 0), w - 1)
                    c, d = max(row - dr, 0), min(max(column - dc, 0), w - 1)
                    pairs += 1
                    count += abs((index[a, b] + index[c, d]) / 2 - index[row, column]) < most
            out[row, column] = count / pairs
