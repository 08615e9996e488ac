"""Frames that were left out are placed against the others once those are adjusted.

Before the joint adjustment every surface is bent by the errors of its own relative pose, and only as certain as that.
Afterwards a weak frame has to agree with surfaces that are known far better.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.similarity import Similarity, angle_deg
from sl_nerfstudio.registration.assembly import Assembly, Component
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.result import Edge, Registration
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, RegistrationSettings
from sl_nerfstudio.registration.surface_map import build_surface_map
from sl_nerfstudio.registration.view_graph import ViewGraph, split_by_slip
from sl_nerfstudio.threads import one_library_thread


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
    settings: RegistrationSettings = REGISTRATION_DEFAULTS,
) -> Registration:
    """The registration, at the adjusted poses, with those of `left_out` that can now be placed by more than one pair.

    `clouds` have the adjusted relative poses; poses of frames that are not registered are NaN.
    """
    n = len(clouds)
    graph = ViewGraph(
        [build_surface_map(c, settings.surface_map) for c in clouds], [None] * n, np.random.default_rng(seed), settings
    )
    main: Component = {
        k: Similarity(float(adjusted.baseline[k]), T[:3, :3], T[:3, 3])
        for k, T in enumerate(adjusted.T_world_camera)
        if registration.registered[k]
    }
    search = settings.pair.anywhere
    for k in left_out:
        graph.try_pairs(graph.bridges(main, {k: Similarity.identity()}), search)
    used = [e.fitness for e in registration.edges if e.used]
    firm, slipping = split_by_slip(graph.edges, settings.pair.bounded_slip_deg)
    # after the adjustment right frames fit as well as the others do
    strict = replace(settings.assembly, misfit_factor=settings.assembly.inner_misfit_factor)
    assembly = Assembly(graph.sides, graph.pivots, firm, replace(settings, assembly=strict), used or None, slipping)
    placed: Component = {}
    singles: list[Component] = [{k: Similarity.identity()} for k in left_out]
    for block in (*_blocks(registration, left_out), *singles):
        joint = None if block.keys() <= placed.keys() else assembly.decide(main, block)
        if joint is not None and joint.links > 1:
            placed |= {k: joint.S_first_second @ S for k, S in block.items()}
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
        T[k] = np.eye(4)
        T[k, :3, :3], T[k, :3, 3] = S.R, S.t
    names = {registration.names[k] for k in placed}
    found = replace(
        registration,
        registered=registered,
        component=component,
        T_world_camera=T,
        baseline=baseline,
        fitness=fitness,
        exclusions=tuple(e for e in registration.exclusions if e.frame not in names),
    )
    return with_edges_at_poses(found, names)


def with_edges_at_poses(
    registration: Registration, frames: Collection[str], settings: RegistrationSettings = REGISTRATION_DEFAULTS
) -> Registration:
    """The registration; pairs of `frames`, which stand elsewhere now, are used if they say the same rotation."""
    T = dict(zip(registration.names, registration.T_world_camera, strict=True))

    def says_the_same(edge: Edge) -> bool:
        first, second = (T[name][:3, :3] for name in edge.frames)
        if not np.isfinite([first, second]).all():
            return False
        limit_deg = settings.pair.same_rotation_deg + settings.pair.kernel_sigmas * edge.rotation_sigma_deg
        return angle_deg(edge.R_second_first @ first.T @ second) <= limit_deg

    edges = (replace(e, used=says_the_same(e)) if set(e.frames) & set(frames) else e for e in registration.edges)
    return replace(registration, edges=tuple(edges))
