"""The device models by name. A new one is a file beside `pinhole`, an entry in `MODELS` and a branch in `pixel_of`."""

from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.geometry.devices import doe, pinhole
from sl_nerfstudio.geometry.devices.device import Device, DeviceKind
from sl_nerfstudio.geometry.devices.distortion import distort


@dataclass(frozen=True)
class DeviceModel:
    """The part of a device that differs between models; lens distortion, focal lengths and principal point do not."""

    code: int  # identifies the model in compiled loops
    normalised_anywhere: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
    jacobian: Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]
    direction: Callable[[Tensor, Tensor], Tensor]


MODELS: dict[DeviceKind, DeviceModel] = {
    "OPENCV": DeviceModel(0, pinhole.normalised_anywhere, pinhole.jacobian, pinhole.direction),
    "DOE": DeviceModel(1, doe.normalised_anywhere, doe.jacobian, doe.direction),
}


def for_loops(device: Device) -> tuple[int, Float64[ndarray, "8"]]:
    """What compiled loops take for a device: the code of its model, and its PARAMETERS."""
    return MODELS[device.model].code, device.parameters


_pinhole, _pinhole_in_front = compiled(pinhole.normalised), compiled(pinhole.in_front)
_doe, _doe_in_front = compiled(doe.normalised), compiled(doe.in_front)
_distort = compiled(distort)


@compiled
def pixel_of(code, x, y, z, parameters):
    """`project` for one point, in compiled loops: column, row, and whether the point is in front.

    `parameters` are ordered as PARAMETERS. Unlike `project`, it does not detect where the distortion polynomial folds
    back.
    """
    if code == 0:
        front = _pinhole_in_front(x, y, z)
        xn, yn = _pinhole(x, y, z if front else -1.0)
    else:
        front = _doe_in_front(x, y, z)
        xn, yn = _doe(x, y, z)
    xd, yd = _distort(xn, yn, parameters[4], parameters[5], parameters[6], parameters[7])
    return parameters[0] * xd + parameters[2], parameters[1] * yd + parameters[3], front
