"""Unknowns of the bundle adjustment: their order, the prior, the gauge, which are free, and the intrinsics.

Unknowns of the poses are the increments delta and rho of `residuals`; those of the intrinsics, common to all frames,
are changes as shares of the focal length, in the order of `IntrinsicsChange.values`.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Shaped
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import WIDE_HALF_WINDOW, CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import with_common_normals
from sl_nerfstudio.bundle_adjustment.residuals import OWN_PLACE_PX, Anchors, Linearisation, Observations, Rig, linearise
from sl_nerfstudio.geometry.devices import UNCHANGED, Intrinsics, IntrinsicsChange, project, project_jacobian
from sl_nerfstudio.geometry.lie import (
    Similarity,
    adjoint,
    departures,
    fit_similarity,
    hat,
    inverse,
    pose,
    rotate,
    transform,
)

# The order of the unknowns: frame by frame (delta, then rho of each), or delta of all frames, then rho of all.


def by_frame(values: Shaped[Tensor, "unknowns *k"]) -> Shaped[Tensor, "frames 12 *k"]:
    """Reorder delta of all frames, then rho of all, to delta and rho of each frame."""
    n = len(values) // 12
    return values.reshape(2, n, 6, *values.shape[1:]).transpose(0, 1).reshape(n, 12, *values.shape[1:])


def by_kind(values: Shaped[Tensor, "frames 12 *k"]) -> Shaped[Tensor, "unknowns *k"]:
    """The inverse of `by_frame`."""
    n = len(values)
    return values.reshape(n, 2, 6, *values.shape[2:]).transpose(0, 1).reshape(12 * n, *values.shape[2:])


# What is known about poses and intrinsics before any residual is computed.

INTRINSICS_SIGMA = 0.005  # share of the focal length; unstated intrinsics are assumed accurate to this
USUAL_FRAME_ROTATION_DEG = 2.0  # 1 sigma about each axis of a starting pose, if it is not stated


@dataclass(frozen=True)
class PosePrior:
    """How well starting poses and intrinsics are known: 1 sigma; lengths in the scene's unit, angles in radian."""

    frame_translation: Float[Tensor, "frames"]
    frame_rotation: Float[Tensor, "frames"]
    relative_translation: Float[Tensor, "frames"]
    relative_rotation: Float[Tensor, "frames"]
    intrinsics: float = INTRINSICS_SIGMA  # focal lengths and principal points, as a share of the focal length
    intrinsics_change: IntrinsicsChange = UNCHANGED  # of the devices, relative to the stated intrinsics
    projector_intrinsics: tuple[float, float, float] | None = None  # focal length, x, y, if known otherwise

    @property
    def intrinsics_sigma(self) -> Float[Tensor, "6"]:
        """1 sigma of the intrinsics, in the order of `IntrinsicsChange.values`."""
        camera = (self.intrinsics,) * 3
        return torch.tensor([*camera, *(self.projector_intrinsics or camera)], dtype=torch.float64)

    @property
    def sigma(self) -> Float[Tensor, "frames 12"]:
        """1 sigma of every frame's delta and rho: translation xyz, rotation xyz each."""
        parts = (self.frame_translation, self.frame_rotation, self.relative_translation, self.relative_rotation)
        return torch.stack(parts, 1).repeat_interleave(3, 1)


@dataclass(frozen=True)
class PriorTerm:
    """The prior's part of the objective: squared differences from the starting poses in units of their sigma.

    `weight` converts it to the unit of the data's part (px^2).
    """

    prior: PosePrior
    start: Rig
    weight: float

    def energy(self, rig: Rig) -> float:
        """The term itself; half its gradient is that of `equations`."""
        return float(self.energies(rig).sum())

    def energies(self, rig: Rig) -> Float[Tensor, "frames"]:
        """The term of each frame."""
        return self.weight * (_departure(self.start, rig) / self.prior.sigma).square().sum(1)

    def equations(self, rig: Rig) -> tuple[Float[Tensor, "frames 12 12"], Float[Tensor, "frames 12"]]:
        """Information matrix and gradient by the increments (delta, rho) of each frame."""
        H, g = prior_equations(self.prior, self.start, rig)
        return self.weight * H, self.weight * g


