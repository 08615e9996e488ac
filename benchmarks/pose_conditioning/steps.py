"""Ways to the poses: Adam on several kinds of increments, with two decays, and Gauss-Newton."""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks.pose_conditioning.problem import Poses, Problem, of_devices, per_frame

Increments = Literal["independent", "rig", "whitened"]
Decay = Literal["exponential", "cosine"]
RATE = 1e-3  # the paper's for poses
_BETAS, _EPS = (0.9, 0.999), 1e-15
_COSINE_END = 0.01  # of the rate
_STILL = 1e-9  # scene units and radian a step: the exponential decay falls below it at step 5,785, and nothing moves


@dataclass(frozen=True)
class AdamChoice:
    """One reading of what the paper leaves open."""

    increments: Increments
    decay: Decay


def rate_at(decay: Decay, step: int, steps: int) -> float:
    """Exponential as in `sl-neus-paper`: from 1e-3 to 5e-12 at step 8,000. Cosine: to a hundredth over the run."""
    if decay == "exponential":
        return RATE * (5e-12 / RATE) ** min(step / 8000, 1.0)
    return RATE * (_COSINE_END + (1 - _COSINE_END) * 0.5 * (1 + math.cos(math.pi * step / steps)))


def normal_matrices(
    problem: Problem, poses: Poses, independent: bool, pixels: int, seed: int
) -> Float[Tensor, "f 12 12"]:
    """The Gauss-Newton matrix of each frame, divided by its number of residuals: squared pixels per squared unit."""
    index = drawn(problem, pixels * problem.frames, torch.Generator().manual_seed(seed))
    r = problem.residuals(poses, index)
    camera, projector = of_devices(poses, independent)
    J = r.by_camera @ camera[r.frame] + r.by_projector @ projector[r.frame]
    count = per_frame(r.frame, torch.ones(len(J), dtype=J.dtype), problem.frames).clamp_min(1)
    return per_frame(r.frame, J.mT @ J, problem.frames) / count[:, None, None]


def whitening(H: Float[Tensor, "f 12 12"]) -> Float[Tensor, "f 12 12"]:
    """Increments that all change the residuals of their frame alike, and as much as the old ones do on average.

    The mean is the geometric one, so that the same rate can be used.
    """
    value, vector = torch.linalg.eigh(H)
    root = value.clamp_min(1e-12 * float(value.max())).sqrt()
    return vector * (root.log().mean(-1, keepdim=True).exp() / root)[:, None]


def drawn(problem: Problem, count: int, generator: torch.Generator) -> Tensor:
    """Random pixels of all frames."""
    return torch.randint(len(problem.frame), (count,), generator=generator)


def adam(problem: Problem, start: Poses, choice: AdamChoice, steps: int, rays: int, seed: int) -> Poses:
    """Adam on the mean L1 residual. Every step is an increment to the present poses."""
    generator = torch.Generator().manual_seed(seed)
    independent = choice.increments == "independent"
    W = None
    if choice.increments == "whitened":
        W = whitening(normal_matrices(problem, start, False, 3000, seed))
    poses, m, v = start, torch.zeros(problem.frames, 12).double(), torch.zeros(problem.frames, 12).double()
    for step in range(steps):
        rate = rate_at(choice.decay, step, steps)
        if rate < _STILL:
            break
        by_camera, by_projector = problem.gradient(poses, drawn(problem, rays, generator))
        camera, projector = of_devices(poses, independent)
        if W is not None:
            camera, projector = camera @ W, projector @ W
        g = (by_camera[:, None] @ camera + by_projector[:, None] @ projector)[:, 0] / rays
        m, v = _BETAS[0] * m + (1 - _BETAS[0]) * g, _BETAS[1] * v + (1 - _BETAS[1]) * g * g
        mean, square = m / (1 - _BETAS[0] ** (step + 1)), v / (1 - _BETAS[1] ** (step + 1))
        move = -rate * mean / (square.sqrt() + _EPS)
        poses = _moved(poses, camera, projector, move)
    return poses


def gauss_newton(problem: Problem, start: Poses, iterations: int, pixels: int, seed: int) -> Poses:
    """Gauss-Newton with Geman-McClure weights, each frame by itself: the surface is known, so nothing joins them.

    The kernel's width follows twice the median residual of the frame. The damping starts at a thousandth of the
    diagonal and halves with every iteration: kept, it would hold the weak directions where they are.
    """
    index = drawn(problem, pixels * problem.frames, torch.Generator().manual_seed(seed))
    poses = start
    for iteration in range(iterations):
        r = problem.residuals(poses, index)
        size = r.value.norm(dim=-1)
        width = 2 * torch.stack([_median(size[r.frame == k]) for k in range(problem.frames)])[r.frame]
        weight = (width**2 / (width**2 + size**2)) ** 2
        camera, projector = of_devices(poses, independent=False)
        J = r.by_camera @ camera[r.frame] + r.by_projector @ projector[r.frame]
        scaled = weight[:, None, None] * J.mT
        H = per_frame(r.frame, scaled @ J, problem.frames)
        g = per_frame(r.frame, (scaled @ r.value[..., None])[..., 0], problem.frames)
        damping = 1e-3 * 0.5**iteration
        H = H + torch.diag_embed(damping * H.diagonal(dim1=-2, dim2=-1) + 1e-9)
        poses = _moved(poses, camera, projector, -torch.linalg.solve(H, g))
    return poses


def _moved(poses: Poses, camera: Tensor, projector: Tensor, increment: Float[Tensor, "frames 12"]) -> Poses:
    return poses.moved((camera @ increment[..., None])[..., 0], (projector @ increment[..., None])[..., 0])


def _median(values: Tensor) -> Tensor:
    return values.median() if len(values) else values.new_tensor(1.0)
