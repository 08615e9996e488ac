"""Robust statistics: estimates and weights that a share of wrong values hardly changes."""

from typing import Any

Number = Any  # an array or a tensor, or in compiled loops a float

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


def geman_mcclure_cost(squared: Number) -> Number:
    """Cost of a residual, from its square in units of the squared kernel width: at most 1, however wrong it is."""
    return squared / (1 + squared)


def geman_mcclure_weight(squared: Number) -> Number:
    """Weight of a residual in weighted least squares, from its square in units of the squared kernel width.

    1 for small residuals; beyond the width it falls with their fourth power.
    """
    return 1 / (1 + squared) ** 2


def geman_mcclure_curvature(squared: Number) -> Number:
    """Second derivative of the cost of a residual in the plane, as a weight: the mean over its two directions.

    What a residual really says of the unknowns; less than its weight, and below zero beyond the kernel's width.
    """
    return (1 - squared) / (1 + squared) ** 3