def prior_equations(
    prior: PosePrior, start: Rig, rig: Rig
) -> tuple[Float[Tensor, "frames 12 12"], Float[Tensor, "frames 12"]]:
    """Information matrix and gradient of the difference from the starting poses, by (delta, rho) of each frame."""
    n = rig.frames
    weight = 1 / prior.sigma**2
    w_frame, w_relative = weight[:, :6], weight[:, 6:]
    t = rig.T_camera_projector[:, :3, 3]
    eye = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
    J = torch.cat([torch.cat([eye, -hat(t)], -1), torch.cat([torch.zeros_like(eye), eye], -1)], -2)
    JtW = J.transpose(1, 2) * w_relative[:, None, :]
    H = torch.zeros(n, 12, 12, dtype=torch.float64)
    H[:, :6, :6] = torch.diag_embed(w_frame)
    H[:, 6:, 6:] = JtW @ J
    departure = _departure(start, rig)
    g_relative = (JtW @ departure[:, 6:, None]).squeeze(-1)
    return H, torch.cat([w_frame * departure[:, :6], g_relative], 1)


def _departure(start: Rig, rig: Rig) -> Float[Tensor, "frames 12"]:
    """Difference of the current poses from the starting ones.

    Increment of each frame as a whole, change of its projector's position in camera axes, and its rotation vector.
    """
    pairs = (start.T_world_camera, rig.T_world_camera, start.T_camera_projector, rig.T_camera_projector)
    out = np.empty((rig.frames, 12))
    departures(rig.frames, *(np.ascontiguousarray(T.numpy()) for T in pairs), out)
    return torch.from_numpy(out)


def rough_weight(noise: float, residuals_per_frame: float, independent: float) -> float:
    """Weight of the prior while residuals come from wrong poses rather than from noise.

    The residuals of a frame are then correlated: they count as `independent` measurements, however many there are.
    """
    return noise**2 * max(residuals_per_frame / independent, 1.0)


# The gauge: position, orientation and scale of the world, which no measurement fixes. After an adjustment the whole
# scene is moved by one similarity, which changes no residual. The scale is set to its known value (from a baseline, or
# from all lengths of the starting poses), else to the geometric mean of the baselines; position and orientation to the
# best agreement with the starting poses, in least squares.

_MOST_STEPS, _CONVERGED = 50, 1e-12  # of the logarithm of the scale


def baseline_scale(start: Rig, rig: Rig, frame: int | None) -> float:
    """The factor that gives `rig` the baseline that `frame` has in `start`; for None, the geometric mean of all."""
    log_ratio = torch.log(start.baseline / rig.baseline)
    return float(torch.exp(log_ratio.mean() if frame is None else log_ratio[frame]))


def agreeing_scale(start: Rig, rig: Rig, prior: PosePrior) -> float:
    """The factor for which all lengths of `rig`, between frames and within them, agree best with the starting poses.

    It maximises the prior over similarities. A small rotation of the projectors against their cameras looks like a
    longer baseline (by distance^2 / baseline: at 270 mm and 26 mm, 0.1 degree is 2 %). If the positions of the frames
    are known, too, they determine the scale better.
    """
    scale = baseline_scale(start, rig, None)
    for _ in range(_MOST_STEPS):
        now = restore(start, rig, scale)
        H, g = prior_equations(prior, start, now)
        G = by_frame(gauge_directions(now))
        information, gradient = (G.transpose(1, 2) @ H @ G).sum(0), (G.transpose(1, 2) @ g[..., None]).sum(0)[:, 0]
        step = float(torch.linalg.solve(information, -gradient)[6])
        scale *= math.exp(step)
        if abs(step) < _CONVERGED:
            break
    return scale


def restore(start: Rig, rig: Rig, scale: float) -> Rig:
    """The adjusted rig, `scale` times as large, aligned with the position and orientation of the start."""
    S, scaled = alignment(start, rig, scale), rig.scaled(scale)
    T = pose(torch.from_numpy(S.R), torch.from_numpy(S.t))
    return Rig(rig.camera, rig.projector, T @ scaled.T_world_camera, scaled.T_camera_projector)


def alignment(start: Rig, rig: Rig, scale: float) -> Similarity:
    """The motion that aligns the rig, after it is made `scale` times as large, with the cameras of the start."""
    ahead = start.T_world_camera[:, :3, 3].norm(dim=-1, keepdim=True)
    points = _axes_points(rig.scaled(scale), ahead).numpy(), _axes_points(start, ahead).numpy()
    return fit_similarity(*points, with_scale=False)


def gauge_directions(rig: Rig) -> Float[Tensor, "unknowns 7"]:
    """Increments (delta, rho) that move the whole scene by a similarity and change no residual."""
    n = rig.frames
    out = torch.zeros(2, n, 6, 7, dtype=torch.float64)
    out[0, :, :, :6] = torch.eye(6, dtype=torch.float64)
    out[0, :, :3, 6] = rig.T_world_camera[:, :3, 3]
    out[1, :, :3, 6] = rig.T_camera_projector[:, :3, 3]
    return out.reshape(12 * n, 7)


