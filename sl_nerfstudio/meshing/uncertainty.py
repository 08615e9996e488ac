"""Uncertainty of every vertex of a surface, and of distances on it, by linear propagation."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray
from scipy.sparse import coo_array
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import HALF_WINDOW, CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance, is_exact
from sl_nerfstudio.bundle_adjustment.parameters import UNKNOWNS, by_intrinsics
from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.devices import MODELS, Intrinsics, project, project_jacobian
from sl_nerfstudio.geometry.lie import DevicePoses, hat, inverse, transform
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, evenly_spaced
from sl_nerfstudio.meshing import visibility as loops
from sl_nerfstudio.meshing.mesh import Mesh, VertexQuality
from sl_nerfstudio.meshing.visibility import LEAST_PX, MEDIANS, MOST_PX, Occluder, dot, lit_vertices, write_rows
from sl_nerfstudio.parallel import compiled_range, parallel, results, threads
from sl_nerfstudio.scan.types import Scan

# How the residuals of one frame depend on the surface, on the frame's poses and on the intrinsics.
#
# A surface that is locally a plane moves by s along its normal, or the frame's poses change while its decoded
# coordinates stay. The residual is the predicted minus the decoded coordinate of a camera pixel, in projector pixels.
# Increments are those of `bundle_adjustment.residuals`; intrinsics are shares of the focal length
# (`IntrinsicsChange.values`).


@dataclass(frozen=True)
class FrameDevices:
    """Camera and projector of one frame, batch ()."""

    camera: Intrinsics
    projector: Intrinsics
    T_world_camera: Float[Tensor, "4 4"]
    T_camera_projector: Float[Tensor, "4 4"]


def packed_devices(d: FrameDevices) -> Float[ndarray, "devices"]:
    """The devices of a frame as compiled loops read them."""
    T_camera_world, T_projector_camera = inverse(d.T_world_camera), inverse(d.T_camera_projector)
    codes = [float(MODELS[device.model].code) for device in (d.camera, d.projector)]
    matrices = [T[:3].reshape(-1).numpy() for T in (T_camera_world, T_projector_camera)]
    return np.concatenate(
        [*matrices, d.T_camera_projector[:3, 3].numpy(), d.camera.params.numpy(), d.projector.params.numpy(), codes]
    )


def view_surface(d: FrameDevices, p_world: Float[ndarray, "n 3"], normal: Float[ndarray, "n 3"]) -> np.recarray:
    """Rows of `SURFACE_VIEW` for points with unit normals, which must be before both devices and face the camera."""
    rows = np.empty((len(p_world), loops.VIEW))
    _view_points(len(rows), packed_devices(d), p_world, normal, rows)
    return rows.view(loops.SURFACE_VIEW)[:, 0].view(np.recarray)


@compiled_range
def _view_points(first, last, devices, points, normals, rows):
    for i in range(first, last):
        loops.view_point(devices, points[i], normals[i], rows[i])


def point_equations(d: FrameDevices, p_world: Float[Tensor, "n 3"]) -> tuple[Tensor, Tensor]:
    """Derivatives of the residuals of a *point*, which the frame sees at a camera pixel and at a projector pixel.

    Returns those by the point (n, 4, 3), and by delta, rho and the intrinsics (n, 4, 18). Unlike a surface, a point
    cannot slide along itself: lengths between points depend on all of its motion.
    """
    p, T = transform(inverse(d.T_world_camera), p_world), inverse(d.T_camera_projector)
    K, P = project_jacobian(d.camera, p), project_jacobian(d.projector, transform(T, p)) @ T[:3, :3]
    by_point = torch.cat([K, P], 1) @ d.T_world_camera[:3, :3].T
    by_delta = torch.cat([-by_point, by_point @ hat(p_world)], -1)
    by_rho = torch.cat([torch.zeros_like(by_delta[:, :2]), torch.cat([-P, P @ hat(p)], -1)], 1)
    uv_camera = project(d.camera, p)[0]
    uv_projector = project(d.projector, transform(T, p))[0]
    zero = p.new_zeros(len(p), 2, 3)
    camera = torch.cat([by_intrinsics(d.camera, uv_camera), zero], 1)
    projector = torch.cat([zero, by_intrinsics(d.projector, uv_projector)], 1)
    return by_point, torch.cat([by_delta, by_rho, camera, projector], -1)


# For every vertex of a mesh, the frames that measured it: what they decoded there, and under which geometry.

_LOOKED_UP = 2000  # vertices of a frame, to compare the noise of windows with that of pixels
_FEWEST = 20  # values of which a spread is stated


@dataclass(frozen=True)
class FrameViews:
    """Vertices that one frame confirms; lengths in the scan's unit."""

    vertex: Int64[ndarray, "m"]  # ascending
    slope: Float[ndarray, "m 2"]  # of the residual along the normal, projector pixels per unit of length
    residual: Float[ndarray, "m 2"]  # predicted minus decoded coordinate, projector pixels
    pixels_per_area: Float[ndarray, "m"]
    ray_angle: Float[ndarray, "m"]  # between the rays of camera and projector, radian
    noise_px: float  # 1 sigma of one pixel's coordinate, each component; NaN if unknown
    window_ratio: float  # variance of a window's value over that of a pixel; NaN if unknown


