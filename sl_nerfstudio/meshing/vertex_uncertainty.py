"""Uncertainty of every vertex along its normal, by linear propagation.

Near a vertex the surface minimises the residuals of all pixels that see it. So it moves along its normal by
`s = -sum(a . r) / sum(a . a)` when residuals change by r, with a the residuals' slope along the normal. Two kinds of
errors change them. Decoding noise is independent from one vertex to another that is farther away than the field
averages (`sigma_independent`). Errors of poses and intrinsics are shared by the whole surface: their joint covariance
is propagated, less the rigid motion of the whole surface, which changes no shape.
"""

from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.joint_covariance.draws import is_exact
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.meshing.lit_vertices import dot
from sl_nerfstudio.meshing.loops.derivatives import write_rows
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.surface_derivatives import packed_devices
from sl_nerfstudio.meshing.vertex_noise import AVERAGED_CELLS, independent_variance
from sl_nerfstudio.meshing.vertex_quality import VertexQuality
from sl_nerfstudio.meshing.vertex_sums import VertexSums, sum_views
from sl_nerfstudio.meshing.vertex_views import devices_of, views_by_frame
from sl_nerfstudio.scan.types import Scan
from sl_nerfstudio.threads import parallel, results

_TOGETHER = 512  # neighbouring vertices, which mostly the same frames see
_GAUGE_VERTICES = 4000  # of which the rigid motion of the whole surface is fitted


def vertex_uncertainty(
    mesh: Mesh, scan: Scan, poses: DevicePoses, joint: JointCovariance | None, cell: float
) -> VertexQuality:
    """Uncertainty of a mesh in the scan's world.

    `joint` is the covariance of `poses` and intrinsics; None if they are exact. `cell` is the length of the field's
    finest cells.
    """
    count = len(mesh.vertices)
    sums = sum_views(views_by_frame(mesh, scan, poses, None, "uncertainty of the surface"), count)
    independent, seen = independent_variance(mesh, sums, AVERAGED_CELLS * cell**2), sums.number > 0
    shared = np.zeros(count) if joint is None else _shared_variance(mesh, scan, poses, sums, joint)
    return VertexQuality(
        sigma=np.where(seen, np.sqrt(independent + shared), np.nan),
        sigma_independent=np.where(seen, np.sqrt(independent), np.nan),
        views=sums.number,
        residual=np.where(seen, sums.distance / np.maximum(sums.number, 1), np.nan),
        ray_angle=np.degrees(sums.ray_angle),
    )


def _shared_variance(
    mesh: Mesh, scan: Scan, poses: DevicePoses, sums: VertexSums, joint: JointCovariance
) -> Float[ndarray, "v"]:
    """Variance along the normal from the errors of poses and intrinsics, up to a rigid motion of the surface.

    A row of derivatives has entries for the frames that see the vertex, so that its product with the covariance's
    factor takes time by those frames, not by all. The rigid motion of the whole surface is taken out of the products.
    """
    seen, normals = np.flatnonzero(sums.number), mesh.vertex_normals()
    out = np.full(len(mesh.vertices), np.nan)
    if len(seen) == 0:
        return out
    points = mesh.vertices - mesh.vertices[seen].mean(0)
    rigid = np.concatenate([normals, np.cross(points, normals)], 1)
    devices = _all_devices(scan, poses)
    kind = np.float64 if is_exact(len(joint.factor)) else np.float32  # random draws are off by more than rounding is
    factor = joint.factor.astype(kind, copy=False)

    def moved(part: Int64[ndarray, "n"]) -> Float[ndarray, "n k"]:
        """Changes of some vertices by the columns of the factor."""
        confirmed = sums.confirmed(part)
        frames = np.flatnonzero(confirmed.any(0))
        rows = _rows(mesh.vertices[part], normals[part], devices[frames], confirmed[:, frames])
        columns = np.concatenate([_columns(frames, len(scan.frames)), np.arange(-UNKNOWNS, 0)])
        return rows.astype(kind, copy=False) @ factor[columns]

    some = seen[evenly_spaced(len(seen), min(_GAUGE_VERTICES, len(seen)))]
    of_some = np.concatenate(results([partial(moved, part) for part in _portions(some)]))
    motion = np.linalg.lstsq(rigid[some], of_some, rcond=None)[0]

    def write(part: Int64[ndarray, "n"]) -> None:
        change = moved(part) - rigid[part] @ motion
        out[part] = dot(change, change)

    parallel([partial(write, part) for part in _portions(seen)])
    return out


def _portions(vertices: Int64[ndarray, "v"]) -> list[Int64[ndarray, "_"]]:
    return [vertices[first : first + _TOGETHER] for first in range(0, len(vertices), _TOGETHER)]


def surface_rows(
    points: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    scan: Scan,
    poses: DevicePoses,
    confirmed: Bool[ndarray, "v frames"],
) -> Float[ndarray, "v joint"]:
    """Derivatives of vertices along their normals by (delta, rho, intrinsics); each has a frame that confirms it."""
    return _rows(points, normals, _all_devices(scan, poses), confirmed)


def _rows(
    points: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    devices: Float[ndarray, "some devices"],
    confirmed: Bool[ndarray, "v some"],
) -> Float[ndarray, "v joint"]:
    """The columns of `surface_rows` that belong to some frames, among which are all that confirm the vertices."""
    out = np.zeros((len(points), 12 * len(devices) + UNKNOWNS))
    write_rows(confirmed, devices, points, normals, out)
    return out


def _all_devices(scan: Scan, poses: DevicePoses) -> Float[ndarray, "frames devices"]:
    return np.stack([packed_devices(devices_of(scan, poses, k)) for k in range(len(scan.frames))])


def _columns(some: Int64[ndarray, "some"], frames: int) -> Int64[ndarray, "twelve_each"]:
    """Where delta of some frames, and then their rho, are among the unknowns."""
    delta = (6 * some[:, None] + np.arange(6)).reshape(-1)
    return np.concatenate([delta, 6 * frames + delta])


def columns_of(frame: int, frames: int) -> Int64[ndarray, "12"]:
    """Where delta and rho of a frame are among the unknowns."""
    return np.r_[6 * frame : 6 * frame + 6, 6 * (frames + frame) : 6 * (frames + frame) + 6]
