"""What the U-Net reads in a view, and its return to the pixels of the capture."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.decoding.grid.channels import VIEW_PERIOD, network_channels
from sl_nerfstudio.decoding.grid.graph import PhaseMaps, phase_maps
from sl_nerfstudio.decoding.grid.rectify import GridLook, RectifiedImage, integer_centres
from sl_nerfstudio.decoding.grid.unet import STRIDE, UNet

_LEAST_MASK = 0.4
_LEAST_VECTOR = 0.35  # length of a phase's (cosine, sine) below which it says nothing


@dataclass(frozen=True)
class PixelPhases:
    """Phases at the capture's own pixels."""

    phase: Float32[ndarray, "h w 2"]  # periods, within half a one of zero
    mask: Bool[ndarray, "h w"]  # the pattern is there
    clear: Bool[ndarray, "h w"]  # and its phases can be read


def read_view(view: RectifiedImage, network: UNet) -> PhaseMaps:
    """Mask, phases and symbols of a view."""
    channels = torch.from_numpy(network_channels(view.image))[None].contiguous(memory_format=torch.channels_last)
    with torch.inference_mode():
        reading = network(channels)
        mask = torch.sigmoid(reading.mask[0])
    return phase_maps(mask.numpy(), reading.phase[0].contiguous().numpy(), reading.symbol[0].contiguous().numpy())


def measured_look(maps: PhaseMaps, look: GridLook) -> GridLook | None:
    """How the grid appears by the phases that were read: tells whether `look`, which the view was made by, was right.

    None where hardly any phase was read.
    """
    read = (maps.mask > 0.5) & (np.hypot(maps.vector[0], maps.vector[1]) > 0.6)
    if read.sum() < 20:
        return None
    jacobian = np.moveaxis(maps.gradient[:, :, read], -1, 0) / STRIDE
    area = np.median(np.abs(np.linalg.det(jacobian)))
    middle = np.median(jacobian, axis=0)
    # where lines of constant y run, and lines of constant x, both as an angle from their own axis
    tilt = np.arctan2(-middle[1, 0], middle[1, 1]), np.arctan2(middle[0, 1], middle[0, 0])
    period = look.period * float(np.clip(area, 1e-4, 1) ** -0.5) / VIEW_PERIOD
    return GridLook(period, look.roll + float(np.mean(tilt)))


def to_pixels(maps: PhaseMaps, view: RectifiedImage, shape: tuple[int, int]) -> PixelPhases:
    """Bilinear look-up of the maps at the pixels of the capture."""
    matrix = map_from_pixels(view)
    layers = np.dstack([maps.mask, *maps.vector])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    parts = [
        np.atleast_3d(cv2.warpAffine(np.ascontiguousarray(layers[..., k]), matrix, shape[::-1], flags=flags))
        for k in (slice(0, 1), slice(1, 5))
    ]
    mask, vector = parts[0][..., 0], parts[1]
    phase = np.stack([np.arctan2(vector[..., 1], vector[..., 0]), np.arctan2(vector[..., 3], vector[..., 2])], -1)
    strength = np.minimum(np.hypot(vector[..., 0], vector[..., 1]), np.hypot(vector[..., 2], vector[..., 3]))
    seen = mask > _LEAST_MASK
    return PixelPhases((phase / (2 * np.pi)).astype(np.float32), seen, seen & (strength > _LEAST_VECTOR))


def map_from_pixels(view: RectifiedImage) -> Float64[ndarray, "2 3"]:
    """From pixels (x, y, 1) of the capture to the network's maps; in both the first centre is 0."""
    to_map = np.array([[1 / STRIDE, 0, 0.5 / STRIDE - 0.5], [0, 1 / STRIDE, 0.5 / STRIDE - 0.5]])
    return to_map @ np.vstack([integer_centres(view.from_image), [0.0, 0.0, 1.0]])


def to_pixel_coordinates(place: Float32[ndarray, "n 2"], view: RectifiedImage) -> Float32[ndarray, "n 2"]:
    """Places (x, y) in the maps as continuous pixel coordinates of the capture (centres at .5)."""
    linear, shift = view.from_image[:, :2], view.from_image[:, 2]
    return np.linalg.solve(linear, (STRIDE * (place + 0.5) - shift).T).T.astype(np.float32)
