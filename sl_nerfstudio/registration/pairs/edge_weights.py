"""Which registered pairs become edges of the pose graph, and how much each counts."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, EdgeSettings


def is_accepted(match: PairMatch, settings: EdgeSettings = REGISTRATION_DEFAULTS.edge) -> bool:
    """Whether a pair overlaps and agrees well enough to be an edge."""
    return match.fitness > settings.least_fitness and match.overlap > settings.least_overlap


def support(match: PairMatch) -> float:
    """Between 0 and 1: how much two surfaces agree, and how little contradicts."""
    return support_of(match.overlap, match.fitness)


def support_of(overlap: float, fitness: float) -> float:
    """The same from the share of points that agree, and the share of those that could be judged."""
    return overlap * fitness**2


def quality(match: PairMatch, settings: EdgeSettings = REGISTRATION_DEFAULTS.edge) -> float:
    """Between 0 and 1: which of two results for a pair is better, and which pair of a frame."""
    clear = match.second_best_ratio < settings.ambiguous_ratio
    return support(match) * (1.0 if clear else settings.ambiguous_weight)


def is_ambiguous(match: PairMatch, settings: EdgeSettings = REGISTRATION_DEFAULTS.edge) -> bool:
    """Whether a clearly different similarity fits nearly as well."""
    return match.second_best_ratio > settings.ambiguous_ratio


def edge_weights(
    edges: Sequence[PairMatch], settings: EdgeSettings = REGISTRATION_DEFAULTS.edge
) -> Float64[ndarray, "edges"]:
    """Weight of each pair: smaller where its surfaces agree less than those of the scan's good pairs do.

    On smooth surfaces frames slide: neighbours that are wrong in the same way close cycles with each other and
    outnumber the right pairs. But they fit a little worse.
    """
    fitness = np.array([e.fitness for e in edges])
    if not len(fitness):
        return fitness
    deficit = np.maximum(np.quantile(fitness, settings.good_quantile) - fitness, 0) / settings.fitness_scale
    factor = np.array([settings.ambiguous_weight if is_ambiguous(e, settings) else 1.0 for e in edges])
    return np.maximum(np.exp(-(deficit**2)) * factor, settings.least_weight)