def of_baselines(rig: Rig, frame: int | None) -> Float[Tensor, "unknowns"]:
    """Derivative of the logarithm of one frame's baseline; for None, of the geometric mean of all."""
    n, t = rig.frames, rig.T_camera_projector[:, :3, 3]
    each = t / (t * t).sum(-1, keepdim=True)
    out = torch.zeros(2, n, 6, dtype=torch.float64)
    if frame is None:
        out[1, :, :3] = each / n
    else:
        out[1, frame, :3] = each[frame]
    return out.reshape(12 * n)


def gauge_projection(rig: Rig, frame: int | None = None) -> Float[Tensor, "unknowns unknowns"]:
    """Projection of increments (delta, rho) onto those that `restore` leaves: no motion and no growth as a whole.

    The length that is known is the baseline of `frame`, or for None the geometric mean of all baselines. (An
    S-transformation: Baarda 1973.)
    """
    n, G = rig.frames, gauge_directions(rig)
    fixed = torch.zeros(7, 12 * n, dtype=torch.float64)
    ahead = rig.T_world_camera[:, :3, 3].norm(dim=-1, keepdim=True)
    points = _axes_points(rig, ahead).reshape(2, n, 3)
    J = torch.cat([torch.eye(3, dtype=torch.float64).expand(2, n, 3, 3), -hat(points)], -1)
    fixed[:6, : 6 * n] = (J.transpose(-1, -2) @ J).sum(0).transpose(0, 1).reshape(6, 6 * n)
    fixed[6] = of_baselines(rig, frame)
    return torch.eye(12 * n, dtype=torch.float64) - G @ torch.linalg.solve(fixed @ G, fixed)


def _axes_points(rig: Rig, distance: Float[Tensor, "frames 1"]) -> Float[Tensor, "n 3"]:
    """Camera centres, and for each the point `distance` in front of it, near the scene's centre.

    Points near the scene count as much as the distant cameras, so rotating one camera has an effect, too.
    """
    T = rig.T_world_camera
    centre = T[:, :3, 3]
    axis = rotate(T, torch.tensor([0.0, 0.0, -1.0], dtype=T.dtype).expand(len(T), 3))
    return torch.cat([centre, centre + distance * axis])


# Which parameters are free while poses are refined.

RefinePoses = Literal["free", "rigid-rig", "known-rig", "static-projector", "off"]


@dataclass(frozen=True)
class FreeParameters:
    """A basis of the increments (delta, rho) that are free: of each frame its own, and some that all frames share.

    Parameters are ordered frame by frame, the shared ones last.
    """

    of: int  # number of all frames
    frames: Int[Tensor, "m"]  # those that move
    own: Float[Tensor, "m 12 k"]  # each one's increments by its own parameters; with k = 12, the identity
    shared: Float[Tensor, "m 12 s"]

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.own.shape[0] * self.own.shape[2] + self.shared.shape[2]

    def step(self, x: Float[Tensor, "count"]) -> Float[Tensor, "of 12"]:
        """Increments of all frames."""
        return self.steps(x[:, None])[..., 0]

    def steps(self, x: Float[Tensor, "count c"]) -> Float[Tensor, "of 12 c"]:
        """Increments of all frames, for several sets of parameters at once."""
        m, _, k = self.own.shape
        out = torch.zeros(self.of, 12, x.shape[1], dtype=x.dtype)
        mine = x[: m * k].reshape(m, k, x.shape[1])
        if k != 12:
            mine = self.own @ mine
        if self.shared.shape[2]:
            mine = mine + self.shared @ x[m * k :]
        out[self.frames] = mine
        return out

    def vector(self, g: Float[Tensor, "m 12 *c"]) -> Float[Tensor, "count *c"]:
        """A gradient by the increments of the frames that move, as one by the parameters."""
        columns = g.reshape(*g.shape[:2], -1)
        mine = columns if self.own.shape[2] == 12 else self.own.transpose(1, 2) @ columns
        shared = (self.shared.transpose(1, 2) @ columns).sum(0)
        return torch.cat([mine.flatten(0, 1), shared]).reshape(self.count, *g.shape[2:])

    def matrix(self, H: Float[Tensor, "unknowns unknowns"]) -> Float[Tensor, "parameters parameters"]:
        """A normal matrix by the parameters; unknowns after those of the frames stay. It may be `H` itself."""
        if self.own.shape[2] == 12 and not self.shared.shape[2]:
            return H
        return self._rows(self._rows(H).T)

    def _rows(self, H: Float[Tensor, "unknowns c"]) -> Float[Tensor, "parameters c"]:
        m = len(self.own)
        return torch.cat([self.vector(H[: 12 * m].reshape(m, 12, -1)), H[12 * m :]])


