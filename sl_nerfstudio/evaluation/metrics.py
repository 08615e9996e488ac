"""Distances between a reconstructed surface and the truth.

*Accuracy* is the distance of every part of the result from the truth: wrong or invented surface makes it worse.
*Completeness* is the distance of every observable part of the truth from the result: holes make it worse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.reference import Reference
from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class DistanceStats:
    """Summary of distances, in the scan's unit."""

    mean: float
    median: float
    rmse: float
    p95: float  # 95 % of the distances are below

    @staticmethod
    def of(distance: Float[ndarray, "n"]) -> "DistanceStats":
        """Summary of at least one distance."""
        return DistanceStats(
            mean=float(distance.mean()),
            median=float(np.median(distance)),
            rmse=float(np.sqrt((distance**2).mean())),
            p95=float(np.percentile(distance, 95)),
        )


@dataclass(frozen=True)
class SurfaceScore:
    """How close result and truth are after one alignment; lengths in the truth's unit."""

    accuracy: DistanceStats  # result -> truth
    completeness: DistanceStats  # observed truth -> result
    chamfer: float  # mean of the two means
    f_score: dict[float, float]  # distance -> harmonic mean of the shares of result and truth that are closer than it
    scale: float  # factor the result was multiplied by
    S_truth_result: Similarity


def score_surface(
    result: IndexedMesh,
    samples: Float[ndarray, "n 3"],
    reference: Reference,
    S_truth_result: Similarity,
    f_distances: Sequence[float],
) -> SurfaceScore:
    """Distances in both directions after the result was moved by `S_truth_result`.

    `samples` are area-uniform points on the result, in its own frame.
    """
    accuracy = reference.distance(S_truth_result.points(samples))
    # The truth is moved into the result's frame: the same distances without building a second search tree.
    observed = S_truth_result.inverse().points(reference.observed)
    completeness = result.distance(observed) * S_truth_result.scale
    return SurfaceScore(
        accuracy=DistanceStats.of(accuracy),
        completeness=DistanceStats.of(completeness),
        chamfer=float(accuracy.mean() + completeness.mean()) / 2,
        f_score={d: _f_score(accuracy, completeness, d) for d in f_distances},
        scale=S_truth_result.scale,
        S_truth_result=S_truth_result,
    )


def _f_score(accuracy: Float[ndarray, "n"], completeness: Float[ndarray, "m"], distance: float) -> float:
    precision, recall = float((accuracy <= distance).mean()), float((completeness <= distance).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def default_f_distances(size: float) -> tuple[float, ...]:
    """Four round distances from about a thousandth to a hundredth of `size`: 0.1, 0.2, 0.5, 1 for size 110."""
    exponent = np.floor(np.log10(size * 1e-3) + 1e-9)
    mantissa = size * 1e-3 / 10.0**exponent
    first = max(k for k in (1, 2, 5) if k <= mantissa * (1 + 1e-9))
    return tuple(float(f"{k * first * 10.0**exponent:.3g}") for k in (1, 2, 5, 10))
