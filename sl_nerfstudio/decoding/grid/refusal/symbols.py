"""Measurements on the symbols of a grid that does not fit the pattern: can they be read, and do they fit mirrored?"""

import numpy as np

from sl_nerfstudio.decoding.grid.graph import DOWN, LEFT, RIGHT, UP, GridGraph, component_of

MIRRORED_SYMBOL = (0, 2, 1, 4, 3)
"""What a left-right mirror makes of each symbol: its lines left and right change places, those above and below lean to
the other side."""
_LEAST_GRID = 40  # nodes of the largest component
_LEAST_EDGES = 2.6  # a node
_LEAST_CERTAINTY = 0.6  # mean probability of the most probable symbol; chance is a fifth
_LEAST_SHARE = 0.06  # of each of the five symbols; a code array holds about a fifth of each


def mirrored(graph: GridGraph) -> GridGraph:
    """The graph that the left-right mirror image would show."""
    order = np.empty(4, dtype=int)
    order[[RIGHT, DOWN, LEFT, UP]] = LEFT, DOWN, RIGHT, UP
    place = graph.place * np.array([-1, 1], dtype=np.float32)
    return GridGraph(place, graph.neighbour[:, order].copy(), graph.score[:, list(MIRRORED_SYMBOL)].copy())


def shows_grid(graph: GridGraph) -> bool:
    """Whether the largest component is large, and its nodes have neighbours in most directions."""
    grid = _largest_component(graph)
    return len(grid.place) >= _LEAST_GRID and bool((grid.neighbour >= 0).sum() >= _LEAST_EDGES * len(grid.place))


def shows_readable_symbols(graph: GridGraph) -> bool:
    """Whether there is a grid in which all five symbols appear, and they can be read."""
    score = _largest_component(graph).score
    share = np.bincount(score.argmax(-1), minlength=score.shape[1]) / max(len(score), 1)
    return shows_grid(graph) and bool(score.max(-1).mean() > _LEAST_CERTAINTY and share.min() > _LEAST_SHARE)


def _largest_component(graph: GridGraph) -> GridGraph:
    if len(graph.place) == 0:
        return graph
    component = component_of(graph.neighbour)
    return graph.part(np.nonzero(component == np.bincount(component).argmax())[0].astype(np.int32))
