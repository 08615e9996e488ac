"""A change of intrinsics in the units that people think in."""

from collections.abc import Sequence
from statistics import median

from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange


def describe_change(
    change: IntrinsicsChange, sigma: IntrinsicsChange, cameras: Sequence[Device], projector: Device
) -> list[str]:
    """One line a device: focal length in percent, principal point in pixels, each with 1 sigma."""
    lines = []
    camera_focal = median(camera.fl_x for camera in cameras)
    for name, focal, value, error in (
        ("camera", camera_focal, change.camera, sigma.camera),
        ("projector", projector.fl_x, change.projector, sigma.projector),
    ):
        lines.append(
            f"{name}: focal length {100 * value.focal:+.2f} ± {100 * error.focal:.2f} %, principal point "
            f"({focal * value.x:+.1f} ± {focal * error.x:.1f}, {focal * value.y:+.1f} ± {focal * error.y:.1f}) px"
        )
    return lines
