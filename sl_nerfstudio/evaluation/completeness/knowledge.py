"""How well each place of a surface is known from the frames that see it, and what one more frame would add.

A place of the surface that no frame sees may lie anywhere within the size of the opening; a frame that sees it
determines it to the decoding noise, divided by the pattern pixels per length along its ray. Information (1 / variance)
adds up.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from sl_nerfstudio.evaluation.completeness.openings import Openings
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.observed import faces_and_falls_inside
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.se3 import inverse, transform

_LEAST_COSINE = 0.2  # between normal and ray of either device: what is seen at a flatter angle is hardly decoded
_SEED = 0


@dataclass(frozen=True)
class View:
    """A camera with its projector, anywhere."""

    camera: Device
    T_world_camera: Float[ndarray, "4 4"]
    projector: Device
    T_world_projector: Float[ndarray, "4 4"]


@dataclass(frozen=True)
class Places:
    """Points spread evenly over a surface and over what closes its openings."""

    points: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]
    area: Float[ndarray, "n"]  # that each point stands for
    doubt: Float[ndarray, "n"]  # 1 sigma of a place that no frame sees: the size of its opening, or of the surface
    opening: Int[ndarray, "n"]  # number of the opening, -1 on the surface


class Occluders:
    """The surface and what closes its openings: whoever looks through an opening sees no inner side."""

    def __init__(self, surface: IndexedMesh, openings: Openings) -> None:
        self._meshes = [surface]
        if len(openings.fan):
            self._meshes.append(IndexedMesh(openings.closing_mesh()))

    def hides(self, points: Float[ndarray, "n 3"], eye: Float[ndarray, "3"]) -> Bool[ndarray, "n"]:
        """Whether something is between each point and the eye."""
        hidden = np.zeros(len(points), bool)
        for mesh in self._meshes:
            hidden |= mesh.occluded(points, eye)
        return hidden


def places(surface: IndexedMesh, openings: Openings, count: int) -> Places:
    """About `count` places on the surface and as many on its openings."""
    points, normals = surface.sample(count, _SEED)
    area = np.full(count, surface.area / count)
    found = Places(points, normals, area, np.full(count, surface.diagonal), np.full(count, -1))
    wide = openings.area > 0
    if not wide.any():
        return found
    share = np.where(wide[openings.opening], openings.closing_mesh().face_areas(), 0.0)
    rng = np.random.default_rng(_SEED)
    triangle = rng.choice(len(share), count, p=share / share.sum())
    weights = rng.dirichlet(np.ones(3), count)
    where = np.einsum("nk,nkd->nd", weights, openings.fan[triangle])
    opening = openings.opening[triangle]
    per_opening = np.maximum(np.bincount(opening, minlength=len(openings)), 1)
    return Places(
        np.concatenate([points, where]),
        np.concatenate([normals, openings.normal[opening]]),
        np.concatenate([area, (openings.area / per_opening)[opening]]),
        np.concatenate([found.doubt, np.sqrt(openings.area / np.pi)[opening]]),
        np.concatenate([found.opening, opening]),
    )


def information(at: Places, occluders: Occluders, view: View, noise_px: float) -> Float[ndarray, "n"]:
    """What a view adds to the knowledge of each place along its normal, 1 / length^2; 0 where it does not see it."""
    index = np.arange(len(at.points))
    for device, T in ((view.camera, view.T_world_camera), (view.projector, view.T_world_projector)):
        inside = faces_and_falls_inside(at.points[index], at.normals[index], device, T)
        index = index[inside & (_cosine(at.points[index], at.normals[index], T) > _LEAST_COSINE)]
    for T in (view.T_world_camera, view.T_world_projector):
        index = index[~occluders.hides(at.points[index], T[:3, 3])]
    out = np.zeros(len(at.points))
    cosine = _cosine(at.points[index], at.normals[index], view.T_world_camera)
    out[index] = cosine * (_pattern_px_per_length(at.points[index], view) / noise_px) ** 2
    return out


def known(at: Places, occluders: Occluders, views: Sequence[View], noise_px: float) -> Float[ndarray, "n"]:
    """Information about each place from all views and from the size of what is not seen."""
    total = 1 / at.doubt**2
    for view in views:
        total = total + information(at, occluders, view, noise_px)
    return total


def _pattern_px_per_length(points: Float[ndarray, "n 3"], view: View) -> Float[ndarray, "n"]:
    """How far the pattern moves under a point that moves along its camera ray."""
    eye = view.T_world_camera[:3, 3]
    step = 1e-4 * (points - eye)
    uv = [_project(points + side * step, view) for side in (-0.5, 0.5)]
    return np.linalg.norm(uv[1] - uv[0], axis=1) / np.linalg.norm(step, axis=1)


def _project(points: Float[ndarray, "n 3"], view: View) -> Float[ndarray, "n 2"]:
    T = inverse(torch.as_tensor(view.T_world_projector, dtype=torch.float64))
    return project(Intrinsics.of(view.projector, torch.float64), transform(T, torch.from_numpy(points)))[0].numpy()


def _cosine(
    points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], T: Float[ndarray, "4 4"]
) -> Float[ndarray, "n"]:
    way = T[:3, 3] - points
    return (way * normals).sum(1) / np.maximum(np.linalg.norm(way, axis=1), 1e-300)
