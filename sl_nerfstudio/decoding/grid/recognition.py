"""Which node of the pattern each node of a capture is, by the graph network and by consensus among neighbours."""

import numpy as np
import torch
from jaxtyping import Float, Int32
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.decoding.grid.consensus import Assignment, agree, choose_turn
from sl_nerfstudio.decoding.grid.gcn import one_hot, turned_pattern
from sl_nerfstudio.decoding.grid.graph import GridGraph, neighbourhoods
from sl_nerfstudio.decoding.grid.trained import load_graph_network
from sl_nerfstudio.pattern.codes import rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern


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
        logits = self.logits(torch.from_numpy(graph.score), neighbourhoods(graph.neighbour))
        log_probability = torch.log_softmax(logits, dim=1).numpy()
        turn = choose_turn(log_probability, self._turned.turn)
        codes = rotate_codes(self.codes, turn)
        own = log_probability[:, self._turned.turn == turn].reshape(-1, *codes.shape)
        return agree(own, graph, codes, turn)

    def logits(self, score: Float[Tensor, "n 5"], around: Int32[ndarray, "n 25"]) -> Float[Tensor, "n m"]:
        """How similar each node is to each node of the pattern in its four quarter turns.

        Candidates are in the order of `turned_pattern`; `score` and `around` are a graph's symbol scores and its
        `neighbourhoods`.
        """
        with torch.inference_mode():
            features = self._network(score, torch.from_numpy(around.astype(np.int64)))
            return self._network.logits(features, self._features)
