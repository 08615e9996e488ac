"""Connected components of graphs that are given by their edges."""

import numpy as np
from jaxtyping import Int, Int64
from numpy import ndarray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components


def component_labels(a: Int[ndarray, "e"], b: Int[ndarray, "e"], nodes: int) -> Int64[ndarray, "nodes"]:
    """Number of the component, from 0, that each node lies in; edge k joins the nodes `a[k]` and `b[k]`."""
    graph = coo_matrix((np.ones(len(a), dtype=bool), (a, b)), shape=(nodes, nodes))
    return connected_components(graph, directed=False)[1].astype(np.int64)
