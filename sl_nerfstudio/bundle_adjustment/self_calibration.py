"""What the captures say of intrinsics that were taken for exact.

Focal length and principal point of both devices become six more unknowns of the joint adjustment, common to all
frames, and one Gauss-Newton step says how much better other values would agree (self-calibration; Triggs et al.,
Bundle Adjustment - A Modern Synthesis, 2000, section 3). The step is not taken here: it is told. Poses that were
adjusted with wrong intrinsics have taken up the difference, and by how much belongs to what is stated of their
uncertainty.

Changes are shares of the focal length: of the focal lengths themselves, and of the principal point's x and y.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, Rig
from sl_nerfstudio.geometry.devices import Device, Intrinsics, IntrinsicsChange, project, project_jacobian
from sl_nerfstudio.geometry.se3 import inverse, transform

UNKNOWNS = 6  # focal length, centre x, centre y: of all cameras together, then of the projector
# Chi square of six unknowns: chance makes it one time in 10^8, but blocks of pixels do not err independently.
_DOUBTED = 50.0
_LEAST = 1e-3  # of the focal length: what no calibration promises


@dataclass(frozen=True)
class SelfCalibration:
    """How much better other intrinsics would agree with the captures."""

    change: Float[Tensor, "6"]  # shares of the focal length
    covariance: Float[Tensor, "6 6"]

    @property
    def sigma(self) -> Float[Tensor, "6"]:
        """1 sigma of each change."""
        return self.covariance.diagonal().sqrt()

    @property
    def chi_square(self) -> float:
        """Squared length of the change in units of its uncertainty: about six if the intrinsics are right."""
        return float(self.change @ torch.linalg.solve(self.covariance, self.change))

    @property
    def serious(self) -> bool:
        """Whether the stated intrinsics cannot be right."""
        if not (self.change.isfinite().all() and self.covariance.isfinite().all()):  # nothing was refined
            return False
        return self.chi_square > _DOUBTED and bool((self.change.abs() > _LEAST).any())

    @staticmethod
    def of(change: IntrinsicsChange, covariance: Float[Tensor, "6 6"]) -> "SelfCalibration":
        """From a change in plain numbers."""
        return SelfCalibration(torch.tensor(change.values, dtype=torch.float64), covariance)

    def said(self, cameras: Sequence[Device], projector: Device) -> str:
        """What would agree better, for the person who calibrated; "" if the intrinsics may be right."""
        if not self.serious:
            return ""
        return "\n".join(
            [
                f"The intrinsics contradict the captures (chi square {self.chi_square:.0f}, by chance 6). These "
                "changes, together, would agree better:",
                *self.lines(cameras, projector),
                "    cause:  the calibration of a device is off, or belongs to another zoom, focus or image size",
                "    remedy: train with --pipeline.model.refine-intrinsics True, and if that does not help, calibrate\n"
                "            again; as it is, poses and surface take up the difference, which is part of the stated\n"
                "            uncertainty of the poses",
            ]
        )

    def lines(self, cameras: Sequence[Device], projector: Device) -> list[str]:
        """The change of each device, in percent and pixels."""
        parts = []
        camera_focal = median(camera.fl_x for camera in cameras)
        for name, focal, first in (("camera", camera_focal, 0), ("projector", projector.fl_x, 3)):
            units = torch.tensor([100.0, focal, focal])
            f, x, y = (units * self.change[first : first + 3]).tolist()
            f_sigma, x_sigma, y_sigma = (units * self.sigma[first : first + 3]).tolist()
            parts.append(
                f"    {name}: focal length {f:+.2f} ± {f_sigma:.2f} %, principal point "
                f"({x:+.1f} ± {x_sigma:.1f}, {y:+.1f} ± {y_sigma:.1f}) px"
            )
        return parts


def linearise_with_intrinsics(
    linear: Linearisation, rig: Rig, anchors: Anchors, observations: Observations, maps: CoordinateMaps
) -> Linearisation:
    """The same residuals, linearised by the six intrinsics, too: they follow the poses."""
    i, j, a = anchors.frame, observations.frame, observations.anchor
    ray = rig.camera[i]
    K = project_jacobian(ray, anchors.d_camera)
    # a pixel is fixed, its ray is not: the direction whose pixel moves back by what the intrinsics move it
    turn = -K.transpose(1, 2) @ torch.linalg.solve(
        K @ K.transpose(1, 2), by_intrinsics(ray, project(ray, anchors.d_camera)[0])
    )
    move = anchors.depth[:, None, None] * turn
    own_point = -linear.own[..., :3]
    own_uv = linear.residuals.own + anchors.uv_projector
    own = torch.cat([linear.own, own_point @ move, by_intrinsics(rig.projector, own_uv)], -1)

    p_j = transform(
        inverse(rig.T_world_camera)[j], transform(rig.T_world_camera[i], anchors.depth[:, None] * anchors.d_camera)[a]
    )
    uv_camera = project(rig.camera[j], p_j)[0]
    seen = maps.look_up(j, uv_camera)
    move_world = (rig.T_world_camera[i, :3, :3] @ move)[a]
    by_camera = linear.cross[..., :3] @ move_world - seen.jacobian @ by_intrinsics(rig.camera[j], uv_camera)
    by_projector = by_intrinsics(rig.projector, linear.residuals.cross + seen.uv_projector)
    columns = linear.unknowns + torch.arange(UNKNOWNS)
    return replace(
        linear,
        own=own,
        own_columns=torch.cat([linear.own_columns, columns.expand(len(i), UNKNOWNS)], 1),
        cross=torch.cat([linear.cross, by_camera, by_projector], -1),
        cross_columns=torch.cat([linear.cross_columns, columns.expand(len(j), UNKNOWNS)], 1),
        unknowns=linear.unknowns + UNKNOWNS,
    )


def by_intrinsics(devices: Intrinsics, uv: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2 3"]:
    """Derivative of pixels by focal length and principal point, as shares of the focal length; lens data stay."""
    f, c = devices.params[..., :1], devices.params[..., 2:4]
    out = torch.zeros(*uv.shape, 3, dtype=uv.dtype)
    out[..., 0] = uv - c
    out[..., 0, 1] = out[..., 1, 2] = f[..., 0]
    return out
