"""What is uncertain once the scale is fixed by a length, or by many.

The covariance of an adjustment says nothing about the scale, which no residual determines. A rule then fixes it: some
logarithm of a length, `log l`, is known. An error x of poses and intrinsics becomes `x - g (c . x)`, where g is the
growth of everything by a factor, and c the derivative of `log l`, so that `c . g = 1`. Lengths that are badly known
relative to the known one become uncertain in this way.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.gauge import gauge_directions
from sl_nerfstudio.bundle_adjustment.priors import PosePrior, prior_equations
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.unknowns import by_frame, by_kind


def with_known_length(
    factor: Float[Tensor, "joint k"], rig: Rig, log_length: Float[Tensor, "unknowns"]
) -> Float[Tensor, "joint k"]:
    """A factor under the scale at which a length does not err; `log_length` is its derivative by the poses."""
    growth = torch.zeros(len(factor), dtype=torch.float64)
    growth[: len(log_length)] = gauge_directions(rig)[:, 6]
    known = torch.zeros_like(growth)
    known[: len(log_length)] = log_length
    known = known / (known @ growth)
    return factor - torch.outer(growth, known @ factor)


def of_all_lengths(rig: Rig, prior: PosePrior) -> Float[Tensor, "unknowns"]:
    """That of the scale which agrees best with the starting poses (`gauge.agreeing_scale`)."""
    H, _ = prior_equations(prior, rig, rig)
    G = by_frame(gauge_directions(rig))
    by_step = H @ G
    information = (G.transpose(1, 2) @ by_step).sum(0)
    return torch.linalg.solve(information, by_kind(by_step).T)[6]
