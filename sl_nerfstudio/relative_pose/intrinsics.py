"""Intrinsics judged by the epipolar geometry of all frames: a rough camera refined, stated devices contradicted.

A frame's own pose absorbs part of a wrong value; what several frames demand together, it cannot.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, for_loops, view_of
from sl_nerfstudio.geometry.lie import cross, rotated, row_times_rotation
from sl_nerfstudio.geometry.triangulation import PARALLEL
from sl_nerfstudio.parallel import compiled_range, one_library_thread
from sl_nerfstudio.relative_pose.epipolar import (
    KERNEL_SIGMAS,
    RayPairs,
    UnitPose,
    direction_basis,
    directions,
    directions_by_uv,
    noise_of,
)
from sl_nerfstudio.relative_pose.joint_fit import (
    CX,
    CY,
    FOCAL_AND_CENTRE,
    K1,
    LOG_FOCAL,
    MOST_PER_FRAME,
    FrameMatches,
    JointProblem,
    PointMatches,
    device_with,
    values_of,
)

SIGMA_CENTRE = 0.01  # of principal points around the middle, share of the image's longer side
SIGMA_K1 = 0.03  # first term of the distortion of a usual lens
MOST_STEPS, LARGEST_STEP, CONVERGED = 12, 0.05, 1e-8  # Gauss-Newton steps of the camera, and their size
MOST_CHECKED = 20_000  # correspondences of all frames with which stated intrinsics are tested
CONTRADICTION = 30.0
"""Chi square (three degrees of freedom) above which the frames contradict stated intrinsics: chance alone exceeds it
once in a million, but the errors of squares and frames are not quite independent."""
LEAST_CHANGE = 0.01
"""Share of the focal length by which stated intrinsics must be wrong to be reported: real lenses and decoders err by up
to 0.3 % in ways that no sigma of two frames includes."""
EXPLAINED = 16.0  # chi square (one or two degrees of freedom) that may remain where a part explains it all

# Depth along camera rays from one pose of the projector, and how it changes with that pose.


def camera_depth(
    R: Float64[ndarray, "3 3"],
    t: Float64[ndarray, "3"],
    d_camera: Float64[ndarray, "n 3"],
    d_projector: Float64[ndarray, "n 3"],
) -> Float64[ndarray, "n"]:
    """Depth along camera rays where they come nearest to projector rays, each in its device's axes.

    `R`, `t` map from the projector to the camera.
    """
    p = d_projector @ R.T
    n, N = np.cross(d_camera, p), np.cross(t, p)
    return (N * n).sum(-1) / (n * n).sum(-1).clip(1e-300)


def camera_depth_by_pose(
    T_camera_projector: Float64[ndarray, "4 4"],
    projector: Device,
    d_camera: Float64[ndarray, "n 3"],
    d_projector: Float64[ndarray, "n 3"],
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"], Float64[ndarray, "n 5"]]:
    """`camera_depth`, how far it moves per pixel of the projector, and by the pose's increments of `epipolar.moved`.

    With p the projector's ray in camera axes, n = d x p and N = t x p, depth is N . n / n . n. The derivatives of both
    products by p and by t are cross products; w turns p, b turns t. NaN where the rays are parallel.
    """
    depth, by_pixel, by_pose = np.empty(len(d_camera)), np.empty(len(d_camera)), np.empty((len(d_camera), 5))
    T, basis = np.ascontiguousarray(T_camera_projector), direction_basis(T_camera_projector[:3, 3])
    by_t = np.ascontiguousarray(basis[:, ::-1] * [-1, 1])
    _depth_by_pose(len(depth), T, *for_loops(projector), by_t, d_camera, d_projector, depth, by_pixel, by_pose)
    return depth, by_pixel, by_pose


@compiled_range
def _depth_by_pose(first, last, T, code, parameters, basis, d_camera, d_projector, depth, by_pixel, by_pose):
    t0, t1, t2 = T[0, 3], T[1, 3], T[2, 3]
    for k in range(first, last):
        d0, d1, d2 = d_camera[k, 0], d_camera[k, 1], d_camera[k, 2]
        p0, p1, p2 = rotated(T, d_projector[k, 0], d_projector[k, 1], d_projector[k, 2])
        n0, n1, n2 = cross(d0, d1, d2, p0, p1, p2)
        N0, N1, N2 = cross(t0, t1, t2, p0, p1, p2)
        square = n0 * n0 + n1 * n1 + n2 * n2
        over = 1 / square if square > PARALLEL else np.nan
        s = (N0 * n0 + N1 * n1 + N2 * n2) * over
        depth[k] = s
        x, y, z = row_times_rotation(s * d0 - t0, s * d1 - t1, s * d2 - t2, T)  # the inverse of a rotation
        _, _, _, ux, uy, uz, vx, vy, vz = view_of(code, x, y, z, parameters)
        x, y, z = row_times_rotation(d0, d1, d2, T)
        slope = np.hypot(ux * x + uy * y + uz * z, vx * x + vy * y + vz * z)
        by_pixel[k] = 1 / max(slope, 1e-12)
        a0, a1, a2 = cross(n0, n1, n2, t0, t1, t2)
        b0, b1, b2 = cross(N0 - 2 * s * n0, N1 - 2 * s * n1, N2 - 2 * s * n2, d0, d1, d2)
        w = cross(p0, p1, p2, over * (a0 + b0), over * (a1 + b1), over * (a2 + b2))
        c0, c1, c2 = cross(p0, p1, p2, n0, n1, n2)
        by_pose[k, 0], by_pose[k, 1], by_pose[k, 2] = w
        for j in range(2):
            by_pose[k, 3 + j] = over * (c0 * basis[0, j] + c1 * basis[1, j] + c2 * basis[2, j])


# A camera whose focal length is only roughly known.

CAMERA_UNKNOWNS = (LOG_FOCAL, CX, CY, K1)


@dataclass(frozen=True)
class CameraEstimate:
    """The camera, and the covariance of its unknowns; it allows for errors shared within squares of the pattern."""

    camera: Device
    covariance: Float64[ndarray, "4 4"]  # of CAMERA_UNKNOWNS

    @property
    def sigma_focal_px(self) -> float:
        """1 sigma of the focal length."""
        return self.camera.fl_x * float(np.sqrt(self.covariance[0, 0]))

    @property
    def sigma_centre_px(self) -> tuple[float, float]:
        """1 sigma of the principal point."""
        x, y = (self.camera.w * float(np.sqrt(self.covariance[k, k])) for k in (1, 2))
        return x, y

    @property
    def sigma_k1(self) -> float:
        """1 sigma of the first term of the distortion."""
        return float(np.sqrt(self.covariance[3, 3]))


def estimate_camera(
    frames: Sequence[FrameMatches],
    poses: Sequence[UnitPose],
    camera: Device,
    projector: Device,
    sigma: float,
    seed: int = 0,
) -> CameraEstimate:
    """The camera with the smallest epipolar errors of all frames together, near the stated one.

    `poses` are those found with the frames' camera, which may be another than the stated one; correspondences are those
    that agree with them. `sigma` is the relative uncertainty of the stated focal length. What is known beforehand of a
    camera weighs by the errors of whole squares of the pattern, so they are Gauss-Newton steps. Raises ValueError
    without frames.
    """
    if not frames:
        raise ValueError("no frames")
    matches = PointMatches.of(frames, projector, MOST_PER_FRAME, np.random.default_rng(seed))
    d_projector, by_uv = directions_by_uv(projector, matches.uv_projector)

    def rays(device: Device) -> RayPairs:
        return RayPairs(directions(device, matches.uv_camera), d_projector, by_uv, matches.block)

    index, mean = list(CAMERA_UNKNOWNS), values_of(camera)
    problem = JointProblem(matches, frames[0].camera, CAMERA_UNKNOWNS, mean, rays)
    centre = SIGMA_CENTRE * max(camera.w, camera.h) / camera.w
    prior = np.diag(1 / np.square([sigma, centre, centre, SIGMA_K1]))
    state, information = problem.start(poses), prior
    for _ in range(MOST_STEPS):
        at = problem.linearised(state, KERNEL_SIGMAS * noise_of(problem.residuals(state)))
        normal, scores = at.equations.reduced(), problem.scores(at)
        # Squared error of a measurement, where errors within a square of the pattern are shared.
        scale = max(float(np.mean((scores**2).sum(0) / np.diag(normal.H).clip(1e-300))), 1e-12)
        information = normal.H / scale + prior
        step = np.linalg.solve(information, -normal.g / scale - prior @ (state.values - mean)[index])
        step *= min(1.0, LARGEST_STEP / max(float(np.abs(step).max()), 1e-300))
        state = problem.moved(state, (step, at.equations.blocks_after(step)))
        if np.abs(step).max() < CONVERGED:
            break
    return CameraEstimate(device_with(camera, state.values), np.linalg.inv(information))


# Whether stated intrinsics can be right: focal length and principal point of the projector become free, with all
# relative poses; then those of the camera instead.

Role = Literal["projector", "camera"]
Part = Literal["focal length", "principal point", "focal length and principal point"]
_PARTS: dict[Part, tuple[int, ...]] = {"focal length": (0,), "principal point": (1, 2)}


@dataclass(frozen=True)
class DeviceEvidence:
    """Evidence of the frames on one device, if the other one is right. Shares are of its focal length."""

    device: Device  # as stated
    change: Float64[ndarray, "3"]  # of focal length and principal point x, y, shares; for which frames agree best
    covariance: Float64[ndarray, "3 3"]
    noise_px: tuple[float, float]  # of the epipolar errors: with the stated values, and with those that agree best

    @property
    def chi_square(self) -> float:
        """Squared length of the change in units of its uncertainty: about three if the stated values are right."""
        return float(self.change @ np.linalg.solve(self.covariance, self.change))


@dataclass(frozen=True)
class Explanation:
    """Values of one device that are wrong, and the change with which the frames agree; the other values are right."""

    role: Role
    part: Part
    device: Device  # as stated
    change: Float64[ndarray, "3"]  # shares of the focal length
    sigma: Float64[ndarray, "3"]
    left: float  # chi square that it leaves


@dataclass(frozen=True)
class IntrinsicsEvidence:
    """Evidence of the frames on both devices, each alone."""

    projector: DeviceEvidence
    camera: DeviceEvidence

    def allowing(self, doubt: Float64[ndarray, "3 3"]) -> "IntrinsicsEvidence":
        """The evidence where stated values are uncertain, by a covariance of shares of the focal length."""
        return IntrinsicsEvidence(
            *(replace(one, covariance=one.covariance + doubt) for one in (self.projector, self.camera))
        )

    def contradicts(self) -> bool:
        """Whether the stated intrinsics cannot be right."""
        return all(
            one.chi_square > CONTRADICTION and bool((np.abs(one.change) > LEAST_CHANGE).any())
            for one in (self.projector, self.camera)
        )

    def explanations(self) -> list[Explanation]:
        """Explanations of the contradiction: a single part of one device, if one suffices; else either device.

        A wrong projector and a wrong camera look alike. But a focal length of the one is focal length and principal
        point of the other, so that few wrong values tell whose they are.
        """
        both: tuple[tuple[Role, DeviceEvidence], ...] = (("projector", self.projector), ("camera", self.camera))
        found = [_alone(role, one, part) for role, one in both for part in _PARTS]
        enough = [e for e in found if e.left < EXPLAINED]
        if enough:
            return enough
        whole: Part = "focal length and principal point"
        return [Explanation(r, whole, e.device, e.change, np.sqrt(np.diag(e.covariance)), 0.0) for r, e in both]


def _alone(role: Role, evidence: DeviceEvidence, part: Part) -> Explanation:
    """The change if only one part is wrong (conditional normal distribution), and what this leaves unexplained."""
    kept = list(_PARTS[part])
    held = [k for k in range(3) if k not in kept]
    C, x = evidence.covariance, evidence.change
    gain = np.linalg.solve(C[np.ix_(held, held)], C[np.ix_(held, kept)]).T
    change, sigma = np.zeros(3), np.zeros(3)
    change[kept] = x[kept] - gain @ x[held]
    sigma[kept] = np.sqrt(np.diag(C[np.ix_(kept, kept)] - gain @ C[np.ix_(held, kept)]))
    left = float(x[held] @ np.linalg.solve(C[np.ix_(held, held)], x[held]))
    return Explanation(role, part, evidence.device, change, sigma, left)


@one_library_thread()
def check_intrinsics(
    frames: Sequence[FrameMatches],
    poses: Sequence[UnitPose],
    projector: Device,
    seed: int = 0,
) -> IntrinsicsEvidence:
    """Test of the stated values. `poses` are those found with them; cameras must all have the same intrinsics."""
    swapped = [FrameMatches(f.name, f.uv_projector, f.uv_camera, projector) for f in frames]
    turned = [(R.T, -R.T @ t) for R, t in poses]
    return IntrinsicsEvidence(
        _evidence(frames, poses, projector, seed),
        _evidence(swapped, turned, frames[0].camera, seed),
    )


def _evidence(frames: Sequence[FrameMatches], poses: Sequence[UnitPose], device: Device, seed: int) -> DeviceEvidence:
    most = max(min(MOST_PER_FRAME, MOST_CHECKED // len(frames)), 1)
    matches, usual = PointMatches.of(frames, device, most, np.random.default_rng(seed)), values_of(device)
    held = JointProblem(matches, device, (), usual).fit(poses)
    free = JointProblem(matches, device, FOCAL_AND_CENTRE, usual).fit(held.poses)
    step = (values_of(free.device) - usual)[list(FOCAL_AND_CENTRE)]
    unit = np.array([1.0, device.w / device.fl_x, device.w / device.fl_x])
    return DeviceEvidence(device, step * unit, free.covariance * np.outer(unit, unit), (held.noise_px, free.noise_px))
