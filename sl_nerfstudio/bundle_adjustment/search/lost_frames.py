"""Frames that agree with no others after a search: their surfaces may show where they belong, however far that is."""

from dataclasses import replace

from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.joint_covariance.other_minima import with_frames_of
from sl_nerfstudio.bundle_adjustment.relocalisation import unplaced_frames
from sl_nerfstudio.bundle_adjustment.search.one_search import search
from sl_nerfstudio.bundle_adjustment.search.problem import FRAMES_MOVE, Problem, Progress
from sl_nerfstudio.bundle_adjustment.search.registered_start import registered_start


def with_lost_frames(problem: Problem, refine: RefinePoses, found: Progress) -> tuple[Problem, Progress] | None:
    """The problem and the end of a search with lost frames where their surfaces put them; None if none is found there.

    The stated uncertainty of such a frame's starting pose was wrong: from now on it holds about the new place. What was
    known of its projector against its camera stays.
    """
    s = problem.settings.hops
    if not s.lost_by_surface or refine not in FRAMES_MOVE or problem.start.frames > s.most_frames:
        return None
    lost = _lost(problem, found)
    others = [k for k in range(problem.start.frames) if k not in lost]
    rig = registered_start(problem, refine, found.state.rig, others) if lost else None
    if rig is None:
        return None
    begin = with_frames_of(found.state.rig, rig, lost)
    start = replace(problem.start, T_world_camera=with_frames_of(problem.start, rig, lost).T_world_camera)
    end = search(problem.again(start, begin, problem.expected), refine)
    if end is None or not set(_lost(problem, end[0])) < set(lost):
        return None
    return replace(problem, start=start), end[0]


def _lost(problem: Problem, found: Progress) -> tuple[int, ...]:
    return unplaced_frames(found.state.rig, problem.maps, found.noise, problem.settings)
