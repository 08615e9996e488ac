"""Whether the epipolar geometry of all frames contradicts the stated intrinsics, and whose.

Focal length and principal point of the projector become free, with all relative poses; then those of the camera
instead. A frame's own pose absorbs part of a wrong value; what several frames demand together, it cannot.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.numerics import geman_mcclure_weight
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.relative_pose.epipolar import (
    CAMERA_ESTIMATE_DEFAULTS,
    CameraEstimateSettings,
    RayPairs,
    direction_basis,
    moved,
    noise_of,
    ray_pairs,
    sampson,
    sampson_jacobian,
    subsample,
)
from sl_nerfstudio.relative_pose.unknown_projector import (
    FOCAL_AND_CENTRE,
    UNKNOWN_PROJECTOR_DEFAULTS,
    FrameMatches,
    JointProblem,
    PointMatches,
    Poses,
    Prior,
    UnitPose,
    UnknownProjectorSettings,
    prior_sigma,
    values_of,
)

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
    _, n, N = _products(R, t, d_camera, d_projector)
    return (N * n).sum(-1) / (n * n).sum(-1).clip(1e-300)


def camera_depth_by_pose(
    R: Float64[ndarray, "3 3"],
    t: Float64[ndarray, "3"],
    d_camera: Float64[ndarray, "n 3"],
    d_projector: Float64[ndarray, "n 3"],
) -> Float64[ndarray, "n 5"]:
    """Derivatives of `camera_depth` by the increments (w, b) of the pose that `sampson` describes.

    With p the projector's ray in camera axes, n = d x p and N = t x p, depth is N . n / n . n. The derivatives of both
    products by p and by t are cross products; w turns p, b turns t.
    """
    p, n, N = _products(R, t, d_camera, d_projector)
    over = 1 / (n * n).sum(-1, keepdims=True).clip(1e-300)
    depth = (N * n).sum(-1, keepdims=True) * over
    by_p = over * (_cross(n, np.broadcast_to(t, p.shape)) + _cross(N - 2 * depth * n, d_camera))
    by_t = over * _cross(p, n)
    by_b = by_t @ (direction_basis(t)[:, ::-1] * [-1, 1])
    return np.concatenate([_cross(p, by_p), by_b], 1)


def _products(
    R: Float64[ndarray, "3 3"],
    t: Float64[ndarray, "3"],
    d_camera: Float64[ndarray, "n 3"],
    d_projector: Float64[ndarray, "n 3"],
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
    """The projector's rays p in camera axes, d x p and t x p."""
    p = d_projector @ R.T
    return p, _cross(d_camera, p), _cross(np.broadcast_to(t, p.shape), p)


