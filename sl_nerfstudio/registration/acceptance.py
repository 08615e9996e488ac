"""Which frames are registered in the end, why the others are not, and what is uncertain."""

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.assembly import Component
from sl_nerfstudio.registration.graph_residuals import Nodes, node_at
from sl_nerfstudio.registration.pairs.edge_weights import is_accepted, is_ambiguous, quality, support
from sl_nerfstudio.registration.pairs.pair_match import PairMatch
from sl_nerfstudio.registration.pairs.surface_agreement import Tolerance, agreement_at
from sl_nerfstudio.registration.pose_graph import PoseGraphSolution
from sl_nerfstudio.registration.result import (
    Edge,
    Exclusion,
    NoCommonSurface,
    PairsContradict,
    PoorPair,
    Registration,
    SeparateComponent,
    SeparatePoses,
    SurfaceDisagrees,
    UncertainRotation,
)
from sl_nerfstudio.registration.settings import EdgeSettings
from sl_nerfstudio.registration.symmetry.symmetric_turns import symmetric_turns_deg
from sl_nerfstudio.registration.view_graph import ViewGraph
from sl_nerfstudio.threads import results


def accept_frames(
    names: tuple[str, ...], graph: ViewGraph, ordered: bool, others: Sequence[PairMatch] = ()
) -> Registration:
    """Poses and baselines of the largest component; every other frame with its reason.

    `others`: pairs that are not in the graph, and may say that the surface looks the same after a turn.
    """
    components, settings = graph.assemble(), graph.settings
    edges = graph.holding(components[0])
    main = components[0] if len(components[0]) > 1 else {}
    component = _numbers(components, len(names))
    solution = graph.solve(components[0])
    connected = component == 0
    rngs = graph.rng.spawn(len(names))
    fitness = np.array(
        results([partial(_fitness_of, k, solution, connected, graph, rng) for k, rng in enumerate(rngs)])
    )
    agrees = connected & (fitness >= settings.acceptance.least_fitness)
    doubts = _doubtful(names, agrees, edges, solution.consistent, settings.edge)
    few = len(doubts) <= settings.acceptance.most_doubtful * agrees.sum()
    registered = agrees & ~np.isin(np.arange(len(names)), list(doubts)) if few else agrees
    poses, baseline = _in_first_camera(solution.S_world_camera, registered)
    consistent = [e for e, used in zip(edges, solution.consistent, strict=True) if used]
    return Registration(
        names,
        poses,
        baseline,
        registered,
        component,
        np.where(registered, fitness, np.nan),
        tuple(
            Edge(
                (names[e.source], names[e.target]), e.S_target_source.R, e.overlap, e.fitness, bool(used),
                is_ambiguous(e, settings.edge), e.rotation_sigma_deg, e.by_tone,
            )
            for e, used in zip(edges, solution.consistent, strict=True)
        ),
        tuple(
            doubts[k]
            if agrees[k]
            else SurfaceDisagrees(names[k], float(fitness[k]))
            if connected[k]
            else _exclusion(k, names, components, main, graph)
            for k in np.flatnonzero(~registered).tolist()
        ),
        tuple(_uncertainties(names, consistent, registered, graph)),
        tuple(_separate_poses(names, c, graph) for c in components[1:] if len(c) > 1),
        symmetric_turns_deg(graph.sides, edges, solution, settings, [*others, *graph.put_aside]),
        ordered,
    )  # fmt: skip


def _doubtful(
    names: Sequence[str],
    inside: Bool[ndarray, "n"],
    edges: Sequence[PairMatch],
    consistent: Bool[ndarray, "edges"],
    settings: EdgeSettings,
) -> dict[int, PairsContradict]:
    """Frames most of whose pairs with others, counted by how well they fit, contradict the solution."""
    found = {}
    frames: list[int] = np.flatnonzero(inside).tolist()
    for k in frames:
        mine = [(e, bool(u)) for e, u in zip(edges, consistent, strict=True) if k in (e.source, e.target)]
        mine = [(e, used) for e, used in mine if inside[e.other(k)] and not is_ambiguous(e, settings)]
        against = [e for e, used in mine if not used]
        if math.fsum(map(support, against)) > math.fsum(support(e) for e, used in mine if used):
            found[k] = PairsContradict(names[k], len(mine), len(against))
    return found


