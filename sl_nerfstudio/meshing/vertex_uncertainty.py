"""Uncertainty of every vertex along its normal, by linear propagation.

Near a vertex the surface minimises the residuals of all pixels that see it. So it moves along its normal by
`s = -sum(a . r) / sum(a . a)` when residuals change by r, with a the residuals' slope along the normal. Two kinds of
errors change them. Decoding noise is independent from one vertex to another that is farther away than the field
averages (`sigma_independent`). Errors of poses and intrinsics are shared by the whole surface: their joint covariance
is propagated, less the rigid motion of the whole surface, which changes no shape.
"""

from functools import partial

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.self_calibration import UNKNOWNS
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.meshing.lit_vertices import dot
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.shared_rows import write_rows
from sl_nerfstudio.meshing.surface_derivatives import packed_devices
from sl_nerfstudio.meshing.vertex_noise import AVERAGED_CELLS, independent_variance
from sl_nerfstudio.meshing.vertex_quality import VertexQuality
from sl_nerfstudio.meshing.vertex_views import VertexViews, collect_views, devices_of
from sl_nerfstudio.scan.types import Scan
from sl_nerfstudio.threads import parallel

_TOGETHER = 512  # neighbouring vertices, which mostly the same frames see
_GAUGE_VERTICES = 4000  # of which the rigid motion of the whole surface is fitted


def vertex_uncertainty(
    mesh: Mesh, scan: Scan, poses: DevicePoses, joint: JointCovariance | None, cell: float
) -> VertexQuality:
    """Uncertainty of a mesh in the scan's world.

    `joint` is the covariance of `poses` and intrinsics; None if they are exact. `cell` is the length of the field's
    finest cells.
    """
    views, count = collect_views(mesh, scan, poses), len(mesh.vertices)
    independent = independent_variance(mesh, views, AVERAGED_CELLS * cell**2)
    shared = np.zeros(count) if joint is None else _shared_variance(mesh, scan, poses, views, joint)
    number = np.bincount(views.vertex, minlength=count)
    angle = np.full(count, np.nan)
    np.fmax.at(angle, views.vertex, np.degrees(views.ray_angle))
    distance = np.bincount(views.vertex, np.linalg.norm(views.residual, axis=1), count)
    seen = number > 0
    return VertexQuality(
        sigma=np.where(seen, np.sqrt(independent + shared), np.nan),
        sigma_independent=np.where(seen, np.sqrt(independent), np.nan),
        views=number,
        residual=np.where(seen, distance / np.maximum(number, 1), np.nan),
        ray_angle=angle,
    )


def _shared_variance(
    mesh: Mesh, scan: Scan, poses: DevicePoses, views: VertexViews, joint: JointCovariance
) -> Float[ndarray, "v"]:
    """Variance along the normal from the errors of poses and intrinsics, up to a rigid motion of the surface.

    A row of derivatives is s - r m: s has entries for the frames that see the vertex, r is its rigid motion, m what the
    rigid motion of the whole surface is of. So the variances of neighbours take time by their own frames, not by all.
    """
    seen, normals = np.unique(views.vertex), mesh.vertex_normals()
    out = np.full(len(mesh.vertices), np.nan)
    if len(seen) == 0:
        return out
    points = mesh.vertices - mesh.vertices[seen].mean(0)
    rigid = np.concatenate([normals, np.cross(points, normals)], 1)
    some = seen[evenly_spaced(len(seen), min(_GAUGE_VERTICES, len(seen)))]
    devices, everywhere = _all_devices(scan, poses), np.arange(len(scan.frames))
    rows = _rows(mesh.vertices, normals, devices, views, some, everywhere)
    motion = np.linalg.lstsq(rigid[some], rows, rcond=None)[0]
    shared = joint.matrix @ motion.T
    of_motion = motion @ shared

    def write(part: Int64[ndarray, "n"]) -> None:
        first, last = ranges_of(views, part)
        frames = np.unique(views.frame[first[0] : last[-1]])
        rows, r = _rows(mesh.vertices, normals, devices, views, part, frames), rigid[part]
        columns = np.concatenate([_columns(frames, len(scan.frames)), np.arange(-UNKNOWNS, 0)])
        inner = rows @ joint.matrix[np.ix_(columns, columns)]
        across = rows @ shared[columns]
        out[part] = dot(inner, rows) - 2 * dot(across, r) + dot(r @ of_motion, r)

    parallel([partial(write, seen[first : first + _TOGETHER]) for first in range(0, len(seen), _TOGETHER)])
    return np.maximum(out, 0.0)


def surface_rows(
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    scan: Scan,
    poses: DevicePoses,
    views: VertexViews,
    vertices: Int64[ndarray, "v"],
) -> Float[ndarray, "v joint"]:
    """Derivatives of vertices along their normals by (delta, rho, intrinsics); `vertices` ascend, each has a view."""
    return _rows(points, normals, _all_devices(scan, poses), views, vertices, np.arange(len(scan.frames)))


def _rows(
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    devices: Float[ndarray, "frames devices"],
    views: VertexViews,
    vertices: Int64[ndarray, "v"],
    frames: Int64[ndarray, "some"],
) -> Float[ndarray, "v joint"]:
    """The columns of `surface_rows` that belong to some frames, among which are all that see the vertices."""
    out, place = np.zeros((len(vertices), 12 * len(frames) + UNKNOWNS)), np.zeros(len(devices), dtype=np.int64)
    place[frames] = np.arange(len(frames))
    first, last = ranges_of(views, vertices)
    write_rows(
        vertices, first, last, views.frame, views.pixels_per_area, place, len(frames), devices, points, normals, out
    )
    return out


def _all_devices(scan: Scan, poses: DevicePoses) -> Float[ndarray, "frames devices"]:
    return np.stack([packed_devices(devices_of(scan, poses, k)) for k in range(len(scan.frames))])


def _columns(some: Int64[ndarray, "some"], frames: int) -> Int64[ndarray, "twelve_each"]:
    """Where delta of some frames, and then their rho, are among the unknowns."""
    delta = (6 * some[:, None] + np.arange(6)).reshape(-1)
    return np.concatenate([delta, 6 * frames + delta])


def ranges_of(views: VertexViews, vertices: Int64[ndarray, "v"]) -> tuple[Int64[ndarray, "v"], Int64[ndarray, "v"]]:
    """First and last (exclusive) position in `views` of each vertex."""
    return np.searchsorted(views.vertex, vertices), np.searchsorted(views.vertex, vertices, side="right")


def columns_of(frame: int, frames: int) -> Int64[ndarray, "12"]:
    """Where delta and rho of a frame are among the unknowns."""
    return np.r_[6 * frame : 6 * frame + 6, 6 * (frames + frame) : 6 * (frames + frame) + 6]