def free_parameters(refine: RefinePoses, rig: Rig) -> FreeParameters:
    """Parameters that a choice leaves free at a rig."""
    n = rig.frames
    eye = torch.eye(12, dtype=torch.float64).expand(n, 12, 12)
    own, shared = eye[..., :6], eye[..., :0]
    if refine == "free":
        own = eye
    elif refine == "rigid-rig":
        shared = eye[..., 6:]
    elif refine == "static-projector":
        # T_world_camera exp(rho) = exp(-delta) T_world_camera: the projector stays, the camera moves
        own = torch.cat([eye[:, :6, :6], -adjoint(inverse(rig.T_world_camera))], 1)
    elif refine == "off":
        own = eye[..., :0]
    return FreeParameters(n, torch.arange(n), own, shared)


def constrained(refine: RefinePoses, rig: Rig) -> Rig:
    """A starting rig that satisfies a choice: a pose that all frames share is replaced by its mean over the frames."""
    if refine == "rigid-rig":
        mean = mean_pose(rig.T_camera_projector)
        return Rig(rig.camera, rig.projector, rig.T_world_camera, mean.expand_as(rig.T_camera_projector).clone())
    if refine == "static-projector":
        # relative poses come from each frame's own coordinates: they are better known than the frames' world poses
        camera = mean_pose(rig.T_world_projector) @ inverse(rig.T_camera_projector)
        return Rig(rig.camera, rig.projector, camera, rig.T_camera_projector)
    return rig


def mean_pose(T: Float[Tensor, "n 4 4"]) -> Float[Tensor, "4 4"]:
    """The chordal mean of rotations with the mean of translations."""
    U, _, Vt = torch.linalg.svd(T[:, :3, :3].mean(0))
    sign = torch.tensor([1.0, 1.0, float(torch.det(U @ Vt).sign())], dtype=T.dtype)
    return pose((U * sign) @ Vt, T[:, :3, 3].mean(0))


# Self-calibration (Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 3): one Gauss-Newton step of
# the intrinsics shows how much better other values would agree. It is reported, not taken. Poses that were adjusted
# with wrong intrinsics have absorbed part of the error, and their stated uncertainty includes that part.

UNKNOWNS = 6  # focal length, centre x, centre y: of all cameras together, then of the projector
_CONTRADICTION = 50.0  # chi square of six above which the captures contradict the intrinsics: by chance once in 10^8,
# but the errors of blocks of pixels are not independent
_LEAST_CHANGE = 1e-3  # share of the focal length below which no change is reported: no calibration is that good


