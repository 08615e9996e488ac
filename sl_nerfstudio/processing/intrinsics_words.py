"""What `sl-process` says about intrinsics that the captures contradict."""

from collections.abc import Sequence

from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.calibration.changes import describe_change
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange


def contradiction(found: SelfCalibration | None, cameras: Sequence[Device], projector: Device) -> str:
    """Which intrinsics would agree better; "" if the captures do not contradict the stated ones."""
    if found is None or not found.contradicts():
        return ""
    change, sigma = (IntrinsicsChange.of(values.tolist()) for values in (found.change, found.sigma))
    return "\n".join(
        [
            f"The intrinsics contradict the captures (chi square {found.chi_square:.0f}, by chance 6). These changes, "
            "together, would agree better:",
            *(f"    {line}" for line in describe_change(change, sigma, cameras, projector)),
            "    cause:  the calibration of a device is off, or was made with another zoom, focus or image size",
            "    remedy: calibrate again, or train with --pipeline.model.refine-intrinsics True",
        ]
    )
