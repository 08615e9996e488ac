"""Phases and symbols as the U-Net reads them in a rectified image, and their values at the pixels of the capture."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.decoding.grid.channels import RECTIFIED_PERIOD, network_channels
from sl_nerfstudio.decoding.grid.graph import GridGraph, PhaseMaps, phase_maps
from sl_nerfstudio.decoding.grid.rectify import GridAppearance, RectifiedImage, integer_centres
from sl_nerfstudio.decoding.grid.unet import STRIDE, UNet

# Pixels of the capture that are used.
LEAST_MASK = 0.4
"""Probability above which a pixel shows the pattern."""
_LEAST_VECTOR = 0.35  # length of a phase's (cosine, sine) below which the phase is unknown
# Places of the maps by which the grid's appearance is measured: only clear ones.
_CLEAR_MASK, _CLEAR_VECTOR = 0.5, 0.6
_FEWEST = 12


@dataclass(frozen=True)
class PixelPhases:
    """Phases at the pixels of the capture."""

    phase: Float32[ndarray, "h w 2"]  # periods, from -0.5 to 0.5
    probability: Float32[ndarray, "h w"]  # that the pattern is there
    clear: Bool[ndarray, "h w"]  # the pattern is there and its phases are known

    @property
    def mask(self) -> Bool[ndarray, "h w"]:
        """Pixels that show the pattern."""
        return self.probability > LEAST_MASK


def predict_maps(rectified: RectifiedImage, network: UNet) -> PhaseMaps:
    """Mask, phases and symbols of a rectified image."""
    channels = torch.from_numpy(network_channels(rectified.image))[None].contiguous(memory_format=torch.channels_last)
    with torch.inference_mode():
        output = network(channels)
        mask = torch.sigmoid(output.mask[0])
    return phase_maps(mask.numpy(), output.phase[0].contiguous().numpy(), output.symbol[0].contiguous().numpy())


def clear_places(maps: PhaseMaps) -> Bool[ndarray, "h w"]:
    """Places of the maps at which the network is certain."""
    return (maps.mask > _CLEAR_MASK) & (np.hypot(maps.vector[0], maps.vector[1]) > _CLEAR_VECTOR)


def node_places(maps: PhaseMaps, graph: GridGraph, chosen: Bool[ndarray, "n"]) -> Bool[ndarray, "h w"]:
    """The places of the chosen nodes of a graph."""
    where = np.zeros(maps.mask.shape, dtype=bool)
    column, row = np.rint(graph.place[chosen]).astype(int).T
    where[np.clip(row, 0, where.shape[0] - 1), np.clip(column, 0, where.shape[1] - 1)] = True
    return where


def measure_appearance(maps: PhaseMaps, guess: GridAppearance, where: Bool[ndarray, "h w"]) -> GridAppearance | None:
    """Period and roll of the grid in the capture by the phases at some places; `guess` is what it was rectified by.

    None where there are hardly any places.
    """
    if where.sum() < _FEWEST:
        return None
    jacobian = np.moveaxis(maps.gradient[:, :, where], -1, 0) / STRIDE
    area = np.median(np.abs(np.linalg.det(jacobian)))
    middle = np.median(jacobian, axis=0)
    # Directions of the lines of constant y and of constant x, each as an angle from its own axis.
    tilt = np.arctan2(-middle[1, 0], middle[1, 1]), np.arctan2(middle[0, 1], middle[0, 0])
    period = guess.period * float(np.clip(area, 1e-4, 1) ** -0.5) / RECTIFIED_PERIOD
    return GridAppearance(period, guess.roll + float(np.mean(tilt)))


def sample_pixels(maps: PhaseMaps, rectified: RectifiedImage, shape: tuple[int, int]) -> PixelPhases:
    """Bilinear values of the maps at the pixels of the capture, which has the given `shape` (h, w)."""
    matrix = map_from_pixels(rectified)
    layers = np.dstack([maps.mask, *maps.vector])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    parts = [
        np.atleast_3d(cv2.warpAffine(np.ascontiguousarray(layers[..., k]), matrix, shape[::-1], flags=flags))
        for k in (slice(0, 1), slice(1, 5))
    ]
    mask, vector = parts[0][..., 0], parts[1]
    phase = np.stack([np.arctan2(vector[..., 1], vector[..., 0]), np.arctan2(vector[..., 3], vector[..., 2])], -1)
    strength = np.minimum(np.hypot(vector[..., 0], vector[..., 1]), np.hypot(vector[..., 2], vector[..., 3]))
    clear = (mask > LEAST_MASK) & (strength > _LEAST_VECTOR)
    return PixelPhases((phase / (2 * np.pi)).astype(np.float32), mask, clear)


def map_from_pixels(rectified: RectifiedImage) -> Float64[ndarray, "2 3"]:
    """From pixels (x, y, 1) of the capture to places in the network's maps; in both the first centre is 0."""
    to_map = np.array([[1 / STRIDE, 0, 0.5 / STRIDE - 0.5], [0, 1 / STRIDE, 0.5 / STRIDE - 0.5]])
    return to_map @ np.vstack([integer_centres(rectified.from_image), [0.0, 0.0, 1.0]])


def to_pixel_coordinates(place: Float32[ndarray, "n 2"], rectified: RectifiedImage) -> Float32[ndarray, "n 2"]:
    """Places (x, y) in the maps as continuous pixel coordinates of the capture (centres at .5)."""
    linear, shift = rectified.from_image[:, :2], rectified.from_image[:, 2]
    return np.linalg.solve(linear, (STRIDE * (place + 0.5) - shift).T).T.astype(np.float32)