def _separate_poses(names: Sequence[str], component: Component, graph: ViewGraph) -> SeparatePoses:
    """The poses of a component that is not the largest, among themselves."""
    inside = np.isin(np.arange(len(names)), list(component))
    poses, baseline = _in_first_camera(graph.solve(component).S_world_camera, inside)
    return SeparatePoses(tuple(np.array(names)[inside].tolist()), poses[inside], baseline[inside])


def _numbers(components: Sequence[Component], n: int) -> Int64[ndarray, "n"]:
    """Number of each frame's component; -1 for single frames."""
    number = np.full(n, -1, dtype=np.int64)
    for c, frames in enumerate(c for c in components if len(c) > 1):
        number[list(frames)] = c
    return number


def _fitness_of(
    k: int, solution: PoseGraphSolution, connected: Bool[ndarray, "n"], graph: ViewGraph, rng: np.random.Generator
) -> float:
    """Of a frame's points that other frames can judge, the share that agrees."""
    S, settings = solution.S_world_camera[k], graph.settings.pair
    if S is None or not connected[k]:
        return 0.0
    agreeing = expected = 0.0
    for j in np.flatnonzero(connected).tolist():
        other = solution.S_world_camera[j]
        if j == k or other is None or not graph.see_same_side(S, other):
            continue
        maps = graph.maps[k], graph.maps[j]
        found = agreement_at(maps, other.inverse() @ S, rng, Tolerance(0.0, settings.tolerance_sigmas), settings)
        agreeing += found.agreeing[0]
        expected += found.expected[0]
    return agreeing / expected if expected else 0.0


def _in_first_camera(
    nodes: Nodes, registered: Bool[ndarray, "n"]
) -> tuple[Float64[ndarray, "n 4 4"], Float64[ndarray, "n"]]:
    """Camera poses and baselines in the axes of the first registered camera, geometric mean of the baselines one."""
    n = len(registered)
    poses, baseline = np.full((n, 4, 4), np.nan), np.full(n, np.nan)
    frames: list[int] = np.flatnonzero(registered).tolist()
    if not frames:
        return poses, baseline
    world = [node_at(nodes, k) for k in frames]
    unit = float(np.exp(np.mean([np.log(S.scale) for S in world])))
    gauge = Similarity.scaling(1 / unit) @ Similarity(1.0, world[0].R, world[0].t).inverse()
    for k, S in zip(frames, (gauge @ S for S in world), strict=True):
        baseline[k] = S.scale
        poses[k] = np.eye(4)
        poses[k, :3, :3], poses[k, :3, 3] = S.R, S.t
    return poses, baseline


def _exclusion(
    k: int, names: Sequence[str], components: Sequence[Component], main: Component, graph: ViewGraph
) -> Exclusion:
    """Why a frame is not in the largest component."""
    settings = graph.settings.edge
    mine = [e for e in graph.matches if k in (e.source, e.target)]
    if not mine:
        return NoCommonSurface(names[k])
    best = max(mine, key=lambda e: quality(e, settings))
    if not is_accepted(best, settings):
        partner = names[best.other(k)]
        return PoorPair(names[k], partner, best.overlap, best.fitness, settings.least_overlap, settings.least_fitness)
    component = next(c for c in components if k in c)
    across = [
        (e, e.source if e.source in main else e.target)
        for e in graph.matches
        if (e.source in main and e.target in component) or (e.target in main and e.source in component)
    ]
    partner = names[max(across, key=lambda pair: quality(pair[0], settings))[1]] if across else None
    # where no two frames could be joined, every pair of the frame might have joined it
    joining = [e for e in ([e for e, _ in across] if main else mine) if is_accepted(e, settings)]
    slips = bool(joining) and all(e.slip_deg > 0 for e in joining)
    return SeparateComponent(names[k], tuple(names[j] for j in sorted(component)), slips, partner)


def _uncertainties(
    names: Sequence[str], consistent: Sequence[PairMatch], registered: Bool[ndarray, "n"], graph: ViewGraph
) -> list[UncertainRotation]:
    """Registered frames that no pair determines well."""
    out: list[UncertainRotation] = []
    frames: list[int] = np.flatnonzero(registered).tolist()
    for k in frames:
        mine = [e for e in consistent if k in (e.source, e.target)]
        sigma_deg = min((e.rotation_sigma_deg for e in mine), default=0.0)
        if mine and all(e.slip_deg > 0 for e in mine):
            out.append(UncertainRotation(names[k], graph.settings.acceptance.unknown_sigma_rotation_deg))
        elif sigma_deg > graph.settings.acceptance.largest_sigma_rotation_deg:
            out.append(UncertainRotation(names[k], sigma_deg))
    return out
