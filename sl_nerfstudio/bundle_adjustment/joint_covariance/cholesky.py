"""Cholesky's factorisation of one large matrix, and products with its inverse."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy import ndarray
from scipy.linalg import get_lapack_funcs
from torch import Tensor

from sl_nerfstudio.threads import results, split, threads

_FEWEST_TOGETHER = 32  # columns that a thread solves at once


@dataclass(frozen=True)
class Cholesky:
    """A symmetric positive definite matrix as `U^T U`."""

    upper: Float64[ndarray, "k k"]  # columns one after the other; below the diagonal is what was there before

    @staticmethod
    def in_place(H: Float[Tensor, "k k"]) -> "Cholesky":
        """The factor overwrites the matrix: large ones are in memory once.

        Raises ArithmeticError if rounding has left it not positive definite.
        """
        (potrf,) = get_lapack_funcs(("potrf",), (H.numpy(),))
        factor, failed = potrf(H.numpy().T, lower=0, overwrite_a=1, clean=0)  # LAPACK stores columns; H is symmetric
        if failed:
            raise ArithmeticError(f"the leading minor of order {failed} is not positive")
        return Cholesky(factor)

    def root(self, x: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
        """`U^-1 x`: with unit columns, a factor F of the inverse `F F^T`."""
        return self._solved("trtrs", x)

    def solution(self, x: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
        """The inverse times `x`."""
        return self._solved("potrs", x)

    def _solved(self, routine: str, x: Float[Tensor, "k c"]) -> Float[Tensor, "k c"]:
        """Some columns at a time, on all threads."""
        (solve,) = get_lapack_funcs((routine,), (self.upper,))
        out = np.array(x.numpy(), order="F")

        def columns(first: int, last: int) -> None:
            out[:, first:last] = solve(self.upper, out[:, first:last], lower=0)[0]

        results([partial(columns, *part) for part in split(out.shape[1], threads(), _FEWEST_TOGETHER)])
        return torch.from_numpy(out)
