"""Which measured coordinates are accepted: limits learnt from the pixels of the frame that were decoded before.

Where the decoder and the image agree, it is known what a right match looks like in this frame. What a wrong one looks
like is seen by looking for the pattern where it certainly is not.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.redecoding.measure import Measured

AGREES = 1 / 6  # pitch: decoded and measured coordinates that differ less are the same
_FEWEST = 200  # decoded pixels that agree, to learn from
_LEAST_SHARE = 0.5  # of the decoded pixels must agree
_RIGHT, _WRONG = 0.05, 0.9  # quantiles of right matches, and of those at a wrong place, below which none is accepted
FALSE = 0.01  # share of the accepted pixels that may be chance, if all predictions were wrong
_ROUGH = 0.95  # quantile of the roughness of right matches
_ACROSS = 0.98  # quantile of their displacement across the line on which a wrong depth would move them
_SIGMA = 0.0075  # pitch: 0.15 pixels of a grid with a period of 20
_STEP = 0.005  # pitch: a search whose last step is longer has not converged
_COVERED = 0.5  # share of the window that must be on the surface


@dataclass(frozen=True)
class Limits:
    """What a coordinate must fulfil; lengths in pattern pixels."""

    correlation: float  # least
    margin: float  # least
    roughness: float  # largest: distance from the mean displacement around it
    across: float  # largest
    sigma: float  # largest
    step: float  # largest

    def accept(self, found: Measured) -> Bool[ndarray, "n"]:
        """The coordinates that fulfil all."""
        return (
            (found.correlation >= self.correlation)
            & (found.margin >= self.margin)
            & (found.roughness <= self.roughness)
            & (np.abs(found.across) <= self.across)
            & (found.sigma <= self.sigma)
            & (found.step <= self.step)
            & (found.covered >= _COVERED)
        )


def confirmed(found: Measured, decoded: Float32[ndarray, "n 2"], pitch: float) -> Bool[ndarray, "n"]:
    """Pixels whose decoded coordinate (NaN: none) the image shows, too, and sharply enough to say so."""
    near = np.abs(found.coords - decoded).max(1) < AGREES * pitch  # False for NaN
    return near & (found.sigma <= 2 * _SIGMA * pitch) & (found.covered >= _COVERED)


def learn(
    found: Measured,
    right: Bool[ndarray, "n"],
    unknown: Bool[ndarray, "n"],
    decoded: int,
    elsewhere: Measured,
    pitch: float,
) -> Limits | None:
    """Limits from the `right` ones of the measured pixels, and from those measured at wrong places.

    `unknown` are the measured pixels without a coordinate, `decoded` is the number of those with one that were to be
    confirmed. None if too few of these are right, or if right places look no better than wrong ones: then the image
    does not show this pattern at these places.
    """
    if right.sum() < max(_FEWEST, _LEAST_SHARE * decoded):
        return None
    wrong = np.quantile(elsewhere.correlation, _WRONG)
    if np.median(found.correlation[right]) <= wrong:
        return None
    margin = max(float(np.quantile(found.margin[right], _RIGHT)), float(np.quantile(elsewhere.margin, _WRONG)), 0.0)
    limits = Limits(
        correlation=max(float(np.quantile(found.correlation[right], _RIGHT)), float(wrong)),
        margin=margin,
        roughness=float(np.quantile(found.roughness[right], _ROUGH)),
        across=float(np.quantile(np.abs(found.across[right]), _ACROSS)),
        sigma=_SIGMA * pitch,
        step=_STEP * pitch,
    )
    return _strict_enough(limits, found.margin[unknown & limits.accept(found)], int(unknown.sum()), elsewhere)


def _strict_enough(limits: Limits, accepted: Float32[ndarray, "a"], of: int, elsewhere: Measured) -> Limits:
    """Raise the margin until at most FALSE of the accepted pixels would be accepted even if all predictions were wrong.

    A target-decoy estimate: of `of` pixels those with the margins `accepted` are accepted, at wrong places a share of
    `elsewhere`.
    """
    wrong = np.sort(elsewhere.margin[limits.accept(elsewhere)])
    for k, margin in enumerate(wrong):
        if (len(wrong) - k) / len(elsewhere.margin) * of <= FALSE * (accepted >= margin).sum():
            return replace(limits, margin=float(margin))
    return replace(limits, margin=max(limits.margin, float(np.nextafter(wrong[-1], np.inf)))) if len(wrong) else limits