def _cross(a: Float64[ndarray, "n 3"], b: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
    """As numpy's, in half of its time, and of a few vectors in a tenth."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], 1)


# The camera's intrinsics from the coordinates of all frames, where its focal length is only roughly known.
#
# All frames share four unknowns: focal length, principal point, first term of the distortion. Each frame has five
# more,
# its relative pose, which are eliminated. What is known beforehand (what the camera itself stated, a principal
# point near
# the middle, a lens with little distortion) counts as a measurement with its own uncertainty.

UNKNOWNS = ("log_focal", "centre_x", "centre_y", "k1")  # centres as shares of the image's longer side

CameraUnitPose = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3"]]  # R and unit t, projector to camera


@dataclass(frozen=True)
class FrameOfCamera:
    """Correspondences of one frame that agree with its relative pose, as found with the rough focal length."""

    uv_camera: Float64[ndarray, "n 2"]
    uv_projector: Float64[ndarray, "n 2"]
    pose: CameraUnitPose


@dataclass(frozen=True)
class CameraEstimate:
    """The camera, and the covariance of its unknowns; it allows for errors shared within squares of the pattern."""

    camera: Device
    covariance: Float64[ndarray, "4 4"]  # of UNKNOWNS

    @property
    def sigma_focal_px(self) -> float:
        """1 sigma of the focal length."""
        return self.camera.fl_x * float(np.sqrt(self.covariance[0, 0]))

    @property
    def sigma_centre_px(self) -> tuple[float, float]:
        """1 sigma of the principal point."""
        x, y = (max(self.camera.w, self.camera.h) * float(np.sqrt(self.covariance[k, k])) for k in (1, 2))
        return x, y

    @property
    def sigma_k1(self) -> float:
        """1 sigma of the first term of the distortion."""
        return float(np.sqrt(self.covariance[3, 3]))


def estimate_camera(
    frames: Sequence[FrameOfCamera],
    camera: Device,
    projector: Device,
    sigma: float,
    seed: int = 0,
    current: Device | None = None,
    settings: CameraEstimateSettings = CAMERA_ESTIMATE_DEFAULTS,
) -> CameraEstimate:
    """The camera with the smallest epipolar errors of all frames together, near the stated one.

    `sigma` is the relative uncertainty of the stated focal length; `current` is the camera with which the poses of the
    frames were found, by default the stated one. Raises ValueError without frames.
    """
    if not frames:
        raise ValueError("no frames")
    rng = np.random.default_rng(seed)
    chosen = [subsample(np.arange(len(frame.uv_camera)), settings.most, rng) for frame in frames]
    prior = np.diag(1 / np.square([sigma, settings.sigma_centre, settings.sigma_centre, settings.sigma_k1]))
    poses, value = [frame.pose for frame in frames], _change(camera, current or camera)
    information = prior

    def rays_at(where: Float64[ndarray, "4"]) -> list[RayPairs]:
        device = changed(camera, where)
        return [
            ray_pairs(frame.uv_camera[index], frame.uv_projector[index], device, projector)[0]
            for frame, index in zip(frames, chosen, strict=True)
        ]

    for _ in range(settings.iterations):
        rays = rays_at(value)
        around = [(rays_at(value + h), rays_at(value - h)) for h in settings.difference_step * np.eye(len(UNKNOWNS))]
        residuals = np.concatenate([sampson(*pose, own) for pose, own in zip(poses, rays, strict=True)])
        width = settings.kernel_sigmas * noise_of(residuals)
        normals = [
            _normal(poses[k], rays[k], [(ahead[k], behind[k]) for ahead, behind in around], width, settings)
            for k in range(len(frames))
        ]
        H, g = sum(n.H for n in normals), sum(n.g for n in normals)
        spread = sum(n.block_gradients.T @ n.block_gradients for n in normals)
        scale = max(float(np.mean(np.diag(spread) / np.diag(H).clip(1e-300))), 1e-12)  # squared error of a measurement
        information = H / scale + prior
        step = np.linalg.solve(information, -g / scale - prior @ value)
        step *= min(1.0, settings.largest_step / max(float(np.abs(step).max()), 1e-300))
        value = value + step
        poses = [moved(*pose, n.pose_step - n.pose_slope @ step) for pose, n in zip(poses, normals, strict=True)]
        if np.abs(step).max() < settings.converged:
            break
    return CameraEstimate(changed(camera, value), np.linalg.inv(information))


def changed(camera: Device, value: Float64[ndarray, "4"]) -> Device:
    """The camera after a change of the logarithm of its focal length, its centre (shares of the longer side) and k1."""
    factor, side = float(np.exp(value[0])), max(camera.w, camera.h)
    return replace(
        camera,
        fl_x=camera.fl_x * factor,
        fl_y=camera.fl_y * factor,
        cx=camera.cx + side * float(value[1]),
        cy=camera.cy + side * float(value[2]),
        k1=camera.k1 + float(value[3]),
    )


def _change(camera: Device, other: Device) -> Float64[ndarray, "4"]:
    """The change that makes a camera the other one."""
    side = max(camera.w, camera.h)
    x, y = (other.cx - camera.cx) / side, (other.cy - camera.cy) / side
    return np.array([np.log(other.fl_x / camera.fl_x), x, y, other.k1 - camera.k1])


@dataclass(frozen=True)
class _Normal:
    """Normal equations of one frame with the pose eliminated: what it adds for the camera."""

    H: Float64[ndarray, "4 4"]
    g: Float64[ndarray, "4"]
    block_gradients: Float64[ndarray, "blocks 4"]
    pose_step: Float64[ndarray, "5"]  # of the pose while the camera stays
    pose_slope: Float64[ndarray, "5 4"]  # change of the pose with the camera


def _normal(
    pose: CameraUnitPose,
    rays: RayPairs,
    around: Sequence[tuple[RayPairs, RayPairs]],
    width: float,
    settings: CameraEstimateSettings,
) -> _Normal:
    """`around`: the same correspondences with each unknown of the camera larger and smaller."""
    apart = 2 * settings.difference_step
    r, J = sampson_jacobian(*pose, rays)
    j = np.stack([(sampson(*pose, ahead) - sampson(*pose, behind)) / apart for ahead, behind in around], 1)
    w = geman_mcclure_weight((r / width) ** 2)[:, None]
    A = (J * w).T @ J
    slope = np.linalg.lstsq(A, (J * w).T @ j, rcond=1e-13)[0]
    unexplained = j - J @ slope  # what the frame's own pose cannot explain
    weighted = w * r[:, None] * unexplained
    pose_step = -np.linalg.lstsq(A, (J * w).T @ r, rcond=1e-13)[0]
    return _Normal((unexplained * w).T @ unexplained, weighted.sum(0), rays.block_sums(weighted), pose_step, slope)


Role = Literal["projector", "camera"]
Part = Literal["focal length", "principal point", "focal length and principal point"]
_PARTS: dict[Part, tuple[int, ...]] = {"focal length": (0,), "principal point": (1, 2)}


@dataclass(frozen=True)
class DeviceEvidence:
    """What the frames say of one device, if the other one is right. Shares are of its focal length."""

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
    """What the frames say of both devices, each alone."""

    projector: DeviceEvidence
    camera: DeviceEvidence

    def allowing(self, doubt: Float64[ndarray, "3 3"]) -> "IntrinsicsEvidence":
        """With stated values that are themselves uncertain; covariance of shares of the focal length."""
        return IntrinsicsEvidence(
            *(replace(one, covariance=one.covariance + doubt) for one in (self.projector, self.camera))
        )

    def contradicts(self, settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS) -> bool:
        """Whether the stated intrinsics cannot be right."""
        return all(
            one.chi_square > settings.contradiction and bool((np.abs(one.change) > settings.least_change).any())
            for one in (self.projector, self.camera)
        )

    def explanations(self, settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS) -> list[Explanation]:
        """What would explain the contradiction: a single part of one device, if one does; else either device.

        A wrong projector and a wrong camera look alike. But a focal length of the one is focal length and principal
        point of the other, so that few wrong values tell whose they are.
        """
        both: tuple[tuple[Role, DeviceEvidence], ...] = (("projector", self.projector), ("camera", self.camera))
        found = [_alone(role, one, part) for role, one in both for part in _PARTS]
        enough = [e for e in found if e.left < settings.explained]
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
    settings: UnknownProjectorSettings = UNKNOWN_PROJECTOR_DEFAULTS,
) -> IntrinsicsEvidence:
    """Test of the stated values. `poses` are those found with them; cameras must all have the same intrinsics."""
    swapped = [FrameMatches(f.name, f.uv_projector, f.uv_camera, projector) for f in frames]
    turned = [(R.T, -R.T @ t) for R, t in poses]
    return IntrinsicsEvidence(
        _evidence(frames, poses, projector, seed, settings),
        _evidence(swapped, turned, frames[0].camera, seed, settings),
    )


def _evidence(
    frames: Sequence[FrameMatches],
    poses: Sequence[UnitPose],
    device: Device,
    seed: int,
    settings: UnknownProjectorSettings,
) -> DeviceEvidence:
    most = max(min(settings.fit.most_per_frame, settings.check_most // len(frames)), 1)
    matches = PointMatches.of(frames, device, settings.blocks, most, np.random.default_rng(seed))
    prior = Prior(values_of(device), prior_sigma(settings.prior))
    held = JointProblem(matches, device, (), prior, settings.fit).fit(Poses.of(poses))
    free = JointProblem(matches, device, FOCAL_AND_CENTRE, prior, settings.fit).fit(held.poses)
    index, focal = list(FOCAL_AND_CENTRE), device.fl_x
    step = (values_of(free.projector) - values_of(device))[index]
    unit = np.array([1.0, device.w / focal, device.w / focal])
    return DeviceEvidence(device, step * unit, free.covariance * np.outer(unit, unit), (held.noise_px, free.noise_px))
