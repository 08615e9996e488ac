"""Planes, cylinders and spheres fitted to picked regions of a surface, with their uncertainty.

A shape minimises its robustly weighted distances from the vertices of the region. Two kinds of errors make it
uncertain. Those of neighbouring vertices are alike, over a distance that nobody states: their effect is summed over
cells of the region, not over vertices, and of several sizes of cells the one counts that gives the largest sigma. Those
of poses and intrinsics move the whole surface: they follow from the joint covariance.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import NUMBER, POINT
from sl_nerfstudio.geometry.least_squares import NormalEquations, minimise
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.uncertainty import point_changes, views_by_frame
from sl_nerfstudio.scan import Scan

ShapeKind = Literal["plane", "cylinder", "sphere"]
_UNKNOWNS = {"plane": 3, "cylinder": 5, "sphere": 4}
_FEWEST = 30  # vertices
_CELLS = (1 / 5, 1 / 3, 1 / 2, 2 / 3)  # of a region's radius: sizes of cells within which errors may be alike
_SHARED = 300  # vertices whose shared errors are propagated
_REWEIGHTED = 6  # times
_TUKEY = 4.685  # of the robust sigma
_EXACT = 1e-9  # of the region: smaller distances are rounding
_LARGEST_RADIUS = 50.0  # of the region's radius: what is flatter has no measurable radius
_REGION = re.compile(rf"\s*(\w+)\s+({POINT})\s+({NUMBER})\s*")


@dataclass(frozen=True)
class PickedRegion:
    """The surface within a distance of a point, in the mesh's unit and axes, and the shape that it should have."""

    name: str
    kind: ShapeKind
    point: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class FittedShape:
    """A shape in the mesh's unit and axes; sigmas are 1 sigma, those of poses and intrinsics included where known."""

    region: PickedRegion
    point: tuple[float, float, float]  # centre; of a cylinder the point of the axis nearest to the picked one
    direction: tuple[float, float, float] | None  # normal, outwards, or axis; None for a sphere
    radius: float | None  # None for a plane
    sigma_point: float  # of its position: along the normal, across the axis, in any direction
    sigma_direction_deg: float | None
    sigma_radius: float | None
    shared: bool  # whether errors of poses and intrinsics are included in that of the radius
    rms: float  # of the distances that count
    vertices: int
    rejected: float  # share of the region that does not belong to the shape


def parse_region(text: str) -> PickedRegion:
    """A region from "cylinder 12.5,-3,40 8", with "name:" before it if wanted. Raises UserError."""
    name, colon, rest = text.rpartition(":")
    found = _REGION.fullmatch(rest)
    if found is None or found[1] not in _UNKNOWNS or not float(found[3]) > 0 or (colon and not name.strip()):
        raise UserError(
            f"--fit: {text.strip()!r:.100} is no region\n"
            "    cause:  a typing error\n"
            f"    remedy: give a shape ({', '.join(get_args(ShapeKind))}), a point x,y,z on the surface and how far "
            "the region reaches, in the unit\n            of the mesh: "
            '"cylinder 12.5,-3,40 8", or "bore: cylinder 12.5,-3,40 8"'
        )
    kind: ShapeKind = found[1]  # type: ignore[assignment]
    x, y, z = map(float, found[2].split(","))
    return PickedRegion(name.strip() or kind, kind, (x, y, z), float(found[3]))


