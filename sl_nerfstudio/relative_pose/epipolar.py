"""The epipolar geometry of one frame: rays of matched pixels, Sampson's residual, and the fit of the relative pose.

The residual is the distance, to first order, of a decoded coordinate from the epipolar curve of its camera pixel, in
projector pixels (Sampson 1982; Hartley and Zisserman, Multiple View Geometry, 11.4.3). Only the projector's side has an
error, because camera pixels are exact centres. It is computed from rays alone and therefore holds for pinhole,
distorted and diffractive projectors. One frame does not show the length of its baseline, which is set to one.

Five unknowns (w, b): `R <- exp(w) R` rotates the projector about its own centre, in camera axes, and
`t <- exp(B b) t` rotates the unit baseline, where B = `direction_basis(t)` spans the plane perpendicular to it.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, for_loops, ray_of, view_of
from sl_nerfstudio.geometry.least_squares import NormalEquations, minimise
from sl_nerfstudio.geometry.lie import cross, rotated, row_times_rotation
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, all_finite, geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.parallel import compiled

BLOCKS_ALONG = 25  # squares along the pattern's longer side; errors within one may depend on each other
BLOCK_NUMBERS = (5 * BLOCKS_ALONG) ** 2  # all numbers that `blocks_of` gives are below this
MOST_PIXELS = 600_000  # of larger images every second, third, .. row and column is used
NOISE_FLOOR_PX = 1e-3  # noise that is assumed at least, projector pixels
KERNEL_SIGMAS = 3.0  # width of the robust kernel, standard deviations of the residuals

UnitPose = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]  # R and unit t, projector to camera


def blocks_of(uv_projector: Float[ndarray, "n 2"], projector: Device) -> Int64[ndarray, "n"]:
    """Number of the square of the pattern in which each coordinate lies."""
    side_px = max(projector.w, projector.h) / BLOCKS_ALONG
    # Coordinates outside the pattern have squares too, out to four times its longer side.
    column, row = np.floor(uv_projector / side_px).astype(np.int64).clip(-1, 4 * BLOCKS_ALONG).T
    return (row + 1) * (5 * BLOCKS_ALONG) + column + 1


def block_count(projector: Device) -> int:
    """Number of squares of the whole pattern, with those that its border cuts."""
    shorter, longer = sorted((projector.w, projector.h))
    return BLOCKS_ALONG * -(-BLOCKS_ALONG * shorter // longer)


@dataclass(frozen=True)
class RayPairs:
    """Correspondences of one frame as unit rays, each in its device's axes."""

    d_camera: Float64[ndarray, "n 3"]
    d_projector: Float64[ndarray, "n 3"]
    d_projector_by_uv: Float64[ndarray, "n 3 2"]  # derivative by the projector's pixel
    block: Int64[ndarray, "n"]  # square of the pattern; errors within one may depend on each other

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self.d_camera)

    def chosen(self, index: Int64[ndarray, "m"] | Bool[ndarray, "n"] | slice) -> "RayPairs":
        """Some of the pairs."""
        return RayPairs(self.d_camera[index], self.d_projector[index], self.d_projector_by_uv[index], self.block[index])

    def block_sums(self, values: Float64[ndarray, "n *k"]) -> Float64[ndarray, "blocks *k"]:
        """Sums of values over the pairs of each square of the pattern that holds any."""
        found, group = np.unique(self.block, return_inverse=True)
        sums = np.zeros((len(found), *values.shape[1:]))
        np.add.at(sums, group, values)
        return sums


def lattice_step(h: int, w: int) -> int:
    """Step between the rows and columns that are used: in large images, neighbouring coordinates err together."""
    return max(1, math.ceil(math.sqrt(h * w / MOST_PIXELS)))


def correspondences_of(
    coords: Float32[ndarray, "h w 2"],
) -> tuple[Float64[ndarray, "n 2"], Float64[ndarray, "n 2"]]:
    """Camera pixel centres and pattern coordinates of the decoded pixels; of large images, of those on a lattice."""
    step = lattice_step(*coords.shape[:2])
    some = coords[::step, ::step]
    row, column = np.nonzero(all_finite(some))
    return np.stack([column, row], -1) * step + 0.5, some[row, column].astype(np.float64)


