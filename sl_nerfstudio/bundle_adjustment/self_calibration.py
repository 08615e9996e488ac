"""How well the stated intrinsics agree with the captures.

Focal length and principal point of both devices become six more unknowns of the bundle adjustment, common to all
frames. One Gauss-Newton step shows how much better other values would agree (self-calibration: Triggs et al., Bundle
Adjustment - A Modern Synthesis, 2000, section 3). The step is reported, not taken. Poses that were adjusted with wrong
intrinsics have absorbed part of the error, and their stated uncertainty includes that part.

Changes are shares of the focal length, in the order of `IntrinsicsChange.values`.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, linearise
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.settings import SelfCalibrationSettings
from sl_nerfstudio.geometry.devices import Intrinsics, IntrinsicsChange, project, project_jacobian
from sl_nerfstudio.geometry.se3 import inverse, transform

UNKNOWNS = 6  # focal length, centre x, centre y: of all cameras together, then of the projector


@dataclass(frozen=True)
class SelfCalibration:
    """The change of the intrinsics that agrees best with the captures, and how well it is known."""

    change: Float[Tensor, "6"]  # shares of the focal length
    covariance: Float[Tensor, "6 6"]

    @staticmethod
    def of(change: IntrinsicsChange, covariance: Float[Tensor, "6 6"]) -> "SelfCalibration":
        """From a change in plain numbers."""
        return SelfCalibration(torch.tensor(change.values, dtype=torch.float64), covariance)

    @property
    def sigma(self) -> Float[Tensor, "6"]:
        """1 sigma of each change."""
        return self.covariance.diagonal().sqrt()

    def of_projector(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
        """Change of the projector alone, and its covariance, if the cameras' intrinsics are right."""
        C, gain = self.covariance, self._projector_by_camera()
        return self.change[3:] - gain @ self.change[:3], C[3:, 3:] - gain @ C[:3, 3:]

    def projector_by_camera(self, camera_sigma: tuple[float, float, float]) -> Float[Tensor, "3 3"]:
        """Covariance that `of_projector` has besides if the cameras' intrinsics are right within 1 sigma only."""
        moved = self._projector_by_camera() * torch.tensor(camera_sigma, dtype=self.covariance.dtype)
        return moved @ moved.T

    def _projector_by_camera(self) -> Float[Tensor, "3 3"]:
        """How the projector follows the cameras."""
        C = self.covariance
        return torch.linalg.solve(C[:3, :3], C[:3, 3:]).T

    def allowing(self, sigma: Float64[ndarray, "6"]) -> "SelfCalibration":
        """With stated values that are themselves uncertain, by 1 sigma each: no contradiction within it."""
        return SelfCalibration(self.change, self.covariance + torch.from_numpy(sigma).square().diag())

    @property
    def known(self) -> bool:
        """Whether there is an estimate at all; there is none if nothing was adjusted."""
        return bool(self.change.isfinite().all() and self.covariance.isfinite().all())

    @property
    def chi_square(self) -> float:
        """Squared length of the change in units of its uncertainty: about six if the intrinsics are correct."""
        return float(self.change @ torch.linalg.solve(self.covariance, self.change))

    def contradicts(self, settings: SelfCalibrationSettings | None = None) -> bool:
        """Whether the captures show that the stated intrinsics are wrong."""
        s = settings or SelfCalibrationSettings()
        if not self.known:
            return False
        return self.chi_square > s.contradiction and bool((self.change.abs() > s.least_change).any())


def linearise_with_intrinsics(
    linear: Linearisation, rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps
) -> Linearisation:
    """The same residuals with added derivatives by the six intrinsics, which come after the poses."""
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
    move_world = (rig.T_world_camera[i, :3, :3] @ move)[a]
    by_camera = linear.cross[..., :3] @ move_world - seen.jacobian @ by_intrinsics(rig.camera[j], uv_camera)
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
    """The same residuals; derivatives by poses and intrinsics from wide windows where a paraboloid fits them."""
    wide = maps.with_windows(maps.settings.wide_half_window)
    rows = Observations(observations.anchor, observations.frame)  # with a memory of its own
    found = linearise_with_intrinsics(linearise(rig, anchors, rows, wide), rig, anchors, rows, wide)
    fits = found.residuals.cross_valid
    return replace(
        linear,
        cross=torch.where(fits[:, None, None], found.cross, linear.cross),
        cross_depth=torch.where(fits[:, None], found.cross_depth, linear.cross_depth),
    )
