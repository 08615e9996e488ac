"""Levenberg-Marquardt for non-linear least squares, dense or with blocks that are eliminated.

A problem states its residuals' normal equations at a state; what a state is (poses, intrinsics, points) and how an
increment moves it is the problem's own. Unknowns may be *shared* or belong to one of many *blocks* (a board, a frame,
a point) that meet each other only through the shared ones: blocks are eliminated by their Schur complement (Triggs et
al., "Bundle adjustment: a modern synthesis", 2000, section 6.1). Damping is relative to the diagonal (Marquardt 1963),
so units do not matter. A search ends by the whitened gradient of the whole objective, priors included:
g^T H^-1 g is twice what the cost can still fall, in the cost's own unit, whatever the scale of the unknowns.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

State = TypeVar("State")

_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e-12, 1e8
_DAMPING_FACTOR = 10.0
_WELL_DETERMINED = 1e-5  # pivot of the scaled normal equations, at least
_RCOND = 1e-14  # directions of the scaled normal equations below this share of the largest are not moved along
_LEAST_DAMPING_OF_BLOCKS = 1e-14  # so that an undetermined block can be inverted, and hardly anything else changes


class Equations(Protocol):
    """Normal equations of a problem at one state."""

    def step(self, damping: float) -> Any:
        """The increment that minimises the damped quadratic model."""
        ...

    def decrement(self) -> float:
        """The whitened squared gradient g^T H^-1 g: twice what the undamped model says the cost can fall."""
        ...


@dataclass(frozen=True)
class NormalEquations:
    """Dense normal equations: half the squared residuals are `cost + g.x + x.H.x / 2` about the state."""

    H: Float64[ndarray, "n n"]
    g: Float64[ndarray, "n"]

    @staticmethod
    def of(
        J: Float64[ndarray, "m n"], r: Float64[ndarray, "m"], weight: Float64[ndarray, "m"] | None = None
    ) -> "NormalEquations":
        """Equations of residuals `r` with derivatives `J`, each counted with its weight."""
        weighted = J if weight is None else J * weight[:, None]
        return NormalEquations(weighted.T @ J, weighted.T @ r)

    def step(self, damping: float) -> Float64[ndarray, "n"]:
        """The increment that minimises the damped quadratic model; zero along undetermined directions."""
        return -_solve_scaled(self.H + damping * np.diag(np.diag(self.H)), self.g)

    def decrement(self) -> float:
        """The whitened squared gradient."""
        return float(-self.g @ self.step(0.0))

    def covariance(self) -> Float64[ndarray, "n n"]:
        """Inverse of the normal equations: the covariance if residuals are whitened. Raises LinAlgError if singular."""
        return _inverse_scaled(self.H)


@dataclass(frozen=True)
class BlockEquations:
    """Normal equations of shared unknowns `s` and of blocks of `k` unknowns each, coupled only with the shared ones."""

    H: Float64[ndarray, "s s"]
    g: Float64[ndarray, "s"]
    H_block: Float64[ndarray, "b k k"]
    g_block: Float64[ndarray, "b k"]
    coupling: Float64[ndarray, "b s k"]

    def reduced(self, damping: float = 0.0) -> NormalEquations:
        """The equations of the shared unknowns after the blocks are eliminated; damped on both."""
        solved = np.linalg.solve(
            self._damped(damping), np.concatenate([self.coupling.transpose(0, 2, 1), self.g_block[..., None]], -1)
        )
        H = (
            self.H
            + damping * np.diag(np.diag(self.H))
            - np.einsum("bsk,bkt->st", self.coupling, solved[..., :-1], optimize=True)
        )
        return NormalEquations(H, self.g - np.einsum("bsk,bk->s", self.coupling, solved[..., -1]))

    def step(self, damping: float) -> tuple[Float64[ndarray, "s"], Float64[ndarray, "b k"]]:
        """Increments of the shared unknowns and of the blocks."""
        shared = self.reduced(damping).step(0.0)
        return shared, self.blocks_after(shared, damping)

    def slopes(self) -> Float64[ndarray, "b k s"]:
        """Response of each block to the shared unknowns, with the opposite sign: H_block^-1 coupling^T."""
        return np.linalg.solve(self._damped(0.0), self.coupling.transpose(0, 2, 1))

    def blocks_after(self, shared: Float64[ndarray, "s"], damping: float = 0.0) -> Float64[ndarray, "b k"]:
        """Increments of the blocks that suit one of the shared unknowns."""
        rest = -(self.g_block + np.einsum("bsk,s->bk", self.coupling, shared))
        return np.linalg.solve(self._damped(damping), rest[..., None])[..., 0]

    def decrement(self) -> float:
        """The whitened squared gradient."""
        shared, blocks = self.step(0.0)
        return float(-self.g @ shared - (self.g_block * blocks).sum())

    def covariance(self) -> Float64[ndarray, "s s"]:
        """Covariance of the shared unknowns, whatever the blocks are."""
        return self.reduced().covariance()

    def _damped(self, damping: float) -> Float64[ndarray, "b k k"]:
        diagonal = np.einsum("bkk->bk", self.H_block)
        added = (damping + _LEAST_DAMPING_OF_BLOCKS) * diagonal + np.finfo(float).tiny
        return self.H_block + added[..., None] * np.eye(self.H_block.shape[-1])


@dataclass(frozen=True)
class Minimum(Generic[State]):
    """End of a search."""

    state: State
    cost: float
    equations: Any  # at the state
    iterations: int  # accepted steps
    converged: bool  # False: the steps ran out


def minimise(
    state: State,
    equations: Callable[[State], Equations],
    moved: Callable[[State, Any], State],
    cost: Callable[[State], float],
    *,
    iterations: int = 50,
    tolerance: float = 1e-10,
    damping: float = _FIRST_DAMPING,
    narrow: Callable[[State], None] | None = None,
) -> Minimum[State]:
    """Levenberg-Marquardt from a state.

    Args:
        state: where the search begins.
        equations: normal equations at a state, of the whole objective with its priors.
        moved: the state after an increment, as `Equations.step` returns it.
        cost: the objective in the unit of the equations: half the weighted squared residuals, or for a robust kernel
            half its costs times the squared width, with the kernel's weights in the equations.
        iterations: most accepted steps.
        tolerance: the search ends where the cost can fall by no more than this share of itself.
        damping: of the first step, relative to the diagonal.
        narrow: called before a state is linearised; may narrow the kernel of the objective to the noise at the state.
    """
    if narrow is not None:
        narrow(state)
    now, accepted = cost(state), 0
    linear = equations(state)
    while accepted < iterations:
        if linear.decrement() <= 2 * tolerance * max(now, np.finfo(float).tiny):
            return Minimum(state, now, linear, accepted, True)
        while True:
            candidate = moved(state, linear.step(damping))
            then = cost(candidate)
            if then < now:
                break
            damping *= _DAMPING_FACTOR
            if not damping < _LARGEST_DAMPING:  # no step of any length falls: the minimum, to rounding
                return Minimum(state, now, linear, accepted, True)
        state, now, accepted = candidate, then, accepted + 1
        damping = max(damping / _DAMPING_FACTOR, _LEAST_DAMPING)
        if narrow is not None:
            narrow(state)
            now = cost(state)
        linear = equations(state)
    return Minimum(state, now, linear, accepted, False)


def _scale(H: Float64[ndarray, "n n"]) -> Float64[ndarray, "n"]:
    """Factors that make the diagonal one; one where nothing is known."""
    diagonal = np.diag(H)
    return np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1)), 1.0)


def _solve_scaled(H: Float64[ndarray, "n n"], g: Float64[ndarray, "n"]) -> Float64[ndarray, "n"]:
    scale = _scale(H)
    unit, right = H * scale[:, None] * scale, g * scale
    try:
        if np.linalg.cholesky(unit).diagonal().min(initial=1.0) > _WELL_DETERMINED:
            return scale * np.linalg.solve(unit, right)  # in a third of the time of what follows
    except np.linalg.LinAlgError:
        pass
    return scale * np.linalg.lstsq(unit, right, rcond=_RCOND)[0]


def _inverse_scaled(H: Float64[ndarray, "n n"]) -> Float64[ndarray, "n n"]:
    scale = _scale(H)
    return np.linalg.inv(H * scale[:, None] * scale) * scale[:, None] * scale