@dataclass(frozen=True)
class SelfCalibration:
    """The change of the intrinsics that agrees best with the captures, and how well it is known."""

    change: Float[Tensor, "6"]  # shares of the focal length
    covariance: Float[Tensor, "6 6"]

    @staticmethod
    def of(change: IntrinsicsChange, covariance: Float[Tensor, "6 6"]) -> "SelfCalibration":
        """The record of a change in plain numbers."""
        return SelfCalibration(torch.tensor(change.values, dtype=torch.float64), covariance)

    @property
    def sigma(self) -> Float[Tensor, "6"]:
        """1 sigma of each change."""
        return self.covariance.diagonal().sqrt()

    def of_projector(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
        """Change of the projector alone, and its covariance, if the cameras' intrinsics are right."""
        C, gain = self.covariance, self._projector_by_camera
        return self.change[3:] - gain @ self.change[:3], C[3:, 3:] - gain @ C[:3, 3:]

    def projector_by_camera(self, camera_sigma: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
        """Covariance that `of_projector` has besides if the cameras' intrinsics are right within 1 sigma only."""
        moved = self._projector_by_camera * torch.tensor(camera_sigma, dtype=self.covariance.dtype)
        return moved @ moved.T

    @property
    def _projector_by_camera(self) -> Float[Tensor, "3 3"]:
        """How the projector follows the cameras."""
        C = self.covariance
        return torch.linalg.solve(C[:3, :3], C[:3, 3:]).T

    def allowing(self, sigma: Float64[ndarray, "6"]) -> "SelfCalibration":
        """Allow for stated values that are themselves uncertain, by 1 sigma each: no contradiction within it."""
        return SelfCalibration(self.change, self.covariance + torch.from_numpy(sigma).square().diag())

    @property
    def known(self) -> bool:
        """Whether there is an estimate at all; there is none if nothing was adjusted."""
        return bool(self.change.isfinite().all() and self.covariance.isfinite().all())

    @property
    def chi_square(self) -> float:
        """Squared length of the change in units of its uncertainty: about six if the intrinsics are correct."""
        return self.squared_length(self.change)

    def squared_length(self, change: Float[Tensor, "6"]) -> float:
        """Squared length of any change in units of this uncertainty."""
        return float(change @ torch.linalg.solve(self.covariance, change))

    def contradicts(self) -> bool:
        """Whether the captures show that the stated intrinsics are wrong."""
        large = self.known and bool((self.change.abs() > _LEAST_CHANGE).any())
        return large and self.chi_square > _CONTRADICTION


def linearise_with_intrinsics(
    linear: Linearisation, rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps
) -> Linearisation:
    """Add derivatives by the six intrinsics, which come after the poses."""
    i, j, a = anchors.frame, observations.frame, observations.anchor
    ray = rig.camera[i]
    K = project_jacobian(ray, anchors.d_camera)
    # A pixel is fixed, its ray is not: the ray turns to cancel the shift of the pixel that the intrinsics cause.
    turn = -K.transpose(1, 2) @ torch.linalg.solve(
        K @ K.transpose(1, 2), by_intrinsics(ray, project(ray, anchors.d_camera)[0])
    )
    move = anchors.depth[:, None, None] * turn
    own_point = -linear.own[..., :3]
    own_uv = linear.residuals.own + anchors.uv_projector

    p_j = transform(
        inverse(rig.T_world_camera)[j], transform(rig.T_world_camera[i], anchors.depth[:, None] * anchors.d_camera)[a]
    )
    uv_camera = project(rig.camera[j], p_j)[0]
    seen = maps.look_up(j, uv_camera, observations.memory)
    move_world = rig.T_world_camera[i, :3, :3] @ move
    # The point's pixel moves in the other image: what was decoded there is the view of a point beside, on the surface.
    ray_j = rig.camera[j]
    K_j = project_jacobian(ray_j, p_j)
    beside = K_j.transpose(1, 2) @ torch.linalg.solve(K_j @ K_j.transpose(1, 2), by_intrinsics(ray_j, uv_camera))
    from_surface = linear.cross[..., :3] @ (move_world[a] + rig.T_world_camera[j, :3, :3] @ beside)
    by_camera = from_surface + linear.cross[..., 12:15] @ beside  # that part is minus the derivative by the point alone
    by_projector = by_intrinsics(rig.projector, linear.residuals.cross + seen.uv_projector)
    return replace(
        linear,
        own=torch.cat([linear.own, own_point @ move, by_intrinsics(rig.projector, own_uv)], -1),
        cross=torch.cat([linear.cross, by_camera, by_projector], -1),
    )


def by_intrinsics(devices: Intrinsics, uv: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2 3"]:
    """Derivative of pixels by focal length and principal point, as shares of the focal length; distortion is fixed."""
    f, c = devices.params[..., :1], devices.params[..., 2:4]
    out = torch.zeros(*uv.shape, 3, dtype=uv.dtype)
    out[..., 0] = uv - c
    out[..., 0, 1] = out[..., 1, 2] = f[..., 0]
    return out


def with_smooth_derivatives(
    linear: Linearisation, rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps
) -> Linearisation:
    """Replace derivatives by those of wide windows, where a paraboloid fits them."""
    wide = maps.with_windows(WIDE_HALF_WINDOW)
    rows = Observations(observations.anchor, observations.frame)  # with a memory of its own
    found = linearise_with_intrinsics(linearise(rig, anchors, rows, wide), rig, anchors, rows, wide)
    fits = found.residuals.cross_valid
    return replace(
        linear,
        cross=torch.where(fits[:, None, None], found.cross, linear.cross),
        cross_depth=torch.where(fits[:, None], found.cross_depth, linear.cross_depth),
    )


def with_derivatives_along_surface(
    rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps
) -> Linearisation:
    """Residuals with the derivatives that the surface's normals give, which are the means of all frames that see it."""
    scene = rig, with_common_normals(rig, anchors, observations, maps), observations, maps
    return linearise_with_intrinsics(linearise(*scene, OWN_PLACE_PX), *scene)
