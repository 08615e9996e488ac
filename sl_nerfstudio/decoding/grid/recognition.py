"""Which node of the pattern each node of a capture is, by the graph network and by consensus among neighbours."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.decoding.grid.consensus import Assignment, agree, believe, choose_turn
from sl_nerfstudio.decoding.grid.gcn import one_hot, turned_pattern
from sl_nerfstudio.decoding.grid.graph import GridGraph, component_of, neighbourhoods
from sl_nerfstudio.decoding.grid.trained import load_graph_network
from sl_nerfstudio.pattern.codes import rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern

_BATCH = 2000  # nodes


class NodeRecogniser:
    """The graph network together with the features of all nodes of one pattern."""

    def __init__(self, pattern: GridPattern) -> None:
        self.codes = np.asarray(pattern.codes)
        self._network = load_graph_network()
        self._turned = turned_pattern(self.codes)
        with torch.inference_mode():
            around = torch.from_numpy(self._turned.around.astype(np.int64))
            self._features = self._network(one_hot(self._turned.symbol), around)

    def assign(self, graph: GridGraph) -> Assignment:
        """The place in the pattern of every node of a graph."""
        features = self._features_of(graph)
        turn = choose_turn(self._best_by_turn(features))
        codes = rotate_codes(self.codes, turn)
        place = np.full((len(graph.place), 2), -1, dtype=np.int32)
        for index in _batches(graph.neighbour):
            log_probability = torch.log_softmax(self._logits(features[index]), dim=1).numpy()
            own = log_probability[:, self._turned.turn == turn].reshape(-1, *codes.shape)
            place[index] = believe(own, graph.part(index).neighbour)
        return Assignment(turn, agree(place, graph, codes))

    def logits(self, graph: GridGraph) -> Float[Tensor, "n m"]:
        """How similar each node is to each node of the pattern in its four quarter turns.

        Candidates are in the order of `turned_pattern`.
        """
        return self._logits(self._features_of(graph))

    def _features_of(self, graph: GridGraph) -> Float[Tensor, "n features"]:
        around = torch.from_numpy(neighbourhoods(graph.neighbour).astype(np.int64))
        with torch.inference_mode():
            return self._network(torch.from_numpy(graph.score), around)

    def _logits(self, features: Float[Tensor, "k features"]) -> Float[Tensor, "k m"]:
        with torch.inference_mode():
            return self._network.logits(features, self._features)

    def _best_by_turn(self, features: Float[Tensor, "n features"]) -> Float32[ndarray, "n 4"]:
        """The highest log probability of each node in each quarter turn."""
        best = np.empty((len(features), 4), dtype=np.float32)
        for start in range(0, len(features), _BATCH):
            part = torch.log_softmax(self._logits(features[start : start + _BATCH]), dim=1).numpy()
            for turn in range(4):
                best[start : start + _BATCH, turn] = part[:, self._turned.turn == turn].max(-1)
        return best


def _batches(neighbour: Int32[ndarray, "n 4"]) -> Iterator[Int32[ndarray, "k"]]:
    """Numbers of the nodes, whole components at a time, about `_BATCH` of them: a belief takes a lot of memory."""
    component = component_of(neighbour)
    first = np.cumsum(np.bincount(component, minlength=1)) // _BATCH  # the batch of each component
    batch = first[component]
    for number in np.unique(batch):
        yield np.nonzero(batch == number)[0].astype(np.int32)
