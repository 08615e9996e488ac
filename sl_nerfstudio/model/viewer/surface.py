"""The surface of the field as a mesh for the viewer, and what it can be coloured by."""

from dataclasses import dataclass
from functools import cached_property

import matplotlib
import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.geometry.se3 import inverse, transform
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_quality import VertexQuality
from sl_nerfstudio.meshing.vertex_uncertainty import vertex_uncertainty
from sl_nerfstudio.model.outputs import coordinate_colours
from sl_nerfstudio.model.viewer.viewed_model import ViewedModel

RENDERED = "as rendered"
MODES = (RENDERED, "normals", "depth", "coordinates", "residual", "sigma", "views")
RESOLUTION = 128  # cells along the scene's box: about a second
UNKNOWN = (110, 110, 110)  # colour where a value does not exist


@dataclass(frozen=True)
class Coloured:
    """Colours of the vertices, and what they mean."""

    rgb: UInt8[ndarray, "v 3"]
    meaning: str
    scale: tuple[str, float, float, str] | None = None  # matplotlib's colour map, values at its ends, their unit


class Surface:
    """The zero level of a model's field at one step; lengths in the scene, values in the scan's unit."""

    def __init__(self, model: ViewedModel, resolution: int = RESOLUTION) -> None:
        """Raises UserError if there is no surface."""
        self._model = model
        self.step = model.step
        self.mesh: Mesh = extract_mesh(model.sdf, resolution, device=model.device)

    @cached_property
    def quality(self) -> VertexQuality:
        """What is known of each vertex, in the scan's unit: it needs the coordinates of all frames, so some seconds."""
        model = self._model
        world = self.mesh.mapped(model.S_scene_world.inverse())
        return vertex_uncertainty(world, model.scan, model.poses(), model.joint_covariance(), model.cell)

    def coloured(self, mode: str, frame: int) -> Coloured:
        """The colours of one of `MODES`; `frame` is the one whose devices depth and coordinates are of."""
        units = self._model.scan.units
        if mode == "normals":
            rgb = 0.5 * self.mesh.vertex_normals() + 0.5
            return Coloured(_bytes(rgb), "Direction of the surface: red is x, green y, blue z.")
        if mode == "depth":
            return self._depth(frame, units)
        if mode == "coordinates":
            return self._coordinates(frame)
        of = f"Grey: no frame confirms the surface there. Step {self.step}."
        if mode == "residual":
            said = f"Mean distance of predicted and decoded coordinates. {of}"
            return _scaled(self.quality.residual, "inferno", "pattern px", said)
        if mode == "sigma":
            return _scaled(self.quality.sigma, "inferno", units, f"Uncertainty along the normal, 1 sigma. {of}")
        views = self.quality.views.astype(np.float64)
        said = f"Frames that saw, lit and confirmed it. {of}"
        return _scaled(np.where(views > 0, views, np.nan), "viridis", "frames", said, percentile=100.0)

    def _depth(self, frame: int, units: str) -> Coloured:
        T_scene_camera = self._model.poses_scene()[0][frame].double().cpu().numpy()
        distance = np.linalg.norm(self.mesh.vertices - T_scene_camera[:3, 3], axis=1)
        world = distance / self._model.S_scene_world.scale
        scale = ("turbo", float(world.min()), float(world.max()), units)
        return Coloured(_mapped(world, scale), f"Distance from the camera of frame {frame}.", scale)

    def _coordinates(self, frame: int) -> Coloured:
        T_projector_scene = inverse(self._model.poses_scene()[1][frame].double().cpu())
        projector = self._model.scan.projector
        p = transform(T_projector_scene, torch.from_numpy(self.mesh.vertices))
        uv, in_front = project(Intrinsics.of(projector, torch.float64), p)
        normals = torch.from_numpy(self.mesh.vertex_normals()) @ T_projector_scene[:3, :3].T
        inside = ((uv >= 0) & (uv <= torch.tensor([projector.w, projector.h]))).all(-1)
        lit = in_front & inside & ((normals * p).sum(-1) < 0)
        rgb = coordinate_colours(torch.where(lit[:, None], uv, 0.0), lit)
        meaning = f"Pattern coordinates of the projector of frame {frame}, modulo 128: x is red, y green."
        return Coloured(_bytes(rgb.numpy(), lit.numpy()), meaning)


def _scaled(
    values: Float64[ndarray, "v"], colours: str, units: str, meaning: str, percentile: float = 95.0
) -> Coloured:
    """Colours from 0 to a percentile of the values."""
    known = values[np.isfinite(values)]
    limit = float(np.percentile(known, percentile)) if len(known) else 1.0
    scale = (colours, 0.0, limit or 1.0, units)
    return Coloured(_mapped(values, scale), meaning, scale)


def _mapped(values: Float64[ndarray, "v"], scale: tuple[str, float, float, str]) -> UInt8[ndarray, "v 3"]:
    colours, lower, upper, _ = scale
    share = np.clip((np.nan_to_num(values) - lower) / max(upper - lower, 1e-12), 0, 1)
    return _bytes(np.asarray(matplotlib.colormaps[colours](share))[:, :3], np.isfinite(values))


def _bytes(rgb: Float64[ndarray, "v 3"], known: Bool[ndarray, "v"] | None = None) -> UInt8[ndarray, "v 3"]:
    out = np.rint(255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    if known is not None:
        out[~known] = UNKNOWN
    return out
