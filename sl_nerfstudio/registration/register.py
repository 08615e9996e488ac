"""Registration of all frames: pairs, cycles, a robust pose graph; frames that are placed later; undecided projectors.

The result is a camera pose and the length of the baseline of every frame. Lengths are relative: the geometric mean of
the registered frames' baselines is 1 until a known length says how long one of them really is.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, angle_deg
from sl_nerfstudio.parallel import one_library_thread, results, tracked
from sl_nerfstudio.registration.assembly import facing, relative
from sl_nerfstudio.registration.evidence import Frame, ScanEvidence
from sl_nerfstudio.registration.pairs import (
    ANYWHERE,
    KERNEL_SIGMAS,
    LEAST_ODDS,
    NEIGHBOURS,
    SAME_ROTATION_DEG,
    PairMatch,
    Search,
    is_accepted,
    is_ambiguous,
    largest_rotation_sigma_deg,
    register_pair,
    search_score,
)
from sl_nerfstudio.registration.pose_graph import Component, EdgeArrays, Pivots, PoseGraphSolution
from sl_nerfstudio.registration.result import (
    Edge,
    Exclusion,
    NoCommonSurface,
    OpenPlace,
    PoorPair,
    Registration,
    SeparateComponent,
    SeparatePoses,
    SurfaceDisagrees,
    UncertainRotation,
    UndecidedProjector,
)
from sl_nerfstudio.registration.surfaces import FrameCloud
from sl_nerfstudio.registration.view_graph import ViewGraph, starting_similarities, with_common_centre

SEQUENCE_GAPS = (1, 2)  # differences between the numbers of frames that are paired in a sequence
ROUNDS = 2  # of closing cycles
LEAST_JOINED = 0.5  # share of successive frames that must be joined for their order to be that of capture
FACING = 8  # frames with which each is compared at last
LARGEST_SIGMA_ROTATION_DEG = 3.0  # standard deviation of the least known rotation beyond which it is uncertain
UNKNOWN_SIGMA_ROTATION_DEG = 104.0  # the same where the rotation is unobservable: of all angles from -180 to 180
REACH = 2  # frames before and after one with which each pose of its projector is compared
PENALTY = 3.0  # of a contradicting point, where an agreeing one counts 1: a plane always agrees with a plane
RIVAL = 0.8  # support of another pose, relative to the best, from which the choice is not certain


@one_library_thread()
def register(
    clouds: Sequence[FrameCloud],
    sequence: bool = True,
    seed: int = 0,
    start: Float64[ndarray, "n 4 4"] | None = None,
    captures: Sequence[int] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Registration:
    """Camera poses of all frames in one world; alternatives of the clouds are not considered.

    Args:
        clouds: the frames, in the order of capture if `sequence`.
        sequence: each frame overlaps its neighbours; if not, or where few of them do, every pair is tried.
        seed: of the choice of points.
        start: camera poses (camera to world) that are known roughly, within about 20 degrees; NaN where unknown.
        captures: number of each frame's capture, if some between them are not used; by default 0, 1, 2 and so on.
        progress: called with a few words at the beginning of each stage.
    """
    report = progress or (lambda _: None)
    n = len(clouds)
    frames = tracked([partial(Frame.of, c) for c in clouds], "averaging surfaces")
    maps = [frame.map for frame in frames]
    rough = {} if start is None else starting_similarities(start, maps)
    centred = with_common_centre(rough, maps)
    graph = ViewGraph(frames, centred, np.random.default_rng(seed), captures)
    report("registering pairs")
    if start is not None:
        graph.try_overlapping(rough)
        graph.try_overlapping(centred)
    ordered = sequence
    if start is None and sequence:
        for gap in SEQUENCE_GAPS:
            graph.try_pairs([(k, k + gap) for k in range(n - gap)], NEIGHBOURS)
        graph.learn_step()
        ordered = graph.step is not None or _in_order(graph.assemble(), n)
    if start is None and not ordered:
        report("comparing all frames")
        # what chance neighbours say is no help
        graph = ViewGraph(frames, centred, np.random.default_rng(seed), captures)
        graph.try_all()
    for _ in range(ROUNDS):
        report("closing loops")
        components = graph.assemble()
        for component in (c for c in components if len(c) > 1):
            graph.try_overlapping(graph.solve(component).S_world_camera)
        graph.bridge(components)
    return accept_frames(tuple(c.name for c in clouds), graph, ordered)


def _in_order(components: Sequence[Component], n: int) -> bool:
    """Whether successive frames mostly are in the same component."""
    number = {k: c for c, frames in enumerate(components) for k in frames}
    joined = sum(number[k] == number[k + 1] for k in range(n - 1))
    return joined >= LEAST_JOINED * (n - 1)


# Which frames are registered in the end, why the others are not, and what is uncertain.


def accept_frames(names: tuple[str, ...], graph: ViewGraph, ordered: bool) -> Registration:
    """Poses and baselines of the largest component; every other frame with its reason."""
    components = graph.assemble()
    sides = graph.sides_of_object()
    edges = graph.holding(components[0])
    main = components[0] if len(components[0]) > 1 else {}
    component = _numbers(components, len(names))
    solution = graph.solve(components[0])
    connected = component == 0
    scan = graph.evidence()
    tasks = [partial(_support_of, k, solution, scan) for k in range(len(names))]
    odds, fitness = np.array(results(tasks)).T
    registered = connected & (odds > LEAST_ODDS)
    poses, baseline = _in_first_camera(solution.S_world_camera, registered)
    index: list[int] = np.flatnonzero(registered).tolist()
    consistent = [e for e, used in zip(edges, solution.consistent, strict=True) if used]
    sigma = {k: _rotation_sigma_deg(k, consistent, graph.pivots) for k in index}
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
                is_ambiguous(e), e.rotation_sigma_deg, e.by_tone,
            )
            for e, used in zip(edges, solution.consistent, strict=True)
        ),
        tuple(
            SurfaceDisagrees(names[k], float(fitness[k]))
            if connected[k]
            else _exclusion(k, names, components, main, graph)
            for k in np.flatnonzero(~registered).tolist()
        ),
        tuple(UncertainRotation(names[k], sigma[k]) for k in index if sigma[k] > LARGEST_SIGMA_ROTATION_DEG),
        tuple(_separate_poses(names, c, graph) for c in components[1:] if len(c) > 1),
        sides.turns_deg,
        ordered,
        tuple(names[k] for k in sides.by_order),
    )  # fmt: skip


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


def _support_of(k: int, solution: PoseGraphSolution, scan: ScanEvidence) -> tuple[float, float]:
    """Log-odds of a frame's place against the frames that face it, and the share of points that agree with theirs."""
    nodes = solution.S_world_camera
    if k not in nodes:
        return 0.0, 0.0
    others = {j: S for j, S in nodes.items() if j != k}
    found = [scan.agreement(i, j, relative(nodes, i, j)) for i, j in facing({k: nodes[k]}, others, FACING)]
    odds, agreeing, expected = (math.fsum(each) for each in zip(*found, strict=True)) if found else (0.0, 0.0, 0.0)
    return odds, agreeing / expected if expected else 0.0