def devices_of(scan: Scan, poses: DevicePoses, frame: int) -> FrameDevices:
    """The devices of one frame at the given poses."""
    T_camera = torch.from_numpy(poses.T_world_camera[frame])
    T_projector = torch.from_numpy(poses.T_world_projector[frame])
    camera = Intrinsics.of(scan.frames[frame].camera, torch.float64)
    return FrameDevices(
        camera, Intrinsics.of(scan.projector, torch.float64), T_camera, torch.linalg.inv(T_camera) @ T_projector
    )


def views_by_frame(
    mesh: Mesh, scan: Scan, poses: DevicePoses, chosen: Int64[ndarray, "c"] | None, task: str
) -> Iterator[FrameViews]:
    """Yield what each frame, in order, confirms of a mesh or of the `chosen` vertices; `task` names the progress.

    A frame confirms a vertex under the rules of `visibility`: its decoded coordinate is the one that the vertex
    predicts. As many frames are in memory at a time as there are threads.
    """
    chosen = np.arange(len(mesh.vertices), dtype=np.int64) if chosen is None else chosen
    points, normals, occluder = mesh.vertices, mesh.vertex_normals(), Occluder(mesh)

    def views(k: int) -> FrameViews:
        frame, T = scan.frames[k], (poses.T_world_camera[k], poses.T_world_projector[k])
        seen, _ = lit_vertices(points, normals, chosen, occluder, frame.camera, scan.projector, *T)
        view = view_surface(devices_of(scan, poses, k), points[seen], normals[seen])
        return _confirmed(seen, view, frame.read_coords())

    numbers = range(len(scan.frames))
    for first in track(numbers[:: threads()], task):
        yield from results([partial(views, k) for k in numbers[first : first + threads()]])


def _confirmed(seen: Int64[ndarray, "n"], view: np.recarray, coords: Float[ndarray, "h w 2"]) -> FrameViews:
    """The vertices, of those that a frame sees, whose predictions its decoded coordinates confirm."""
    column, row = np.floor(view.uv_camera).astype(np.int64).T
    at_pixel = np.einsum("nij,nj->ni", view.by_pixel, np.stack([column, row], 1) + 0.5 - view.uv_camera)
    residual = view.uv_projector + at_pixel - coords[row, column]
    size = np.linalg.norm(residual, axis=1)
    known = np.isfinite(size)
    usual = float(np.median(size[known])) if known.any() else 0.0
    good = np.flatnonzero(known & (size <= np.clip(MEDIANS * usual, LEAST_PX, MOST_PX)))
    view, residual = view[good], residual[good]
    noise = _spread(_across(view.slope, residual))
    ratio = _window_ratio(coords, view, noise)
    return FrameViews(seen[good], view.slope, residual, view.pixels_per_area, view.ray_angle, noise, ratio)


