"""Distances between points of the surface, with their uncertainty."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.meshing.length_uncertainty import length_sigma
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_quality import VertexQuality
from sl_nerfstudio.scan import Scan

_OFF_SURFACE = 0.02  # of the mesh's diagonal: a point that is farther away was not meant to be on this mesh
_TYPICAL, _LONG = 400, 0.3  # how many distances say what is typical, and the shortest one, of the mesh's diagonal
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_POINT = rf"{_NUMBER},{_NUMBER},{_NUMBER}"


@dataclass(frozen=True)
class PointPair:
    """Two points in the mesh's unit and axes, and a name for the distance between them."""

    name: str
    p: tuple[float, float, float]
    q: tuple[float, float, float]


@dataclass(frozen=True)
class Length:
    """A distance between two points on the surface, in the scan's unit."""

    name: str
    p: tuple[float, float, float]  # on the surface, nearest to what was given
    q: tuple[float, float, float]
    length: float
    sigma: float | None  # 1 sigma; None if it is not known
    sigma_shared: float | None  # the part from poses and intrinsics
    sigma_independent: float | None  # the part from decoding noise
    views: tuple[int, int] | None  # frames that confirm each end; None if the mesh does not say


def parse_pair(text: str, where: str) -> PointPair:
    """A pair from "x,y,z x,y,z", with "name:" before it if wanted. Raises UserError; `where` is the flag or line."""
    name, colon, rest = text.rpartition(":")
    found = re.fullmatch(rf"\s*({_POINT})\s+({_POINT})\s*", rest)
    if found is None or (colon and not name.strip()):
        raise UserError(
            f"{where}: {text.strip()!r:.100} is not two points\n"
            '    remedy: give x,y,z of both, in the unit and axes of the mesh: "12.5,-3,40 10,2,38", or '
            '"handle: 12.5,-3,40 10,2,38"'
        )
    p, q = (_triple(np.array(point.split(","), dtype=np.float64)) for point in found.groups())
    return PointPair(name.strip() or f"{found[1]} to {found[2]}", p, q)


def read_pairs(path: Path) -> list[PointPair]:
    """The pairs of a text file, one a line; empty lines and those that begin with # count as nothing."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"--distances {path}: cannot be read ({first_line(error)})\n"
            "    remedy: give a text file with a line such as `handle: 12.5,-3,40 10,2,38` for each distance"
        ) from error
    kept = [
        (number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")
    ]
    if not kept:
        raise UserError(f"--distances {path}: holds no distances\n    remedy: give a line `name: x,y,z x,y,z` for each")
    return [parse_pair(line, f"{path}, line {number}") for number, line in kept]


def measure_lengths(
    pairs: Sequence[PointPair],
    mesh: Mesh,
    quality: VertexQuality | None,
    scan: Scan,
    poses: DevicePoses,
    joint: JointCovariance | None,
) -> list[Length]:
    """The distances between the surface points nearest to each pair; sigma needs `quality` and `joint`.

    Raises UserError for a point that is far from the surface, or where both are the same point.
    """
    if not pairs:
        return []
    surface = IndexedMesh(mesh)
    given = np.array([[pair.p, pair.q] for pair in pairs])
    near = surface.closest(given.reshape(-1, 3))
    for k, away in enumerate(near.distance):
        if away > _OFF_SURFACE * surface.diagonal:
            raise UserError(_off_surface(pairs[k // 2], given[k // 2, k % 2], float(away), surface, scan.units))
    ends = near.point.reshape(-1, 2, 3)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    for pair, length in zip(pairs, lengths, strict=True):
        if not length > 0:
            raise UserError(f"--distance {pair.name}: both points are the same\n    remedy: give two points")
    used = np.unique(mesh.faces)
    vertices = used[np.asarray(KDTree(mesh.vertices[used]).query(near.point)[1]).reshape(-1, 2)]
    shared = independent = np.full(len(pairs), np.nan)
    if quality is not None and joint is not None:
        found = length_sigma(mesh, quality.sigma_independent, vertices, scan, poses, joint)
        shared, independent = found.shared, found.independent
    views = None if quality is None else quality.views[vertices]
    return [
        Length(
            pair.name,
            _triple(ends[k, 0]),
            _triple(ends[k, 1]),
            float(lengths[k]),
            _known(float(np.hypot(shared[k], independent[k]))),
            _known(float(shared[k])),
            _known(float(independent[k])),
            None if views is None else (int(views[k, 0]), int(views[k, 1])),
        )
        for k, pair in enumerate(pairs)
    ]


def typical_sigma(
    mesh: Mesh, quality: VertexQuality | None, scan: Scan, poses: DevicePoses, joint: JointCovariance | None
) -> float | None:
    """Median 1 sigma of distances across the surface, as a share of their length; None if it is not known."""
    seen = np.flatnonzero(quality.views > 0) if quality is not None else np.empty(0)
    if quality is None or joint is None or len(seen) < 2:
        return None
    ends = np.random.default_rng(0).choice(seen, (_TYPICAL, 2))
    length = np.linalg.norm(mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]], axis=1)
    lower, upper = mesh.bounds()
    long = length > _LONG * float(np.linalg.norm(upper - lower))
    if not long.any():
        return None
    found = length_sigma(mesh, quality.sigma_independent, ends[long], scan, poses, joint)
    return _known(float(np.nanmedian(np.hypot(found.shared, found.independent) / length[long])))


def _triple(p: Float[ndarray, "3"]) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), float(p[2])


def _known(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _off_surface(pair: PointPair, point: Float[ndarray, "3"], away: float, surface: IndexedMesh, units: str) -> str:
    at = ",".join(f"{v:g}" for v in point)
    low, high = (",".join(f"{v:.4g}" for v in corner) for corner in (surface.lower, surface.upper))
    return (
        f"--distance {pair.name}: {at} is {away:.4g} away from the surface (unit: {units})\n"
        f"    cause:  the point is in other axes or another unit; the mesh reaches from {low} to {high}\n"
        "    remedy: pick both points on the mesh itself, in a viewer that shows its coordinates"
    )