def fit_shape(
    region: PickedRegion,
    mesh: Mesh,
    scan: Scan | None = None,
    poses: DevicePoses | None = None,
    joint: JointCovariance | None = None,
) -> FittedShape:
    """Fit the shape of a region of a mesh.

    With a scan, the poses from which it was reconstructed and their joint covariance, the sigma of the radius includes
    errors of poses and intrinsics. Raises UserError if the region holds too little surface, or has no such radius.
    """
    used = np.unique(mesh.faces)
    chosen = np.sort(used[KDTree(mesh.vertices[used]).query_ball_point(region.point, region.radius)])
    if len(chosen) < _FEWEST:
        low, high = (",".join(f"{v:.4g}" for v in corner) for corner in mesh.bounds())
        raise UserError(
            f"--fit {region.name}: {len(chosen)} vertices lie within {region.radius:g} of "
            f"{','.join(f'{v:g}' for v in region.point)}, a fit needs {_FEWEST}\n"
            f"    cause:  the point is not on the surface (it reaches from {low} to {high}), or the region is small\n"
            "    remedy: pick the point on the mesh in a viewer, give a larger region, or a finer mesh"
        )
    points, normals = mesh.vertices[chosen], mesh.vertex_normals()[chosen]
    state, weights = _fitted(region.kind, points, normals)
    r, J = _residuals(region.kind, state, points)
    equations = NormalEquations.of(J, r, weights)
    try:
        inverse = equations.covariance()
    except np.linalg.LinAlgError:
        inverse = np.full((J.shape[1],) * 2, np.nan)
    radius = None if region.kind == "plane" else float(state[6])
    spread = float(np.linalg.norm(points - points.mean(0), axis=1).max())
    if not np.isfinite(inverse).all() or (radius is not None and abs(radius) > _LARGEST_RADIUS * spread):
        raise UserError(
            f"--fit {region.name}: the surface there is no {region.kind}\n"
            "    cause:  it is flat, or bends in another way\n"
            "    remedy: fit a plane, or pick a region that shows more of the curved surface"
        )
    change = inverse @ (J * (weights * r)[:, None]).T
    sigma = np.max([_sigma_by_cells(change, points, share * region.radius) for share in _CELLS], axis=0)
    shared = None
    if radius is not None and scan is not None and poses is not None and joint is not None:
        shared = _shared_radius(mesh, chosen, normals, inverse @ (J * weights[:, None]).T, scan, poses, joint)
    return _described(region, state, sigma, shared, points, normals, weights, r)


# The shapes: a state is a point, a unit direction and a radius, and increments move it within its own unknowns.

State = Float64[ndarray, "7"]