def _across(slope: Float[ndarray, "m 2"], residual: Float[ndarray, "m 2"]) -> Float[ndarray, "m"]:
    """The component of residuals that no motion of the surface changes: noise, and errors of the poses."""
    return (slope[:, 0] * residual[:, 1] - slope[:, 1] * residual[:, 0]) / np.linalg.norm(slope, axis=1)


def _spread(values: Float[ndarray, "n"]) -> float:
    return float(np.median(np.abs(values))) * MAD_TO_SIGMA if len(values) >= _FEWEST else float("nan")


def _window_ratio(coords: Float[ndarray, "h w 2"], view: np.recarray, noise: float) -> float:
    """Variance of look-ups, which average a window, over that of single pixels."""
    some = view[evenly_spaced(len(view), min(_LOOKED_UP, len(view)))]
    maps = CoordinateMaps.of([torch.from_numpy(coords)])
    uv_camera = torch.from_numpy(np.ascontiguousarray(some.uv_camera))
    seen = maps.look_up(torch.zeros(len(some), dtype=torch.int64), uv_camera)
    across = _across(some.slope, some.uv_projector - seen.uv_projector.numpy())
    return (_spread(across[seen.valid.numpy()]) / noise) ** 2 if noise > 0 else float("nan")


def _correlation(window_ratios: Sequence[float]) -> float:
    """Estimate how many neighbouring pixels share an error from what windows gain in each frame (NaN: unknown).

    If errors were independent, as many pixels as a decoded window has would gain what the fit in it gains.
    """
    known = [ratio for ratio in window_ratios if np.isfinite(ratio)]
    half = HALF_WINDOW
    y, x = np.mgrid[-half : half + 1, -half : half + 1].reshape(2, -1).astype(float)
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    pixels = 1 / float(np.linalg.inv(basis.T @ basis)[0, 0])
    return max(1.0, pixels * float(np.median(known))) if known else 1.0


# What all frames say of every vertex of a mesh, added up frame by frame: memory does not depend on their number.


