"""One search: all stages, with frames that were lost on the way."""

from dataclasses import replace

import torch

from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import LMState
from sl_nerfstudio.bundle_adjustment.observations import away_from_borders
from sl_nerfstudio.bundle_adjustment.relocalisation import relocalise
from sl_nerfstudio.bundle_adjustment.residuals import pixels_of_rows, residuals_of, viewing_cosines
from sl_nerfstudio.bundle_adjustment.robust_kernel import noise_ratios, useful_distance
from sl_nerfstudio.bundle_adjustment.search.problem import FRAMES_MOVE, Problem, Progress
from sl_nerfstudio.bundle_adjustment.search.stages import Stage, run_stage, stages
from sl_nerfstudio.geometry.devices import project


def search(problem: Problem, refine: RefinePoses) -> tuple[Progress, float] | None:
    """All stages, and the median residual at the beginning; None if there is nothing to search."""
    begin, settings = problem.begin, problem.settings
    state = LMState(begin, problem.anchors, settings.steps.damping)
    rows = problem.observe(state)
    r = residuals_of(begin, state.anchors, rows, problem.maps)
    if settings.max_iterations < 1 or not r.cross_valid.any():
        return None
    before = float(r.cross[r.cross_valid].norm(dim=-1).median())
    widths = torch.full((begin.frames,), float("inf"), dtype=torch.float64)
    found = Progress(state, rows, widths, max(before, settings.kernel.noise_floor_px), 0)
    *rough, last = stages(refine, settings)
    for stage in rough:
        found = run_stage(problem, stage, found)
    found = _relocalised(problem, refine, rough[-1], found)
    found = _away_from_borders(problem, found)
    found = run_stage(problem, replace(last, iterations=max(settings.max_iterations - found.iterations, 1)), found)
    return found, before


def _away_from_borders(problem: Problem, found: Progress) -> Progress:
    """Without look-ups so near to the border of what was decoded that their residuals are larger than usual.

    As wide a strip beside those falls away, too, if windows reach that far: their look-ups average over both.
    """
    state, maps, s = found.state, problem.maps, problem.settings.kernel
    anchors, rows = state.anchors, found.rows
    r = residuals_of(state.rig, anchors, rows, maps)
    frame = torch.cat([anchors.frame, rows.frame])
    uv_own = project(state.rig.camera[anchors.frame], anchors.d_camera)[0]
    uv = torch.cat([uv_own, pixels_of_rows(state.rig, anchors, rows)[0]])
    own, seen = maps.border_distance(frame, uv).tensor_split([len(uv_own)])
    size = r.cross.norm(dim=-1) / noise_ratios(r, viewing_cosines(state.rig, anchors, rows), s)
    nearer = torch.minimum(own[rows.anchor], seen)
    least = useful_distance(nearer[r.cross_valid], size[r.cross_valid], s)
    if least <= 0:
        return found
    least += min(least, maps.settings.half_window)
    anchors, rows = away_from_borders(anchors, rows, (own, seen), least, state.rig.frames)
    return replace(found, state=replace(state, anchors=anchors), rows=rows)


def _relocalised(problem: Problem, refine: RefinePoses, stage: Stage, found: Progress) -> Progress:
    """Place lost frames again and adjust everything with them, until no frame moves any more.

    A frame that was searched for in vain is searched for again only when others were found.
    """
    if refine not in FRAMES_MOVE:
        return found
    expected = problem.expected.clone()
    for _ in range(problem.settings.relocalisation.rounds):
        again = relocalise(
            found.state.rig, problem.start, problem.maps, problem.prior, refine, found.noise, problem.generator,
            problem.settings, expected,
        )  # fmt: skip
        moved = (again.rig.T_world_camera != found.state.rig.T_world_camera).flatten(1).any(1)
        if not moved.any():
            break
        found = run_stage(problem, stage, found.at(again.rig, moved))
        if again.found:
            expected = problem.expected.clone()
        expected[list(again.in_vain)] = float("-inf")
    return found
