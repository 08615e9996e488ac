"""The surface of a trained run, as an export wants it: observed, filled, cut out, or closed."""

import time
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.finishing.closed_field import ClosedField, hull_planes
from sl_nerfstudio.meshing.finishing.fill_holes import FilledHoles, fill_holes
from sl_nerfstudio.meshing.finishing.marked import MarkedMesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.trim import Trimmed, trim_to_observed
from sl_nerfstudio.runs.export_settings import ExportSettings
from sl_nerfstudio.runs.object_cut import ObjectCut, cut_object, object_cut, planes_below, separate_scan
from sl_nerfstudio.runs.trained_run import TrainedModel

_SAME = 0.01  # of an edge: vertices of two extractions that are so near are the same one


@dataclass(frozen=True)
class Surface:
    """The surface in the scan's world and unit, and what became of the whole zero level."""

    marked: MarkedMesh
    trimmed: Trimmed | None  # None: nothing was compared with the frames
    filled: FilledHoles | None  # None: holes were left open
    cut: ObjectCut | None  # None: surroundings were not looked for
    other_pieces: int  # that were removed for not being the largest one
    extraction_seconds: float


def build_surface(model: TrainedModel, settings: ExportSettings) -> Surface:
    """Extract the zero level, and keep of it what the settings say.

    Raises UserError if there is no surface, or if no part of it was observed.
    """
    surface = _solid(model, settings) if settings.watertight else _open_surface(model, settings)
    if not settings.largest_component:
        return surface
    pieces = int(surface.marked.mesh.component_of_faces().max(initial=-1)) + 1
    return replace(surface, marked=surface.marked.largest_component(), other_pieces=pieces - 1)


def _open_surface(model: TrainedModel, settings: ExportSettings) -> Surface:
    start, world = time.perf_counter(), model.S_scene_world.inverse()
    whole = extract_mesh(model.sdf, settings.resolution, device=model.device).mapped(world)
    seconds = time.perf_counter() - start
    trimmed = filled = cut = None
    marked = MarkedMesh(whole, np.zeros(len(whole.vertices), dtype=bool))
    if not settings.keep_unobserved:
        trimmed = trim_to_observed(whole, model.scan, model.poses())
        if settings.largest_hole is not None:
            filled = fill_holes(whole, trimmed, settings.largest_hole)
        marked = MarkedMesh(whole, ~trimmed.observed).with_faces(trimmed.kept if filled is None else filled.kept)
    if settings.object_only:
        cut = cut_object(marked.mesh, separate_scan(model.scan, model.poses()))
        marked = marked.with_faces(cut.kept)
    return Surface(marked, trimmed, filled, cut, 0, seconds)


def _solid(model: TrainedModel, settings: ExportSettings) -> Surface:
    """Closed pieces of the zero level, in each of which frames observed something.

    What nobody observed is cut off flat where it leaves the convex hull of what was observed, the planes around the
    object, or the box of the field: there the field knows nothing, and bulges.
    """
    scan, poses, world = model.scan, model.poses(), model.S_scene_world.inverse()
    start = time.perf_counter()
    whole = extract_mesh(model.sdf, settings.resolution, device=model.device).mapped(world)
    first = time.perf_counter() - start
    trimmed = trim_to_observed(whole, scan, poses)
    real = trimmed.observed & whole.corners_of(trimmed.kept)
    planes, found = [], separate_scan(scan, poses) if settings.object_only else None
    if found is not None:
        real &= found.keeps(whole.vertices)
        planes = planes_below(found, model.S_scene_world)
    planes += hull_planes(model.S_scene_world.points(whole.vertices[real]), 2 / settings.resolution)
    start = time.perf_counter()
    field = ClosedField(model.sdf, planes, model.device)
    solid = extract_mesh(field, settings.resolution, device=model.device).mapped(world)
    second = time.perf_counter() - start
    observed = _same_vertices(solid, whole, real)
    kept = _pieces_with(solid, observed[solid.faces].all(1))
    cut = None if found is None else object_cut(solid, found, kept)
    return Surface(MarkedMesh(solid, ~observed).with_faces(kept), trimmed, None, cut, 0, first + second)


def _same_vertices(mesh: Mesh, other: Mesh, chosen: Bool[ndarray, "w"]) -> Bool[ndarray, "v"]:
    """Vertices of a mesh that are also chosen vertices of another one, extracted on the same grid."""
    if not chosen.any():
        return np.zeros(len(mesh.vertices), dtype=bool)
    distance, _ = KDTree(other.vertices[chosen]).query(mesh.vertices)
    return np.asarray(distance < _SAME * other.edge_length())


def _pieces_with(mesh: Mesh, chosen: Bool[ndarray, "f"]) -> Bool[ndarray, "f"]:
    """All triangles of the connected pieces that have some of the chosen ones."""
    piece = mesh.component_of_faces()
    return np.bincount(piece, chosen.astype(float))[piece] > 0
