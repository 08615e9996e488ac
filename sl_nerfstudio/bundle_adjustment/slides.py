"""How far single frames may have slid: the likelihood along the motion in which each is known least.

A covariance holds where residuals grow in proportion to a motion. Where few details hold a frame, as the holes of a
flange hold it about its axis, it leaves them after some tenths of a degree; farther on, look-ups contradict as they do
anywhere, and the likelihood may rise again. So it is asked on both sides, 4, 8, 16... sigma away (a slice of the
likelihood: Pawitan, In All Likelihood, 2001, section 3.4), of many pixels of the frame. A place s away whose look-ups
are preferred by z standard errors counts exp(z s / sigma): on a parabola whose maximum has the standard error sigma,
those of the right place would be preferred by s / (2 sigma).
"""

from collections.abc import Callable
from functools import partial
from math import exp, pi

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.parameters import PriorTerm, RefinePoses, free_parameters, rough_weight
from sl_nerfstudio.bundle_adjustment.posterior import frame_lead, many_pixels
from sl_nerfstudio.bundle_adjustment.residuals import OWN_PLACE_PX, Rig, linearise
from sl_nerfstudio.bundle_adjustment.search import INDEPENDENT, SearchProblem, SearchProgress, kernel_of
from sl_nerfstudio.parallel import results

_FIRST_SIGMAS = 4.0  # distance at which a frame is tried first; then twice as far each time
_PRIOR_SIGMAS = 2.0  # uncertainties of the starting pose up to which it is
_PARABOLA_SIGMAS = 6.0  # beyond which the parabola no longer holds: contradictions cost no more
_DECIDED = 7.0  # nats that look-ups say against both places: none farther off is tried
_CELL = 0.75  # of a distance, that a place stands for: half-way to those half as far and twice as far away


def with_slides(
    problem: SearchProblem, refine: RefinePoses, found: SearchProgress, factor: Float[Tensor, "joint k"],
    frames: list[int],
) -> Float[Tensor, "joint more"]:  # fmt: skip
    """The covariance's factor, wider by how far some of the frames may have slid, each by itself."""
    n, rig = found.state.rig.frames, found.state.rig
    directions, pixels = least_known_motions(problem, refine, found), many_pixels(problem)
    motions, asked = torch.zeros(len(frames), 2, n, 6, dtype=torch.float64), []
    for motion, k in zip(motions, frames, strict=True):
        motion[:, k] = directions[k].reshape(2, 6)
        sigma = float((motion.flatten() @ factor[: 12 * n]).norm())
        prior = float((directions[k] / problem.prior.sigma[k]).norm().reciprocal())
        asked.append(partial(how_far, partial(_lead_at, problem, rig, found.noise, k, motion, pixels), sigma, prior))
    sizes = torch.tensor(results(asked), dtype=torch.float64)
    columns = (sizes[:, None] * motions.flatten(1)).mT[:, sizes > 0]
    return torch.cat([factor, torch.nn.functional.pad(columns, (0, 0, 0, len(factor) - 12 * n))], 1)


def _lead_at(
    problem: SearchProblem, rig: Rig, noise: float, frame: int, motion: Float[Tensor, "2 frames 6"],
    pixels: tuple[Int[Tensor, "n"], Float[Tensor, "n 2"]], distance: float,
) -> float:  # fmt: skip
    """By how many standard errors look-ups prefer a frame at a distance along a motion to where it is."""
    moved = rig.moved(distance * motion[0], distance * motion[1])
    return frame_lead(problem, moved, rig, noise, frame, pixels)


def least_known_motions(
    problem: SearchProblem, refine: RefinePoses, found: SearchProgress
) -> Float[Tensor, "frames 12"]:
    """Increment of unit length (scene units, radian) of each frame that its look-ups and its prior know least.

    By the slopes of the surface's normals, with the look-ups of a frame counted as few.
    """
    rig, maps = found.state.rig, problem.maps
    linear = linearise(rig, found.state.anchors, found.rows, maps, OWN_PLACE_PX)
    r = linear.residuals
    kernel = kernel_of(found.state, found.rows, found.widths, r)
    per_frame = float(r.cross_valid.sum()) / rig.frames
    prior = PriorTerm(problem.prior, problem.start, rough_weight(found.noise, per_frame, INDEPENDENT))
    H = normal_equations(linear, found.rows, *kernel.weights(r)).H + prior.equations(rig)[0]
    own = free_parameters(refine, rig).own
    least = torch.linalg.eigh(own.mT @ H @ own).eigenvectors[:, :, :1]
    return torch.nn.functional.normalize((own @ least)[..., 0], dim=1)


def how_far(lead: Callable[[float], float], sigma: float, prior: float) -> float:
    """RMS distance at which a frame may be along a motion, beyond its sigma there.

    `lead`: by how many standard errors look-ups prefer the place at a signed distance. `prior`: sigma of its start.
    """
    distance, mass, square = _FIRST_SIGMAS * sigma, (2 * pi) ** 0.5 * sigma, 0.0
    if not sigma:
        return 0.0
    while distance <= _PRIOR_SIGMAS * prior:
        said = [min(lead(d) * min(distance / sigma, _PARABOLA_SIGMAS), 0.0) for d in (distance, -distance)]
        for nats in said:
            cell = _CELL * distance * exp(nats - 0.5 * (distance / prior) ** 2)
            mass, square = mass + cell, square + cell * distance**2
        if max(said) < -_DECIDED:
            break
        distance *= 2
    return (square / mass) ** 0.5