def _in_first_camera(
    nodes: Component, registered: Bool[ndarray, "n"]
) -> tuple[Float64[ndarray, "n 4 4"], Float64[ndarray, "n"]]:
    """Camera poses and baselines in the axes of the first registered camera, geometric mean of the baselines one."""
    n = len(registered)
    poses, baseline = np.full((n, 4, 4), np.nan), np.full(n, np.nan)
    frames: list[int] = np.flatnonzero(registered).tolist()
    world = [nodes[k] for k in frames]
    if not world:
        return poses, baseline
    unit = float(np.exp(np.mean([np.log(S.scale) for S in world])))
    gauge = Similarity.scaling(1 / unit) @ Similarity(1.0, world[0].R, world[0].t).inverse()
    for k, S in zip(frames, (gauge @ S for S in world), strict=True):
        baseline[k], poses[k] = S.scale, replace(S, scale=1.0).matrix()
    return poses, baseline


def _exclusion(
    k: int, names: Sequence[str], components: Sequence[Component], main: Component, graph: ViewGraph
) -> Exclusion:
    """Why a frame is not in the largest component."""
    mine = [e for e in graph.matches if k in (e.source, e.target)]
    if not mine:
        return NoCommonSurface(names[k])
    best = max(mine, key=lambda e: e.log_odds)
    if not is_accepted(best):
        partner = names[best.other(k)]
        return PoorPair(names[k], partner, best.overlap, best.fitness, best.log_odds, LEAST_ODDS)
    component = next(c for c in components if k in c)
    across = [
        (e, e.source if e.source in main else e.target)
        for e in graph.matches
        if (e.source in main and e.target in component) or (e.target in main and e.source in component)
    ]
    partner = names[max(across, key=lambda pair: pair[0].log_odds)[1]] if across else None
    if (block := next((one for one in graph.open if k in one.nodes), None)) is not None:
        group = tuple(names[j] for j in block.nodes)
        return OpenPlace(names[k], group, block.turn_deg, block.log_odds, partner)
    # where no two frames could be joined, every pair of the frame might have joined it
    joining = [e for e in ([e for e, _ in across] if main else mine) if is_accepted(e)]
    slips = bool(joining) and not any(e.holds for e in joining)
    return SeparateComponent(names[k], tuple(names[j] for j in sorted(component)), slips, partner)


