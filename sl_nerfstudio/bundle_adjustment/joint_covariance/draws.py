"""Covariances as products `F F^T`: exact ones of small scans, and of large ones the mean of random draws.

The covariance of 1,000 frames has 72 million different entries, and none of them is zero: frames that never see the
same surface are held by the same others. Its factor from D random columns has as many rows as there are unknowns, and
D columns. A sigma that follows is off by about `1 / sqrt(2 D)` of itself, 3 % here, and what follows from it needs time
and memory by the number of frames (Hutchinson, Communications in Statistics 1990; Halko, Martinsson and Tropp, SIAM
Review 2011).
"""

import torch
from jaxtyping import Float
from torch import Tensor

EXACT_UNKNOWNS = 1280  # of a scan, so many as 106 frames have: up to there, nothing is random
DRAWS = 512
_MORE = 8  # columns that are kept besides: of steps and departures, each of which is one


def is_exact(unknowns: int) -> bool:
    """Whether a scan with so many unknowns (of poses and intrinsics) has an exact factor."""
    return unknowns <= EXACT_UNKNOWNS


def unit_columns(rows: int, unknowns: int, seed: int = 0) -> Float[Tensor, "rows c"]:
    """Columns Z for which `Z Z^T` is the identity, or on average is: for a scan with so many unknowns."""
    if is_exact(unknowns):
        return torch.eye(rows, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    signs = 2 * torch.randint(2, (rows, DRAWS), generator=generator) - 1
    return signs.double() / DRAWS**0.5


def stored_columns(unknowns: int) -> int:
    """Columns of a factor as it is stored."""
    return unknowns if is_exact(unknowns) else DRAWS + _MORE


def as_stored(factor: Float[Tensor, "unknowns k"]) -> Float[Tensor, "unknowns c"]:
    """A factor of the same covariance with `stored_columns`: zeros are added, or many columns become fewer.

    Raises ValueError for a factor of many unknowns and more columns.
    """
    unknowns, k = factor.shape
    more = stored_columns(unknowns) - k
    if more >= 0:
        return torch.nn.functional.pad(factor, (0, more))
    if not is_exact(unknowns):
        raise ValueError(f"{k} columns, at most {k + more}")
    return torch.linalg.qr(factor.T, mode="r").R.T