@dataclass(frozen=True)
class VertexSums:
    """Sums over the frames that confirm each vertex."""

    number: Int64[ndarray, "v"]  # of the frames
    distance: Float[ndarray, "v"]  # lengths of the residuals, projector pixels
    ray_angle: Float[ndarray, "v"]  # the largest, radian; NaN without a frame
    weight: Float[ndarray, "v"]  # pixels per area, times the square of their residuals' slope along the normal
    variance: Float[ndarray, "v"]  # the same times the variance of a pixel's coordinate
    pull: Float[ndarray, "v"]  # pixels per area times slope times residual
    correlation: float  # how many neighbouring pixels share an error: 1 if their errors are independent
    bits: UInt8[ndarray, "frames eighth"]  # which frames confirm which vertices, eight in a byte

    def confirmed(self, vertices: Int64[ndarray, "n"]) -> Bool[ndarray, "n frames"]:
        """Frames that confirm some vertices."""
        return (self.bits[:, vertices // 8].T >> (7 - vertices % 8)[:, None]) & 1 > 0


def sum_views(views: Iterable[FrameViews], vertices: int) -> VertexSums:
    """Add up the views of all frames, in order, of a mesh with a number of vertices."""
    number, (distance, weight, variance, unknown, pull) = np.zeros(vertices, dtype=np.int64), np.zeros((5, vertices))
    ray_angle, noises, ratios, bits = np.full(vertices, np.nan), [], [], []
    for one in views:
        v = one.vertex
        number[v] += 1
        distance[v] += np.linalg.norm(one.residual, axis=1)
        ray_angle[v] = np.fmax(ray_angle[v], one.ray_angle)
        mine = one.pixels_per_area * (one.slope**2).sum(1)
        weight[v] += mine
        pull[v] += one.pixels_per_area * (one.slope * one.residual).sum(1)
        if np.isfinite(one.noise_px):
            variance[v] += mine * one.noise_px**2
        else:
            unknown[v] += mine
        noises.append(one.noise_px)
        ratios.append(one.window_ratio)
        mask = np.zeros(vertices, dtype=bool)
        mask[v] = True
        bits.append(np.packbits(mask))
    if unknown.any():  # a frame that confirms too few vertices has the noise of the others
        variance += unknown * (np.nanmedian(noises) ** 2 if np.isfinite(noises).any() else np.nan)
    return VertexSums(number, distance, ray_angle, weight, variance, pull, _correlation(ratios), np.stack(bits))


# The part of a vertex's uncertainty that comes from decoding noise, and from a field that does not follow the pixels.
#
# The field averages the pixels of all frames over a small area of the surface. So the variance of a vertex is that of a
# pixel's coordinate, divided by the number of pixels in that area and by the square of their slope along the normal.
# Where the pixels, averaged over the same area, put the surface elsewhere, the distance counts instead: a field that
# was trained too briefly, or that rounds an edge, is farther from the truth than noise alone would put it.

AVERAGED_CELLS = 2.0
"""Area over which the field averages, in squares of its finest cells; measured with several draws of noise (1.4 to 3.8
in benchmarks/log.md)."""
_MOST_ROUNDS = 60  # of smoothing, for meshes that are much finer than the field


def independent_variance(mesh: Mesh, sums: VertexSums, averaged_area: float) -> Float[ndarray, "v"]:
    """Variance of each vertex along its normal, from what its own neighbourhood was decoded as; NaN without views."""
    total = sums.weight
    seen = total > 0
    if not seen.any():
        return np.full(len(total), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        from_noise = sums.correlation * sums.variance / averaged_area / total**2
        smooth = smoothing(mesh, averaged_area)
        misfit = smooth(sums.pull) / smooth(total)
        from_misfit = smooth(np.where(seen, misfit**2, 0.0)) / smooth(seen.astype(float))
    return np.where(seen, np.fmax(from_noise, from_misfit), np.nan)


def smoothing(mesh: Mesh, area: float) -> Callable[[Float[ndarray, "v"]], Float[ndarray, "v"]]:
    """A function that averages values of vertices over an area of the mesh, by diffusion; their sum stays.

    A Gaussian of standard deviation d averages as much as a disk of area 4 pi d^2.
    """
    count = len(mesh.vertices)
    a, b = mesh.edges().T
    ends = np.concatenate([a, b]), np.concatenate([b, a])
    links = coo_array((np.ones(2 * len(a)), ends), (count, count)).tocsr()
    degree = np.maximum(np.asarray(links.sum(1)).reshape(-1), 1.0)
    # A round keeps half of each value and spreads the other half: d^2 grows by a quarter of the squared edge.
    edge2 = float(((mesh.vertices[a] - mesh.vertices[b]) ** 2).sum(1).mean())
    rounds = min(round(area / (4 * np.pi) / (edge2 / 4)), _MOST_ROUNDS) if edge2 > 0 else 0

    def smooth(values: Float[ndarray, "v"]) -> Float[ndarray, "v"]:
        for _ in range(rounds):
            values = 0.5 * values + 0.5 * (links @ (values / degree))
        return values

    return smooth


# Uncertainty of every vertex along its normal, by linear propagation.
#
# Near a vertex the surface minimises the residuals of all pixels that see it. So it moves along its normal by
# `s = -sum(a . r) / sum(a . a)` when residuals change by r, with a the residuals' slope along the normal. Two kinds of
# errors change them. Decoding noise is independent from one vertex to another that is farther away than the field
# averages (`sigma_independent`). Errors of poses and intrinsics are shared by the whole surface: their joint covariance
# is propagated, less the rigid motion of the whole surface, which changes no shape.

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
    devices = all_devices(scan, poses)
    kind = np.float64 if is_exact(len(joint.factor)) else np.float32  # random draws are off by more than rounding is
    factor = joint.factor.astype(kind, copy=False)

    def moved(part: Int64[ndarray, "n"]) -> Float[ndarray, "n k"]:
        """Changes of some vertices by the columns of the factor."""
        confirmed = sums.confirmed(part)
        frames = np.flatnonzero(confirmed.any(0))
        rows = surface_rows(mesh.vertices[part], normals[part], devices[frames], confirmed[:, frames])
        columns = _columns(frames, len(scan.frames))
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
    devices: Float[ndarray, "some devices"],
    confirmed: Bool[ndarray, "v some"],
) -> Float[ndarray, "v joint"]:
    """Derivatives of vertices along their normals by delta and rho of some frames, and by the intrinsics.

    Among the frames are all that confirm the vertices, each of which has one.
    """
    out = np.zeros((len(points), 12 * len(devices) + UNKNOWNS))
    write_rows(confirmed, devices, points, normals, out)
    return out


def all_devices(scan: Scan, poses: DevicePoses) -> Float[ndarray, "frames devices"]:
    """The devices of all frames as compiled loops read them."""
    return np.stack([packed_devices(devices_of(scan, poses, k)) for k in range(len(scan.frames))])


def _columns(some: Int64[ndarray, "some"], frames: int) -> Int64[ndarray, "c"]:
    """Places of delta of some frames, their rho, and the intrinsics among the unknowns."""
    delta = (6 * some[:, None] + np.arange(6)).reshape(-1)
    return np.concatenate([delta, 6 * frames + delta, np.arange(12 * frames, 12 * frames + UNKNOWNS)])


# Distances between two points of the surface.
#
# A point that is measured on the surface moves with the poses of the frames that see it, along the surface as well as
# across it. It is where their rays meet: it minimises its residuals in camera pixels and projector pixels. The shared
# part of a length's variance follows from the joint covariance, in the gauge of the scan: the length that fixes the
# scale counts as exact. Decoding noise moves each end along its normal.


@dataclass(frozen=True)
class LengthSigma:
    """1 sigma of lengths, in the scan's unit; NaN where no frame confirms one of the ends."""

    shared: Float[ndarray, "n"]  # from poses and intrinsics
    independent: Float[ndarray, "n"]  # from decoding noise at both ends


def length_sigma(
    mesh: Mesh,
    sigma_independent: Float[ndarray, "v"],
    ends: Int64[ndarray, "n 2"],
    scan: Scan,
    poses: DevicePoses,
    joint: JointCovariance,
) -> LengthSigma:
    """Uncertainty of the distances between pairs of vertices."""
    chosen, index = np.unique(ends, return_inverse=True)
    index = index.reshape(ends.shape)
    views = list(views_by_frame(mesh, scan, poses, chosen, "uncertainty of lengths"))
    moved = point_changes(mesh, scan, poses, views, chosen, joint.factor)
    along = mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]]
    with np.errstate(invalid="ignore", divide="ignore"):
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
    change = np.einsum("ni,nik->nk", along, moved[index[:, 1]] - moved[index[:, 0]])
    across = np.einsum("ni,nei->ne", along, mesh.vertex_normals()[ends])
    return LengthSigma(np.sqrt((change**2).sum(1)), np.sqrt(((across * sigma_independent[ends]) ** 2).sum(1)))


def point_changes(
    mesh: Mesh,
    scan: Scan,
    poses: DevicePoses,
    views: Sequence[FrameViews],
    chosen: Int64[ndarray, "c"],
    steps: Float[ndarray, "joint k"],
) -> Float[ndarray, "c 3 k"]:
    """Changes of points by some steps of (delta, rho, intrinsics); NaN where no frame confirms the vertex."""
    p, seen = torch.from_numpy(mesh.vertices), np.zeros(len(chosen), dtype=bool)
    normal, right = np.zeros((len(chosen), 3, 3)), np.zeros((len(chosen), 3, steps.shape[1]))
    for k, vertex in enumerate(view.vertex for view in views):
        at = np.searchsorted(chosen, vertex)
        seen[at] = True
        A, B = (x.numpy() for x in point_equations(devices_of(scan, poses, k), p[vertex]))
        normal[at] += A.transpose(0, 2, 1) @ A
        right[at] += (A.transpose(0, 2, 1) @ B) @ steps[_columns(np.array([k]), len(scan.frames))]
    out = np.full_like(right, np.nan)
    out[seen] = -np.linalg.solve(normal[seen], right[seen])
    return out
