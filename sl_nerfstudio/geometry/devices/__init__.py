"""Cameras and projectors: from directions to pixels, and back; one file per device model.

In: intrinsics with points in device axes, or with pixels. Out: pixels, or unit directions, and derivatives.

Device axes: a device looks along its own -z, with +x to the right and +y up (OpenGL, nerfstudio).
Pixels: continuous, the centre of the first pixel is (0.5, 0.5), x to the right, y down.
"""

from sl_nerfstudio.geometry.devices.changes import UNCHANGED, DeviceChange, IntrinsicsChange
from sl_nerfstudio.geometry.devices.device import DEVICE_FIELDS, PARAMETERS, Device, DeviceKind, Intrinsics
from sl_nerfstudio.geometry.devices.projection import project, project_jacobian, unproject

__all__ = [
    "DEVICE_FIELDS",
    "PARAMETERS",
    "UNCHANGED",
    "Device",
    "DeviceChange",
    "DeviceKind",
    "Intrinsics",
    "IntrinsicsChange",
    "project",
    "project_jacobian",
    "unproject",
]
