"""Which entries of an array belong to the same frame or the same anchor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled


@dataclass(frozen=True)
class Groups:
    """The entries of each group, in order: `entries[first[k] : first[k + 1]]` are those of group k."""

    first: Int64[ndarray, "groups_and_one"]
    entries: Int64[ndarray, "n"]

    @staticmethod
    def of(key: Int64[ndarray, "n"], groups: int) -> "Groups":
        """From the group of each entry."""
        first, entries = np.zeros(groups + 1, dtype=np.int64), np.empty(len(key), dtype=np.int64)
        _group(np.ascontiguousarray(key), first, entries)
        return Groups(first, entries)


@compiled
def _group(key, first, entries):
    """Counting sort, stable."""
    for k in key:
        first[k + 1] += 1
    for g in range(len(first) - 1):
        first[g + 1] += first[g]
    place = first.copy()
    for n in range(len(key)):
        entries[place[key[n]]] = n
        place[key[n]] += 1
