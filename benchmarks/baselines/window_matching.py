"""Classical window matching: every 3 x 3 window is looked up in the pattern, and windows vote for their nodes.

For comparison with the graph network: it uses only the most probable symbol, and windows of one size. Missing nodes
match everything; a window votes if one place in the pattern is closer to it than all others.
"""

import numpy as np
from jaxtyping import Float32, Int32, Int64
from numpy import ndarray

from sl_nerfstudio.decoding.grid_graph import OFFSETS, TurnedPattern
from sl_nerfstudio.pattern.codes import SYMBOLS

_WINDOW = [k for k, (i, j) in enumerate(OFFSETS) if abs(i) <= 1 and abs(j) <= 1]
_LEAST_SEEN = 6  # of the nine nodes of a window


def match_windows(
    score: Float32[ndarray, "n 5"], around: Int32[ndarray, "n 25"], pattern: TurnedPattern, largest_distance: int = 1
) -> Int64[ndarray, "n"]:
    """The node of the turned pattern that each node is matched to; -1 where no window votes.

    `largest_distance` is the number of symbols in which a window may differ from the pattern.
    """
    n, m = len(score), len(pattern.symbol)
    votes = np.zeros((n, m + 1), dtype=np.int16)
    symbol = np.append(score.argmax(-1), SYMBOLS)
    window = symbol[around[:, _WINDOW]]  # -1 takes the last: no symbol
    true = np.append(pattern.symbol, SYMBOLS)[pattern.around[:, _WINDOW]]
    seen = (window < SYMBOLS).sum(-1)
    one_hot = np.eye(SYMBOLS, dtype=np.float32)
    codes = np.vstack([one_hot, np.zeros((1, SYMBOLS), dtype=np.float32)])
    agree = codes[window].reshape(n, -1) @ codes[true].reshape(m, -1).T
    best = agree.argmax(-1)
    most = agree[np.arange(n), best]
    unique = (agree == most[:, None]).sum(-1) == 1
    voting = np.nonzero(unique & (seen >= _LEAST_SEEN) & (seen - most <= largest_distance))[0]
    for k in _WINDOW:
        node, place = around[voting, k], pattern.around[best[voting], k]
        known = (node >= 0) & (place >= 0)
        np.add.at(votes, (node[known], place[known]), 1)
    votes = votes[:, :m]
    winner = votes.argmax(-1)
    highest = votes[np.arange(n), winner]
    sure = (highest > 0) & ((votes == highest[:, None]).sum(-1) == 1)
    return np.where(sure, winner, -1).astype(np.int64)