def _rotation_sigma_deg(frame: int, pairs: Sequence[PairMatch], pivots: Pivots) -> float:
    """Standard deviation of a frame's least known rotation by all of its pairs, the other frames held."""
    mine = [e for e in pairs if frame in (e.source, e.target)]
    if not mine:
        return 0.0
    covariance = EdgeArrays.of(mine).covariance_of(frame, pivots)
    return min(largest_rotation_sigma_deg(covariance), UNKNOWN_SIGMA_ROTATION_DEG)


# Frames that were left out are placed against the others once those are adjusted. Before the joint adjustment every
# surface is bent by the errors of its own relative pose; afterwards a weak frame has to agree with surfaces that are
# known far better.


def with_relative_pose(
    cloud: FrameCloud,
    T_camera_projector: Float64[ndarray, "4 4"],
    sigma_rotation_rad: float,
    sigma_direction_rad: float,
) -> FrameCloud:
    """The cloud with another pose of its projector (baseline of any length), known to the given sigma per axis."""
    T = T_camera_projector.copy()
    T[:3, 3] /= np.linalg.norm(T[:3, 3])
    old = cloud.pose
    pose = replace(
        old,
        T_camera_projector=T,
        covariance=np.diag([sigma_rotation_rad**2] * 3 + [sigma_direction_rad**2] * 2),
        inliers=np.ones(int(old.inliers.sum()), dtype=bool),
        noise_px=old.noise_px[old.inliers],
        alternatives=(),
    )
    return cloud.with_pose(cloud.projector, pose)


@one_library_thread()
def include_left_out(
    clouds: Sequence[FrameCloud],
    registration: Registration,
    adjusted: DevicePoses,
    left_out: Sequence[int],
    seed: int = 0,
) -> Registration:
    """The registration, at the adjusted poses, with those of `left_out` that can now be placed by more than one pair.

    Pairs that slide along a side place none: the adjustment would only make a wrong place look certain.

    `clouds` have the adjusted relative poses; poses of frames that are not registered are NaN.
    """
    graph = ViewGraph(results([partial(Frame.of, c) for c in clouds]), {}, np.random.default_rng(seed))
    main: Component = {
        k: Similarity(float(adjusted.baseline[k]), T[:3, :3], T[:3, 3])
        for k, T in enumerate(adjusted.T_world_camera)
        if registration.registered[k]
    }
    for k in left_out:
        graph.try_pairs(graph.bridges(main, {k: Similarity.identity()}), ANYWHERE)
    assembly = graph.assembly([e for e in graph.edges if not e.slip_deg], graph.evidence())
    placed: Component = {}
    singles: list[Component] = [{k: Similarity.identity()} for k in left_out]
    for block in (*_blocks(registration, left_out), *singles):
        joint = None if block.keys() <= placed.keys() else assembly.decide(main, block)
        if joint is not None:
            placed |= {k: joint @ S for k, S in block.items()}
    return _with_frames(registration, adjusted, placed)


def _blocks(registration: Registration, left_out: Sequence[int]) -> list[Component]:
    """Frames that registration connected with each other but not with the rest: together they may be certain."""
    number = {registration.names[k]: k for k in left_out}
    blocks: list[Component] = []
    for one in registration.separate:
        rows = zip(one.frames, one.baseline.tolist(), one.T_world_camera, strict=True)
        blocks.append({number[name]: Similarity(b, T[:3, :3], T[:3, 3]) for name, b, T in rows if name in number})
    return [block for block in blocks if len(block) > 1]


def _with_frames(registration: Registration, adjusted: DevicePoses, placed: Component) -> Registration:
    registered, component = registration.registered.copy(), registration.component.copy()
    T, baseline, fitness = adjusted.T_world_camera.copy(), adjusted.baseline.copy(), registration.fitness.copy()
    for k, S in placed.items():
        registered[k], component[k], baseline[k], fitness[k] = True, 0, S.scale, 1.0
        T[k] = replace(S, scale=1.0).matrix()
    names = {registration.names[k] for k in placed}
    found = replace(
        registration, registered=registered, component=component, T_world_camera=T, baseline=baseline, fitness=fitness,
        exclusions=tuple(e for e in registration.exclusions if e.frame not in names),
    )  # fmt: skip
    return _with_edges_at_poses(found, names)


