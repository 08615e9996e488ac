"""After rough starts: a search is begun again beside its end, and goes on from wherever more is explained.

From starting poses that are off by several degrees some frames end in a minimum of their own, where two or three of
them agree with each other and well enough with the rest. Poses drawn about that end let them out again, while the
frames that are right return. (Basin hopping: Wales and Doye, J. Phys. Chem. A, 1997; only what is better is kept.)
"""

from dataclasses import dataclass

import torch

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.joint_covariance.other_minima import departure_of, with_frames_of
from sl_nerfstudio.bundle_adjustment.observations import place_anchors
from sl_nerfstudio.bundle_adjustment.priors import PosePrior
from sl_nerfstudio.bundle_adjustment.relocalisation import rows_of_all, unplaced_frames
from sl_nerfstudio.bundle_adjustment.residuals import residuals_of
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.search.one_search import search
from sl_nerfstudio.bundle_adjustment.search.problem import FRAMES_MOVE, Problem, Progress
from sl_nerfstudio.bundle_adjustment.search.registered_start import registered_start
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.geometry.robust import geman_mcclure_cost

_HALF = 0.5  # share of the frames that every second hop moves


@dataclass(frozen=True)
class Hopped:
    """Where further searches have ended."""

    best: Progress
    others: tuple[Progress, ...]  # where those after the best one have ended, if it was elsewhere
    settled: bool  # the last one led back, or none was asked for


def hopped(problem: Problem, refine: RefinePoses, found: Progress) -> Hopped:
    """The end of the search, or a better one; ends as soon as a hop leads back to the best one, or none is better.

    The first hop begins where a registration of the frames' surfaces puts them. Frames that agree with no others at the
    first end are not searched for again.
    """
    s, generator = problem.settings.hops, torch.Generator().manual_seed(problem.settings.seed)
    possible = refine in FRAMES_MOVE and found.state.rig.frames <= s.most_frames
    if s.most < 1 or not possible or not is_rough(problem.prior, s.from_deg):
        return Hopped(found, (), True)
    best, others = found, []
    unplaced = unplaced_frames(found.state.rig, problem.maps, found.noise, problem.settings)
    expected = problem.expected.clone()
    expected[list(unplaced)] = float("-inf")
    registered = registered_start(problem, refine, problem.start, range(problem.start.frames))
    for hop in range(s.most):
        if hop == 0 and registered is not None:
            again = problem.again(problem.start, registered, problem.expected)
        else:
            begin = _moved(best.state.rig, problem.prior, s.size, 1.0 if hop % 2 else _HALF, generator)
            again = problem.again(problem.start, begin, expected)
        end = search(again, refine)
        if end is None:
            continue
        other = end[0]
        width = s.width_noises * min(best.noise, other.noise)
        now, then = (_explained(p.state.rig, problem.maps, width, problem.settings) for p in (other, best))
        if now > (1 + s.least_gain) * then:
            best, others = other, []
        elif _leads_back(with_frames_of(other.state.rig, best.state.rig, unplaced), best.state.rig, problem):
            return Hopped(best, tuple(others), True)
        else:
            others.append(other)
            if len(others) == s.patience:
                break
    return Hopped(best, tuple(others), False)


def _leads_back(other: Rig, best: Rig, problem: Problem) -> bool:
    """Whether every frame has come back, most of the way that hops take it."""
    s = problem.settings.hops
    departure = departure_of(other, best).reshape(2, -1, 6)[0] / (s.size * problem.prior.sigma[:, :6])
    return float(departure.square().mean(1).max().sqrt()) <= s.most_left


def is_rough(prior: PosePrior, from_deg: float) -> bool:
    """Whether the starting poses of most frames are as uncertain as that."""
    return float(torch.rad2deg(prior.frame_rotation).median()) >= from_deg


def _moved(rig: Rig, prior: PosePrior, size: float, share: float, generator: torch.Generator) -> Rig:
    """Some frames as a whole at poses drawn about theirs, with a share of the uncertainty of the starting poses."""
    chosen = torch.rand(rig.frames, 1, generator=generator, dtype=torch.float64) < share
    draw = torch.randn(rig.frames, 6, generator=generator, dtype=torch.float64)
    delta = torch.where(chosen, size * draw * prior.sigma[:, :6], torch.zeros_like(draw))
    return rig.moved(delta, torch.zeros_like(delta))


def _explained(rig: Rig, maps: CoordinateMaps, width_px: float, settings: AdjustmentSettings) -> float:
    """Look-ups of an anchor that agree, about: a large residual counts little, a look-up that fails nothing."""
    generator = torch.Generator().manual_seed(settings.seed)
    anchors = place_anchors(rig, maps, settings.hops.anchors_per_frame, generator)
    rows = rows_of_all(rig, anchors, maps, settings, generator)
    r = residuals_of(rig, anchors, rows, maps)
    share = (r.cross[r.cross_valid] / width_px).square().sum(-1)
    return float((1 - geman_mcclure_cost(share)).sum()) / max(len(anchors.frame), 1)