def ray_pairs(
    uv_camera: Float[ndarray, "n 2"],
    uv_projector: Float[ndarray, "n 2"],
    camera: Device,
    projector: Device,
) -> tuple[RayPairs, Int64[ndarray, "m"]]:
    """Rays of correspondences, and the indices of those that have a ray in both devices.

    A DOE has no ray beyond 90 degrees; coordinates that are not finite have none at all.
    """
    d_camera, (d_projector, by_uv) = directions(camera, uv_camera), directions_by_uv(projector, uv_projector)
    usable = np.flatnonzero(all_finite(d_camera) & all_finite(d_projector))
    block = blocks_of(uv_projector[usable], projector)
    return RayPairs(d_camera[usable], d_projector[usable], by_uv[usable], block), usable


def directions(device: Device, uv: Float[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """Unit directions of pixels in the device's axes; NaN where there is none."""
    d = np.empty((len(uv), 3))
    _directions(*for_loops(device), np.ascontiguousarray(uv, dtype=np.float64), d)
    return d


def directions_by_uv(
    device: Device, uv: Float[ndarray, "n 2"]
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3 2"]]:
    """Unit directions of pixels, and their derivatives by the pixels; NaN where there is none."""
    d, by_uv = directions(device, uv), np.empty((len(uv), 3, 2))
    _by_uv(*for_loops(device), d, by_uv)
    return d, by_uv


def subsample(index: Int64[ndarray, "n"], most: int, rng: np.random.Generator) -> Int64[ndarray, "m"]:
    """All of the indices, or a random choice of `most` of them."""
    return index if len(index) <= most else rng.choice(index, most, replace=False)


@compiled
def _directions(code, parameters, uv, d):
    for i in range(len(uv)):
        d[i, 0], d[i, 1], d[i, 2] = ray_of(code, uv[i, 0], uv[i, 1], parameters)


@compiled
def _by_uv(code, parameters, d, by_uv):
    """Pseudo-inverse of the derivative J of the projection.

    Projection does not depend on the length of a ray: J d = 0, and the columns of J's inverse are perpendicular to d.
    """
    for i in range(len(d)):
        _, _, _, ux, uy, uz, vx, vy, vz = view_of(code, d[i, 0], d[i, 1], d[i, 2], parameters)
        uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
        inverse = 1 / (uu * vv - uv * uv)
        a, b, c = vv * inverse, -uv * inverse, uu * inverse
        by_uv[i, 0, 0], by_uv[i, 1, 0], by_uv[i, 2, 0] = a * ux + b * vx, a * uy + b * vy, a * uz + b * vz
        by_uv[i, 0, 1], by_uv[i, 1, 1], by_uv[i, 2, 1] = b * ux + c * vx, b * uy + c * vy, b * uz + c * vz


def direction_basis(t: Float64[ndarray, "3"]) -> Float64[ndarray, "3 2"]:
    """Two unit vectors perpendicular to `t` and to each other, the same ones for the same `t`."""
    B = np.empty((3, 2))
    _basis(t, B)
    return B


def moved(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], step: Float64[ndarray, "5"]
) -> tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]:
    """The pose after an increment (w, b)."""
    R_moved, t_moved = np.empty((3, 3)), np.empty(3)
    _move(R, t, step, R_moved, t_moved)
    return R_moved, t_moved


def sampson(R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs) -> Float64[ndarray, "n"]:
    """Signed distances of the coordinates from their epipolar curves, in projector pixels."""
    return sampson_of_frames(R[None], t[None], rays, np.zeros(len(rays), dtype=np.int64))


def sampson_of_frames(
    R: Float64[ndarray, "frames 3 3"], t: Float64[ndarray, "frames 3"], rays: RayPairs, frame: Int64[ndarray, "n"]
) -> Float64[ndarray, "n"]:
    """Residuals of rays in several frames, each of which has its own pose."""
    r = np.empty(len(rays))
    _residuals(np.ascontiguousarray(R), t, frame, rays.d_camera, rays.d_projector, rays.d_projector_by_uv, r)
    return r


def sampson_jacobian(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n 5"]]:
    """Residuals and their derivatives by (w, b).

    For a vector q in projector axes, q . m changes with w by R q x n and with b by (R q x d) A, where m is the normal n
    in projector axes and A = t x B = (B2, -B1). The residual a / g has two such products: a, and each part of h, of
    which g is the length; so its change is that of one vector p.
    """
    r, J = np.empty(len(rays)), np.empty((len(rays), 5))
    A = direction_basis(t)[:, ::-1] * [1, -1]
    _derivatives(np.ascontiguousarray(R), t, A, rays.d_camera, rays.d_projector, rays.d_projector_by_uv, r, J)
    return r, J


@compiled
def _basis(t, B):
    x, y, z = t[0], t[1], t[2]
    u, v, w = abs(x), abs(y), abs(z)
    if u <= v and u <= w:  # of the axes, that which is most nearly perpendicular to t
        a, b, c = 0.0, z, -y
    elif v <= w:
        a, b, c = -z, 0.0, x
    else:
        a, b, c = y, -x, 0.0
    inverse = 1 / np.sqrt(a * a + b * b + c * c)
    a, b, c = a * inverse, b * inverse, c * inverse
    B[0, 0], B[1, 0], B[2, 0] = a, b, c
    B[0, 1], B[1, 1], B[2, 1] = cross(x, y, z, a, b, c)


@compiled
def _turned(x, y, z, u, v, w):
    """The vector (u, v, w) rotated by a rotation vector (Rodrigues' formula)."""
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    sine = np.sin(angle) / angle if angle > 1e-8 else 1.0
    half = np.sin(angle / 2) / angle if angle > 1e-8 else 0.5
    a, b, c = cross(x, y, z, u, v, w)
    p, q, r = cross(x, y, z, a, b, c)
    k = 2 * half * half
    return u + sine * a + k * p, v + sine * b + k * q, w + sine * c + k * r


@compiled
def _move(R, t, step, R_moved, t_moved):
    B = np.empty((3, 2))
    _basis(t, B)
    u, v, w = step[0], step[1], step[2]
    for k in range(3):
        R_moved[0, k], R_moved[1, k], R_moved[2, k] = _turned(u, v, w, R[0, k], R[1, k], R[2, k])
    p, q = step[3], step[4]
    x, y, z = B[0, 0] * p + B[0, 1] * q, B[1, 0] * p + B[1, 1] * q, B[2, 0] * p + B[2, 1] * q
    x, y, z = _turned(x, y, z, t[0], t[1], t[2])
    inverse = 1 / np.sqrt(x * x + y * y + z * z)
    t_moved[0], t_moved[1], t_moved[2] = x * inverse, y * inverse, z * inverse


@compiled
def _plane(R, t, d):
    """Normal of the epipolar plane of a camera ray: in camera axes, and in those of the projector."""
    nx, ny, nz = cross(t[0], t[1], t[2], d[0], d[1], d[2])
    mx, my, mz = row_times_rotation(nx, ny, nz, R)
    return nx, ny, nz, mx, my, mz


@compiled
def distance_from_curve(mx, my, mz, e, by):
    """Residual of a projector ray `e` whose derivative is `by`; direction of its gradient, and one over its length."""
    a = mx * e[0] + my * e[1] + mz * e[2]
    h = mx * by[0, 0] + my * by[1, 0] + mz * by[2, 0]
    k = mx * by[0, 1] + my * by[1, 1] + mz * by[2, 1]
    inverse = 1 / max(np.sqrt(h * h + k * k), 1e-300)
    return a * inverse, h * inverse, k * inverse, inverse


@compiled
def _residuals(R, t, frame, d_camera, d_projector, by_uv, r):
    for i in range(len(r)):
        _, _, _, mx, my, mz = _plane(R[frame[i]], t[frame[i]], d_camera[i])
        r[i] = distance_from_curve(mx, my, mz, d_projector[i], by_uv[i])[0]


@compiled
def _derivatives(R, t, A, d_camera, d_projector, by_uv, r, J):
    for i in range(len(r)):
        d, e, by = d_camera[i], d_projector[i], by_uv[i]
        nx, ny, nz, mx, my, mz = _plane(R, t, d)
        s, h, k, inverse = distance_from_curve(mx, my, mz, e, by)
        r[i] = s
        u = (e[0] - s * (by[0, 0] * h + by[0, 1] * k)) * inverse
        v = (e[1] - s * (by[1, 0] * h + by[1, 1] * k)) * inverse
        w = (e[2] - s * (by[2, 0] * h + by[2, 1] * k)) * inverse
        x, y, z = rotated(R, u, v, w)
        J[i, 0], J[i, 1], J[i, 2] = cross(x, y, z, nx, ny, nz)
        p, q, o = cross(x, y, z, d[0], d[1], d[2])
        J[i, 3] = p * A[0, 0] + q * A[1, 0] + o * A[2, 0]
        J[i, 4] = p * A[0, 1] + q * A[1, 1] + o * A[2, 1]


@dataclass(frozen=True)
class EpipolarFit:
    """A relative pose with unit baseline, and how well it fits."""

    R: Float64[ndarray, "3 3"]  # projector to camera
    t: Float64[ndarray, "3"]  # unit direction from the camera to the projector, in camera axes
    residual: Float64[ndarray, "n"]  # projector pixels
    noise_px: float  # robust standard deviation of the residuals


def noise_of(residual: Float64[ndarray, "n"]) -> float:
    """Robust standard deviation about zero."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), NOISE_FLOOR_PX)


def fit_epipolar(
    R: Float64[ndarray, "3 3"], t: Float64[ndarray, "3"], rays: RayPairs, iterations: int = 30, tolerance: float = 1e-10
) -> EpipolarFit:
    """Levenberg-Marquardt from a start that is right to within a few degrees.

    The kernel follows the noise as it falls, and never widens again (graduated non-convexity). The fit ends where the
    cost can fall by no more than the tolerance, as a share of it.
    """
    width, floor = np.inf, len(rays) * NOISE_FLOOR_PX**2  # the floor ends the search where everything fits exactly
    kept: list[Any] = [None, None]  # the last pose, and its residuals

    def residual(pose: UnitPose) -> Float64[ndarray, "n"]:
        if kept[0] is not pose:
            kept[:] = pose, sampson(*pose, rays)
        return kept[1]

    def narrow(pose: UnitPose) -> None:
        nonlocal width
        width = min(width, KERNEL_SIGMAS * noise_of(residual(pose)))

    def equations(pose: UnitPose) -> NormalEquations:
        r, J = sampson_jacobian(*pose, rays)
        return NormalEquations.of(J, r, geman_mcclure_weight((r / width) ** 2))

    def cost(pose: UnitPose) -> float:
        return (width**2 * float(geman_mcclure_cost((residual(pose) / width) ** 2).sum()) + floor) / 2

    R, t = minimise(
        (R, t), equations, lambda pose, step: moved(*pose, step), cost,
        narrow=narrow, iterations=iterations, tolerance=tolerance,
    ).state  # fmt: skip
    r = sampson(R, t, rays)
    return EpipolarFit(R, t, r, noise_of(r))


def covariance(found: EpipolarFit, rays: RayPairs) -> Float64[ndarray, "5 5"]:
    """Covariance of (w, b), robust against errors that depend on each other (the cluster-robust sandwich estimator).

    Within a square of the pattern residuals may depend on each other in any way: their gradients are summed before
    they are squared (Liang and Zeger, Biometrika 1986). Errors that are shared over longer distances, such as wrong
    lens parameters, cannot be seen in any frame alone and are not included.
    """
    r, J = sampson_jacobian(found.R, found.t, rays)
    width = KERNEL_SIGMAS * found.noise_px
    x = (r / width) ** 2
    w = geman_mcclure_weight(x)
    curvature = w - 4 * x / (1 + x) ** 3  # of the kernel: what a residual adds to the cost's second derivative
    bread = (J * curvature[:, None]).T @ J
    if np.linalg.eigvalsh(bread)[0] <= 0:
        bread = (J * w[:, None]).T @ J
    gradients = rays.block_sums(J * (w * r)[:, None])
    blocks = len(gradients)
    meat = gradients.T @ gradients * (blocks / max(blocks - 5, 1))
    # Where everything fits exactly, the least noise is assumed.
    meat = meat + NOISE_FLOOR_PX**2 * (J.T @ J)
    inverse = np.linalg.pinv(bread, rcond=1e-14, hermitian=True)
    return inverse @ meat @ inverse
