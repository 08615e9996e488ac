"""The spanning tree of the pose graph with which most other edges agree."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.graph_residuals import Nodes, Pivots, chi_square, node_at
from sl_nerfstudio.registration.pair_match import PairMatch
from sl_nerfstudio.registration.settings import PoseGraphSettings


def best_tree(
    edges: Sequence[PairMatch],
    pivots: Pivots,
    root: int,
    strength: Float64[ndarray, "edges"],
    weight: Float64[ndarray, "edges"],
    settings: PoseGraphSettings,
) -> Nodes:
    """Frames along the best tree from `root`; None for those that no edge connects to it.

    Compared are the tree of the strongest edges and random ones that prefer strong edges, by the robust cost of all
    edges, each with its weight.
    """
    rng = np.random.default_rng(0)
    largest = settings.first_kernel_factor * settings.kernel_chi2
    best, least = _along_tree(edges, len(pivots), root, strength), np.inf
    for attempt in range(settings.trees if len(edges) else 0):
        draw = strength if attempt == 0 else strength + rng.gumbel(0, max(float(strength.std()), 1e-3), len(edges))
        nodes = _along_tree(edges, len(pivots), root, draw)
        inside = [k for k, e in enumerate(edges) if nodes[e.source] is not None and nodes[e.target] is not None]
        chi2 = chi_square([edges[k] for k in inside], nodes, pivots)
        cost = float((weight[inside] * chi2 / (chi2 + largest)).sum())
        if cost < least:
            best, least = nodes, cost
    return best


def _along_tree(edges: Sequence[PairMatch], n: int, root: int, strength: Float64[ndarray, "edges"]) -> Nodes:
    """Frames along the maximum spanning tree (Prim)."""
    nodes: list[Similarity | None] = [None] * n
    nodes[root] = Similarity.identity()
    while True:
        leaving = [k for k, e in enumerate(edges) if (nodes[e.source] is None) != (nodes[e.target] is None)]
        if not leaving:
            return nodes
        e = edges[max(leaving, key=lambda k: strength[k])]
        known, new = (e.source, e.target) if nodes[e.target] is None else (e.target, e.source)
        nodes[new] = node_at(nodes, known) @ e.between(new, known)
