"""The projector's intrinsics as a vector: logarithms of focal length and aspect, principal point in widths, k1."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.relative_pose.unknown_projector.settings import IntrinsicsPrior

NAMES = ("log_focal", "log_aspect", "cx", "cy", "k1")
LOG_FOCAL, LOG_ASPECT, CX, CY, K1 = range(len(NAMES))


def values_of(device: Device) -> Float64[ndarray, "5"]:
    """The vector of a device."""
    return np.array(
        [np.log(device.fl_x), np.log(device.fl_y / device.fl_x), device.cx / device.w, device.cy / device.w, device.k1]
    )


def device_with(device: Device, values: Sequence[float] | Float64[ndarray, "5"]) -> Device:
    """A device of the same image and model with other values; k2, p1, p2 stay."""
    focal = float(np.exp(values[LOG_FOCAL]))
    return replace(
        device,
        fl_x=focal,
        fl_y=focal * float(np.exp(values[LOG_ASPECT])),
        cx=float(values[CX]) * device.w,
        cy=float(values[CY]) * device.w,
        k1=float(values[K1]),
    )


def prior_sigma(prior: IntrinsicsPrior) -> Float64[ndarray, "5"]:
    """1 sigma of the vector."""
    return np.array([getattr(prior, name) for name in NAMES])
