"""Registration of all frames: pairs, cycles, a robust pose graph.

The result is a camera pose and the length of the baseline of every frame. Lengths are relative: the geometric mean of
the registered frames' baselines is 1 until `known_length` says how long one of them really is.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.acceptance import accept_frames
from sl_nerfstudio.registration.assembly import Component
from sl_nerfstudio.registration.capture_order import chain_of_small_steps, sides_are_open, typical_step_deg
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.registration.rough_poses import starting_similarities, with_common_centre
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, RegistrationSettings
from sl_nerfstudio.registration.surface_map import build_surface_map
from sl_nerfstudio.registration.symmetry.turning_back import turn_blocks_back
from sl_nerfstudio.registration.view_graph import ViewGraph
from sl_nerfstudio.side_by_side import tracked
from sl_nerfstudio.threads import one_library_thread


@one_library_thread()
def register(
    clouds: Sequence[FrameCloud],
    sequence: bool = True,
    seed: int = 0,
    start: Float64[ndarray, "n 4 4"] | None = None,
    progress: Callable[[str], None] | None = None,
    settings: RegistrationSettings = REGISTRATION_DEFAULTS,
) -> Registration:
    """Camera poses of all frames in one world; alternatives of the clouds are not considered.

    Args:
        clouds: the frames, in the order of capture if `sequence`.
        sequence: each frame overlaps its neighbours; if not, or where few of them do, every pair is tried.
        seed: of the choice of points.
        start: camera poses (camera to world) that are known roughly, within about 20 degrees; NaN where unknown.
        progress: called with a few words at the beginning of each stage.
        settings: everything else.
    """
    report = progress or (lambda _: None)
    n, selection = len(clouds), settings.selection
    maps = tracked([partial(build_surface_map, c, settings.surface_map) for c in clouds], "averaging surfaces")
    rough: list[Similarity | None] = [None] * n
    if start is not None:
        rough = starting_similarities(start, maps, settings.start)
    centred = with_common_centre(rough, maps)
    graph = ViewGraph(maps, centred, np.random.default_rng(seed), settings)
    report("registering pairs")
    if start is not None:
        graph.try_overlapping(rough)
        graph.try_overlapping(centred)
    ordered = sequence
    if start is None and sequence:
        for gap in selection.sequence_gaps:
            graph.try_pairs([(k, k + gap) for k in range(n - gap)], settings.pair.neighbours)
        ordered = _in_order(graph.assemble(), n, selection.least_joined)
    if start is None and not ordered:
        report("comparing all frames")
        graph = ViewGraph(maps, centred, np.random.default_rng(seed), settings)  # what chance neighbours say is no help
        graph.try_all()
    for _ in range(selection.rounds):
        report("closing loops")
        components = graph.assemble()
        for component in (c for c in components if len(c) > 1):
            graph.try_overlapping(graph.solve(component).S_world_camera)
        graph.bridge(components)
    turn_blocks_back(graph)
    names = tuple(c.name for c in clouds)
    found = accept_frames(names, graph, ordered)
    most_are_lost = found.registered.sum() <= n / 2
    if start is None and sequence and (found.turns_deg or most_are_lost):
        return _by_order(names, graph, settings) or found
    return found


def _by_order(names: tuple[str, ...], graph: ViewGraph, settings: RegistrationSettings) -> Registration | None:
    """Frames that fit at several sides of the object, placed by the order of capture; None if that places few.

    `graph` is without it: frames are at other sides than they show, or most could not be placed.
    """
    step_deg = typical_step_deg(graph.matches, settings)
    if step_deg is None or not sides_are_open(graph.said, settings):
        return None
    chain = chain_of_small_steps(graph.maps, step_deg, graph.rng, settings)
    near = ViewGraph(graph.maps, [None] * len(names), graph.rng, settings)
    within = settings.order.different_sides_deg
    near.try_overlapping(chain, within)
    for _ in range(settings.selection.rounds):
        near.try_overlapping(near.solve(near.assemble()[0]).S_world_camera, within)
    placed = accept_frames(names, near, True, graph.said)
    return replace(placed, by_order=True) if placed.registered.sum() > len(names) / 2 else None


def _in_order(components: Sequence[Component], n: int, least: float) -> bool:
    """Whether successive frames mostly are in the same component."""
    number = {k: c for c, frames in enumerate(components) for k in frames}
    joined = sum(number[k] == number[k + 1] for k in range(n - 1))
    return joined >= least * (n - 1)
