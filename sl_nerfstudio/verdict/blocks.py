"""Groups of frames: those that agree with each other, and weak places in a graph of pairs."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.geometry.connectivity import component_labels
from sl_nerfstudio.verdict.agreement import CrossFrameAgreement
from sl_nerfstudio.verdict.settings import CrossFrameSettings

Pair = tuple[int, int]


def agreeing_groups(found: CrossFrameAgreement, settings: CrossFrameSettings | None = None) -> list[list[int]]:
    """Groups of frames that agree with each other and contradict the other groups, the largest first.

    Frames that no other frame can judge are in no group. Greedy correlation clustering: the two groups with the most
    judged points in agreeing pairs, less those in contradicting pairs, are joined as long as the agreeing ones prevail.
    All pairs between two groups thus count together: a pair that agrees by accident joins nothing.
    """
    s = settings or CrossFrameSettings()
    frames = sorted({k for p in found.pairs for k in p.frames})
    votes = np.zeros((len(frames), len(frames)))
    for p in found.pairs:
        i, j = (frames.index(k) for k in p.frames)
        agrees = p.excess <= s.contradicting_excess
        votes[i, j] = votes[j, i] = p.judged if agrees else -p.judged
    groups = [[k] for k in frames]
    while len(groups) > 1 and (pair := _best(votes)) is not None:
        i, j = pair
        groups[i] += groups.pop(j)
        votes[i] += votes[j]
        votes[:, i] += votes[:, j]
        votes = np.delete(np.delete(votes, j, 0), j, 1)
    return sorted((sorted(group) for group in groups), key=lambda group: (-len(group), group[0]))


def _best(votes: Float[ndarray, "n n"]) -> Pair | None:
    """The two groups (i < j) with the most votes for joining them; None if no two have any."""
    i, j = np.unravel_index(int(np.argmax(np.triu(votes, 1))), votes.shape)
    return (int(i), int(j)) if i < j and votes[i, j] > 0 else None


def components(edges: Sequence[Pair], nodes: Iterable[int]) -> list[list[int]]:
    """Groups of nodes that edges connect, the largest first."""
    names = list(nodes)
    index = {k: n for n, k in enumerate(names)}
    ends = np.array([(index[a], index[b]) for a, b in edges], dtype=np.int64).reshape(-1, 2)
    label = component_labels(ends[:, 0], ends[:, 1], len(names))
    groups = [[names[n] for n in np.flatnonzero(label == c)] for c in np.unique(label)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def bridges(edges: Sequence[Pair], nodes: Iterable[int]) -> list[tuple[Pair, list[int]]]:
    """Edges whose removal splits the graph, each with the nodes of the smaller part."""
    names = list(nodes)
    whole = len(components(edges, names))
    found = []
    for edge in dict.fromkeys(edges):
        parts = components([e for e in edges if e != edge], names)
        if len(parts) > whole:
            found.append((edge, min((part for part in parts if set(part) & set(edge)), key=len)))
    return found
