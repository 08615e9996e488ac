"""What is wrong with a mesh as such: triangles turned over, other axes or another unit, loose pieces.

A mesh of another program says nothing of its axes, and may have been turned, scaled or oriented on its way. Points
that the frames measured, each on its own camera ray, say where the surface is and from which side it was seen.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.console import figure, unit_word
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.lie import AXIS_TURNS, DevicePoses, axis_words
from sl_nerfstudio.geometry.numerics import component_labels, evenly_spaced
from sl_nerfstudio.geometry.triangulation import pixel_rays
from sl_nerfstudio.review.agreement import triangulate_some
from sl_nerfstudio.review.verdict import Reason
from sl_nerfstudio.scan import Scan

_FRAMES, _PIXELS = 24, 2000  # of a scan, and of each frame, that are looked at
_NEAR = 0.01  # of the mesh's diagonal: a ray that meets the surface so near to the measured point confirms it
_TURNED, _ALL_TURNED = 0.05, 0.9  # share of confirmed hits at which triangles show their back
_FEWEST_HITS = 50
_OFF = 0.01  # median distance of measured points from the surface, in diagonals, from which other axes are tried
_EXPLAINS = 0.3  # factor by which other axes must lower it
_UNITS = (1.0, 1e3, 1e-3)  # metres and millimetres mixed up
_LEAST_PIECE = 0.01  # of the diagonal: smaller pieces are crumbs
_LISTED = 3


@dataclass(frozen=True)
class MeshFault:
    """Something that is wrong with the mesh, and what to do about it."""

    reason: Reason
    advice: str


@dataclass(frozen=True)
class _Measured:
    """Points on the camera rays of some pixels, where their coordinates put them."""

    points: Float64[ndarray, "n 3"]
    origin: Float64[ndarray, "n 3"]
    direction: Float64[ndarray, "n 3"]


def find_mesh_faults(surface: IndexedMesh, scan: Scan, poses: DevicePoses) -> tuple[MeshFault, ...]:
    """All faults of a mesh, the most important first; none of a surface that the frames confirm."""
    measured = _measure(scan, poses)
    if len(measured.points) < _FEWEST_HITS:
        return ()
    axes = other_axes(surface, measured.points)
    if axes:
        advice = f"bring the mesh into the axes and the unit of transforms.json: {axes}"
        return (MeshFault(Reason("poor", f"the mesh is in other axes or another unit than the scan: {axes}"), advice),)
    hits = surface.cast(measured.origin, measured.direction)
    away = np.linalg.norm(measured.origin + hits.distance[:, None] * measured.direction - measured.points, axis=1)
    near = hits.hit & (away < _NEAR * surface.diagonal)
    behind = (surface.face_cross[hits.face[near]] * measured.direction[near]).sum(1) > 0
    return (*_turned_over(behind), *_loose(surface, hits.face[hits.hit], hits.face[near], scan.units))


def missed_axes(surface: IndexedMesh, scan: Scan, poses: DevicePoses) -> str:
    """The axes and unit in which a mesh that no ray meets would fit; "" if none are found."""
    return other_axes(surface, _measure(scan, poses).points)


def _measure(scan: Scan, poses: DevicePoses) -> _Measured:
    parts = [[np.zeros((0, 3))] for _ in range(3)]
    for k in evenly_spaced(len(scan.frames), min(_FRAMES, len(scan.frames))).tolist():
        frame, T = scan.frames[k], (poses.T_world_camera[k], poses.T_world_projector[k])
        uv, found = triangulate_some(frame.camera, scan.projector, *T, frame.read_masked_coords(), _PIXELS)
        camera = Intrinsics.of(frame.camera, torch.float64)
        origin, direction = (x.numpy() for x in pixel_rays(camera, torch.from_numpy(T[0]), uv))
        good = (np.isfinite(found.p_world.numpy()).all(1)) & (found.depth_camera.numpy() > 0)
        for part, values in zip(parts, (found.p_world.numpy(), origin, direction), strict=True):
            part.append(np.broadcast_to(values, (len(uv), 3))[good])
    return _Measured(*(np.concatenate(part) for part in parts))


def other_axes(surface: IndexedMesh, points: Float64[ndarray, "n 3"]) -> str:
    """The exchange of axes, and the unit, with which the mesh fits the points far better than as it is; "" if none."""
    if not len(points):
        return ""
    some = points[evenly_spaced(len(points), min(_PIXELS, len(points)))]
    now = float(np.median(surface.distance(some)))
    if now < _OFF * surface.diagonal:
        return ""
    tried = [(float(np.median(surface.distance(some @ R * unit))), words) for R, unit, words in _axes()]
    best, words = min(tried)
    return words if best < min(_EXPLAINS * now, _OFF * surface.diagonal) else ""


def _axes() -> Iterator[tuple[Float64[ndarray, "3 3"], float, str]]:
    """(R, unit, words): points p of the scan are `unit * R^T p` in the mesh."""
    for R, unit in product(AXIS_TURNS, _UNITS):
        if unit == 1.0 and np.allclose(R, np.eye(3)):
            continue
        axes = axis_words(R)
        words = f"x, y, z of the scan are {axes} of the mesh" if axes != "x, y, z" else "its axes fit"
        words += " (y is up in the mesh)" if axes == "x, -z, y" else ""
        yield R, unit, words + (f", and its lengths are {unit:g} times the scan's" if unit != 1.0 else "")


def _turned_over(behind: Bool[ndarray, "n"]) -> Iterator[MeshFault]:
    """Triangles that are seen from behind, of those that are where the frames measured a surface."""
    share = float(behind.mean()) if len(behind) >= _FEWEST_HITS else 0.0
    if share <= _TURNED:
        return
    what = "is inside out" if share > _ALL_TURNED else "is partly inside out"
    yield MeshFault(
        Reason(
            "poor",
            f"the mesh {what}: {share:.0%} of what the frames see of it are triangles seen from behind (they must be "
            "counter-clockwise as seen from outside)",
        ),
        "turn these triangles over, in MeshLab with "
        + ("Invert Faces Orientation" if share > _ALL_TURNED else "Re-Orient All Faces Coherently"),
    )


def _loose(
    surface: IndexedMesh, met: Int64[ndarray, "n"], confirmed: Int64[ndarray, "m"], units: str
) -> Iterator[MeshFault]:
    """Pieces that share no vertex with the rest, and of whose faces that rays met few were confirmed."""
    faces = surface.faces
    label = component_labels(faces[:, :2].ravel(), faces[:, 1:].ravel(), len(surface.vertices))[faces[:, 0]]
    pieces, piece = np.unique(label, return_inverse=True)
    if len(pieces) < 2:
        return
    all_met, right = (np.bincount(piece[face], minlength=len(pieces)) for face in (met, confirmed))
    corners = surface.vertices[faces]
    lost = []
    for k in np.flatnonzero(2 * right <= all_met):
        mine = corners[piece == k].reshape(-1, 3)
        size = float(np.linalg.norm(np.ptp(mine, axis=0)))
        if size > _LEAST_PIECE * surface.diagonal:
            lost.append((size, (mine.min(0) + mine.max(0)) / 2))
    if not lost:
        return
    lost.sort(key=lambda one: -one[0])
    unit = unit_word(units)
    where = "; ".join(
        f"{figure(size)} {unit} large at {', '.join(figure(v) for v in at)}" for size, at in lost[:_LISTED]
    )
    several = len(lost) > 1
    yield MeshFault(
        Reason(
            "acceptable",
            f"{len(lost)} loose piece{'s' if several else ''} of the mesh that no frame confirms: {where}"
            + (f"; and {len(lost) - _LISTED} more" if len(lost) > _LISTED else ""),
        ),
        f"remove {'them' if several else 'it'}: export with --largest-component, or keep the largest piece of another "
        "program's mesh",
    )
