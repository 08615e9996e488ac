"""After rough starts: where the surfaces of single frames fit together, as another place to begin a search.

Look-ups compare coordinates at one place and lead a frame home from about its own details away. Each frame alone shows
a surface, too, from its coordinates and the pose of its projector, and surfaces can be registered from much farther.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.gauge import baseline_scale, restore
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.search.problem import Problem
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.devices.device import PARAMETERS
from sl_nerfstudio.registration.frame_cloud import FrameCloud, frame_cloud
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, relative_pose_near
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of
from sl_nerfstudio.threads import results


def registered_start(problem: Problem, refine: RefinePoses) -> Rig | None:
    """The starting rig with frames where the registration of their surfaces puts them; None if it joins no two.

    A frame that it does not join stays at its starting pose. Projectors move only where they are free.
    """
    start = problem.start
    clouds = [c for c in results([partial(_cloud, problem, k) for k in range(start.frames)]) if c is not None]
    chosen = [int(c.name) for c in clouds]
    if len(chosen) < 2:
        return None
    cameras = start.T_world_camera[chosen].numpy()
    found = register(clouds, False, problem.settings.seed, cameras)
    joined = np.flatnonzero(found.registered).tolist()
    if len(joined) < 2:
        return None
    relative = np.stack([clouds[k].pose.T_camera_projector for k in joined])
    relative[:, :3, 3] *= found.baseline[joined, None]
    index = torch.tensor([chosen[k] for k in joined])
    known = _part(start, index)
    placed = replace(
        known,
        T_world_camera=torch.from_numpy(found.T_world_camera[joined]),
        T_camera_projector=torch.from_numpy(relative),
    )
    placed = restore(known, placed, baseline_scale(known, placed, None))
    camera, projector = start.T_world_camera.clone(), start.T_camera_projector.clone()
    camera[index] = placed.T_world_camera
    if refine == "free":
        projector[index] = placed.T_camera_projector
    return replace(start, T_world_camera=camera, T_camera_projector=projector)


def _cloud(problem: Problem, k: int) -> FrameCloud | None:
    """The surface of one frame, named by its number; None where too little of it was decoded."""
    rig, s = problem.start, problem.settings.hops
    coords = _thinned(problem.maps.image(k).numpy(), s.registered_side)
    uv_camera, uv_projector = correspondences_of(coords)
    if len(uv_camera) < s.registered_pixels:
        return None
    h, w = coords.shape[:2]
    lit = np.ceil(uv_projector.max(0)).astype(int)  # the part of the pattern that matters
    devices = _device(rig.camera[k], w, h), _device(rig.projector, int(lit[0]), int(lit[1]))
    try:
        pose = relative_pose_near(rig.T_camera_projector[k].numpy(), uv_camera, uv_projector, *devices)
        return frame_cloud(str(k), coords, *devices, pose)
    except RelativePoseError:  # hardly any coordinate agrees with a pose near the stated one
        return None


def _thinned(image: ndarray, side: int) -> Float32[ndarray, "h w 2"]:
    """Only every n-th decoded pixel of an image that is much larger than surfaces are compared at."""
    step = max(round(max(image.shape[:2]) / side), 1)
    kept = np.full_like(image, np.nan, dtype=np.float32)
    kept[::step, ::step] = image[::step, ::step]
    return kept


def _device(intrinsics: Intrinsics, w: int, h: int) -> Device:
    values = dict(zip(PARAMETERS, intrinsics.params.tolist(), strict=True))
    return Device(w, h, **values, model=intrinsics.model)


def _part(rig: Rig, index: torch.Tensor) -> Rig:
    return Rig(rig.camera[index], rig.projector, rig.T_world_camera[index], rig.T_camera_projector[index])