def _frame_of(direction: Float64[ndarray, "3"]) -> Float64[ndarray, "2 3"]:
    """Two unit vectors across a direction."""
    first = np.cross(direction, np.eye(3)[int(np.abs(direction).argmin())])
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _residuals(
    kind: ShapeKind, state: State, points: Float64[ndarray, "n 3"]
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n k"]]:
    """Signed distances from a shape, and their derivatives by its increments."""
    offset, axis, radius = points - state[:3], state[3:6], state[6]
    across = _frame_of(axis)
    if kind == "plane":
        return offset @ axis, np.column_stack([-np.ones(len(points)), offset @ across.T])
    if kind == "cylinder":
        along = offset @ axis
        offset = offset - along[:, None] * axis
    length = np.maximum(np.linalg.norm(offset, axis=1), 1e-300)
    unit = offset / length[:, None]
    if kind == "sphere":
        return length - radius, np.column_stack([-unit, -np.ones(len(points))])
    side = unit @ across.T
    return length - radius, np.column_stack([-side, -along[:, None] * side, -np.ones(len(points))])


def _moved(kind: ShapeKind, state: State, step: Float64[ndarray, "k"]) -> State:
    point, axis, radius = state[:3], state[3:6], state[6]
    across = _frame_of(axis)
    if kind == "plane":
        point, tilt = point + step[0] * axis, step[1:3]
    elif kind == "sphere":
        return np.concatenate([point + step[:3], axis, [radius + step[3]]])
    else:
        point, tilt, radius = point + step[:2] @ across, step[2:4], radius + step[4]
    axis = axis + tilt @ across
    return np.concatenate([point, axis / np.linalg.norm(axis), [radius]])


def _starts(kind: ShapeKind, points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"]) -> list[State]:
    """Where searches begin."""
    centre = points.mean(0)
    if kind == "plane":
        return [np.concatenate([centre, np.linalg.svd(points - centre, full_matrices=False)[2][2], [0.0]])]
    if kind == "sphere":
        c, radius = _circle(points - centre)
        return [np.concatenate([centre + c, [0.0, 0.0, 1.0], [radius]])]
    states = []
    for axis in np.linalg.eigh(normals.T @ normals)[1].T:
        across = _frame_of(axis)
        c, radius = _circle((points - centre) @ across.T)
        states.append(np.concatenate([centre + c @ across, axis, [radius]]))
    return states


def _circle(offset: Float64[ndarray, "n k"]) -> tuple[Float64[ndarray, "k"], float]:
    """Centre and radius of the circle or sphere nearest to points, in squares: |p|^2 = 2 c.p + r^2 - |c|^2."""
    x = np.linalg.lstsq(np.column_stack([2 * offset, np.ones(len(offset))]), (offset**2).sum(1), rcond=None)[0]
    return x[:-1], float(np.sqrt(max(x[-1] + x[:-1] @ x[:-1], 0.0)))


def _fitted(
    kind: ShapeKind, points: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"]
) -> tuple[State, Float64[ndarray, "n"]]:
    """The best state, and the robust weights of the points."""
    ends = []
    for state in _starts(kind, points, normals):
        weights = np.ones(len(points))
        for _ in range(_REWEIGHTED):
            state = minimise(state, *_problem(kind, points, weights)).state
            r = _residuals(kind, state, points)[0]
            spread = MAD_TO_SIGMA * float(np.median(np.abs(r)))
            spread = max(spread, _EXACT * float(np.abs(points - state[:3]).max()))
            weights = np.maximum(1 - (r / (_TUKEY * spread)) ** 2, 0.0) ** 2
        ends.append((float(np.median(np.abs(_residuals(kind, state, points)[0]))), state, weights))
    _, state, weights = min(ends, key=lambda end: end[0])
    return state, weights


def _problem(
    kind: ShapeKind, points: Float64[ndarray, "n 3"], weights: Float64[ndarray, "n"]
) -> tuple[Callable[[State], NormalEquations], Callable[[State, ndarray], State], Callable[[State], float]]:
    """Equations, increments and cost of a weighted fit."""

    def equations(state: State) -> NormalEquations:
        r, J = _residuals(kind, state, points)
        return NormalEquations.of(J, r, weights)

    def cost(state: State) -> float:
        return float(weights @ _residuals(kind, state, points)[0] ** 2) / 2

    return equations, lambda state, step: _moved(kind, state, step), cost


# Uncertainty.


def _sigma_by_cells(
    change: Float64[ndarray, "k n"], points: Float64[ndarray, "n 3"], side: float
) -> Float64[ndarray, "k"]:
    """1 sigma of increments to which every point contributes, if errors are alike in cells and independent between."""
    cell = np.floor((points - points.mean(0)) / side).astype(np.int64)
    _, number = np.unique(cell, axis=0, return_inverse=True)
    number = number.reshape(-1)
    sums = np.stack([np.bincount(number, row) for row in change])
    count = sums.shape[1]
    return np.sqrt((sums**2).sum(1) * count / max(count - len(change), 1))


def _shared_radius(
    mesh: Mesh,
    chosen: Int64[ndarray, "n"],
    normals: Float64[ndarray, "n 3"],
    gain: Float64[ndarray, "k n"],
    scan: Scan,
    poses: DevicePoses,
    joint: JointCovariance,
) -> float | None:
    """1 sigma of the radius from errors of poses and intrinsics; `gain`: increments by distances of the vertices."""
    some = np.unique(np.linspace(0, len(chosen) - 1, min(_SHARED, len(chosen))).astype(int))
    vertices = chosen[some]
    views = list(views_by_frame(mesh, scan, poses, vertices, "uncertainty of shapes"))
    moved = point_changes(mesh, scan, poses, views, vertices, joint.factor)
    along = np.einsum("ni,nik->nk", normals[some], moved)
    seen = np.isfinite(along).all(1)
    if not seen.any():
        return None
    # The chosen ones stand for all: a common shift of all vertices along their normals must have its whole effect.
    weight = gain[-1, some][seen]
    weight = weight * gain[-1].sum() / weight.sum()
    return float(np.linalg.norm(weight @ along[seen]))


def _described(
    region: PickedRegion,
    state: State,
    sigma: Float64[ndarray, "k"],
    shared: float | None,
    points: Float64[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    weights: Float64[ndarray, "n"],
    r: Float64[ndarray, "n"],
) -> FittedShape:
    point, direction, kind = state[:3], state[3:6], region.kind
    if kind == "plane" and direction @ normals.sum(0) < 0:
        direction = -direction
    places = {"plane": sigma[:1], "cylinder": sigma[:2], "sphere": sigma[:3]}[kind]
    tilts = {"plane": sigma[1:3], "cylinder": sigma[2:4], "sphere": None}[kind]
    if kind == "cylinder":
        point = point + ((np.array(region.point) - point) @ direction) * direction
    x, y, z = point.tolist()
    a, b, c = (direction + 0.0).tolist()
    return FittedShape(
        region,
        (x, y, z),
        None if kind == "sphere" else (a, b, c),
        None if kind == "plane" else float(state[6]),
        float(np.linalg.norm(places)),
        None if tilts is None else float(np.degrees(np.linalg.norm(tilts))),
        None if kind == "plane" else float(np.hypot(sigma[-1], shared or 0.0)),
        shared is not None,
        float(np.sqrt(weights @ r**2 / weights.sum())),
        len(points),
        float((weights == 0).mean()),
    )
