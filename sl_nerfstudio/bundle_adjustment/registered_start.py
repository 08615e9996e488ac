"""Registered surfaces as another place to begin a search.

Look-ups compare coordinates at one place and lead a frame home from about its own details away. Each frame alone shows
a surface, too, from its coordinates and the pose of its projector, and surfaces can be registered from much farther.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.parameters import RefinePoses, alignment, baseline_scale
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import SearchProblem
from sl_nerfstudio.geometry.devices import PARAMETERS, Device, Intrinsics
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.parallel import results
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, lattice_step
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, relative_pose_near

_FEWEST = 2  # frames that a registration may join
_REGISTERED_SIDE = 240  # pixels along the longer side of an image that are used to register surfaces
_REGISTERED_PIXELS = 300  # decoded pixels that a frame must have for its surface to be registered


def registered_start(problem: SearchProblem, refine: RefinePoses, beside: Rig, known: Sequence[int]) -> Rig | None:
    """A rig with frames where the registration of their surfaces puts them; None if it joins too few.

    `known` frames of the rig `beside` give the axes and the scale; the others may be anywhere. A frame that was not
    joined stays where it is there. Projectors move only where they are free.
    """
    start = problem.start
    clouds = [c for c in results([partial(_cloud, problem, k) for k in range(start.frames)]) if c is not None]
    frame = np.array([int(c.name) for c in clouds])
    if len(clouds) < _FEWEST:
        return None
    roughly = start.T_world_camera.numpy()[frame]
    roughly[~np.isin(frame, list(known))] = np.nan
    found = register(clouds, False, problem.settings.seed, roughly)
    joined = np.flatnonzero(found.registered)
    common = np.isin(frame[joined], list(known))
    if common.sum() < _FEWEST:
        return None
    cameras, relative = found.T_world_camera[joined], np.stack([clouds[k].pose.T_camera_projector for k in joined])
    relative[:, :3, 3] *= found.baseline[joined, None]
    reference = _frames(beside, frame[joined][common])
    same = replace(reference, **_poses(cameras[common], relative[common]))
    scale = baseline_scale(reference, same, None)
    S = alignment(reference, same, scale) @ Similarity.scaling(scale)
    camera, projector = beside.T_world_camera.numpy().copy(), beside.T_camera_projector.numpy().copy()
    camera[frame[joined]] = S.poses(cameras)
    if refine == "free":
        relative[:, :3, 3] *= scale
        projector[frame[joined]] = relative
    return replace(beside, **_poses(camera, projector))


def _poses(camera: Float64[ndarray, "n 4 4"], relative: Float64[ndarray, "n 4 4"]) -> dict[str, Tensor]:
    return {"T_world_camera": torch.from_numpy(camera), "T_camera_projector": torch.from_numpy(relative)}


def _frames(rig: Rig, index: Int64[ndarray, "n"]) -> Rig:
    chosen = torch.from_numpy(index)
    return Rig(rig.camera[chosen], rig.projector, rig.T_world_camera[chosen], rig.T_camera_projector[chosen])


def _cloud(problem: SearchProblem, k: int) -> FrameCloud | None:
    """The surface of one frame, named by its number; None where too little of it was decoded."""
    rig = problem.start
    coords = _thinned(problem.maps.image(k).numpy())
    uv_camera, uv_projector = correspondences_of(coords)
    if len(uv_camera) < _REGISTERED_PIXELS:
        return None
    h, w = coords.shape[:2]
    lit = np.ceil(uv_projector.max(0)).astype(int)  # the part of the pattern that matters
    devices = _device(rig.camera[k], w, h), _device(rig.projector, int(lit[0]), int(lit[1]))
    try:
        pose = relative_pose_near(rig.T_camera_projector[k].numpy(), uv_camera, uv_projector, *devices)
        return frame_cloud(str(k), coords, *devices, pose)
    except RelativePoseError:  # hardly any coordinate agrees with a pose near the stated one
        return None


def _thinned(image: ndarray) -> Float32[ndarray, "h w 2"]:
    """Keep every n-th decoded pixel of an image that is much larger than surfaces are compared at."""
    used = lattice_step(*image.shape[:2])  # correspondences are taken there only: a multiple loses none of the kept
    step = used * max(round(max(image.shape[:2]) / (used * _REGISTERED_SIDE)), 1)
    kept = np.full_like(image, np.nan, dtype=np.float32)
    kept[::step, ::step] = image[::step, ::step]
    return kept


def _device(intrinsics: Intrinsics, w: int, h: int) -> Device:
    values = dict(zip(PARAMETERS, intrinsics.params.tolist(), strict=True))
    return Device(w, h, **values, model=intrinsics.model)