def _with_edges_at_poses(registration: Registration, frames: Collection[str]) -> Registration:
    """The registration; pairs of `frames`, which stand elsewhere now, are used if they say the same rotation."""
    T = dict(zip(registration.names, registration.T_world_camera, strict=True))

    def says_the_same(edge: Edge) -> bool:
        first, second = (T[name][:3, :3] for name in edge.frames)
        if not np.isfinite([first, second]).all():
            return False
        limit_deg = SAME_ROTATION_DEG + KERNEL_SIGMAS * edge.rotation_sigma_deg
        return angle_deg(edge.R_second_first @ first.T @ second) <= limit_deg

    edges = (replace(e, used=says_the_same(e)) if set(e.frames) & set(frames) else e for e in registration.edges)
    return replace(registration, edges=tuple(edges))


# Frames of which two poses of the projector explain the coordinates: a wrong pose bends the surface of its frame, so it
# agrees less with those of other frames.


@dataclass(frozen=True)
class ProjectorChoice:
    """The chosen cloud of every frame, and the frames where the choice is not certain."""

    chosen: tuple[int, ...]  # for every frame 0, its own cloud, or the number of an alternative from 1
    undecided: tuple[UndecidedProjector, ...]


def chosen_clouds(clouds: Sequence[FrameCloud], chosen: Sequence[int]) -> list[FrameCloud]:
    """The chosen cloud of every frame, without alternatives."""
    return [replace((cloud, *cloud.alternatives)[k], alternatives=()) for cloud, k in zip(clouds, chosen, strict=True)]


@one_library_thread()
def choose_projectors(clouds: Sequence[FrameCloud], sequence: bool = True, seed: int = 0) -> ProjectorChoice:
    """Choose the cloud of every frame that agrees best with those of its neighbours; falls back to the first."""
    choices = [(c, *c.alternatives) for c in clouds]
    chosen, undecided = [0] * len(clouds), []
    open_frames = [k for k, every in enumerate(choices) if len(every) > 1]
    built = iter(results([partial(Frame.of, c) for every in choices for c in every]) if open_frames else [])
    frames = [[next(built) for _ in every] for every in choices] if open_frames else []
    rng = np.random.default_rng(seed)
    for k in track(open_frames, "comparing poses of projectors"):
        scores = _support_of_choices(k, frames, sequence, rng)
        best = chosen[k] = int(np.argmax(scores))
        rivals = [h for h, score in enumerate(scores) if h != best and score >= RIVAL * scores[best]]
        if rivals:
            R = [c.pose.T_camera_projector[:3, :3] for c in choices[k]]
            undecided.append(UndecidedProjector(clouds[k].name, max(angle_deg(R[best] @ R[h].T) for h in rivals)))
    return ProjectorChoice(tuple(chosen), tuple(undecided))


def _support_of_choices(
    k: int, frames: Sequence[Sequence[Frame]], sequence: bool, rng: np.random.Generator
) -> list[float]:
    """Sum up, for every cloud of a frame, what agrees with its neighbours, less what contradicts."""
    partners = _partners(k, frames, sequence, rng)
    pairs = [(own, frames[j]) for own in frames[k] for j in partners]
    search = NEIGHBOURS if sequence else ANYWHERE
    tasks = [
        partial(_best_agreement, *pair, search, own) for pair, own in zip(pairs, rng.spawn(len(pairs)), strict=True)
    ]
    return np.reshape(results(tasks), (len(frames[k]), -1)).sum(1).tolist()


def _partners(k: int, frames: Sequence[Sequence[Frame]], sequence: bool, rng: np.random.Generator) -> list[int]:
    """Frames taken shortly before and after; of an unordered set those that look most alike."""
    n = len(frames)
    if sequence:
        return [j for j in range(max(0, k - REACH), min(n, k + REACH + 1)) if j != k]
    others = [j for j in range(n) if j != k]
    tasks = [
        partial(search_score, (frames[k][0].map, frames[j][0].map), ANYWHERE, own)
        for j, own in zip(others, rng.spawn(len(others)), strict=True)
    ]
    return [others[i] for i in np.argsort(-np.array(results(tasks)), kind="stable")[: 2 * REACH]]


def _best_agreement(own: Frame, partner: Sequence[Frame], search: Search, rng: np.random.Generator) -> float:
    best = 0.0
    for other in partner:
        match = register_pair((own, other), (0, 1), search, rng)
        if match is not None and is_accepted(match):
            contradicting = match.overlap * (1 / match.fitness - 1)
            best = max(best, match.overlap - PENALTY * contradicting)
    return best
