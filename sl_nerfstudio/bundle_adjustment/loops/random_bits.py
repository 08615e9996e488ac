"""Random bits from a number, the same in any order and on any number of threads."""

import numpy as np

from sl_nerfstudio.compiled import compiled


@compiled
def mixed(seed, number):
    """64 random bits: SplitMix64 (Steele et al., OOPSLA 2014)."""
    z = np.uint64(seed) + np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled
def uniform(bits):
    """A number in [0, 1) from 64 random bits."""
    return np.float64(bits >> np.uint64(11)) / 9007199254740992.0
