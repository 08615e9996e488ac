"""The interface of a field that rendering needs."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class SignedDistance(Protocol):
    """A signed distance in scene units, negative inside; differentiable with respect to its parameters."""

    def sdf(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distances of points; differentiable once with respect to `p`."""
        ...

    def sdf_and_gradient(self, p: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
        """Signed distances and their gradients by the point; `p` is a constant."""
        ...
