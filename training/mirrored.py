"""Crops mirrored: a mirrored image of a mirrored pattern is as good an example."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

# Places among the channels of `sl_nerfstudio.decoding.grid_edges`.
_SINE_X, _SINE_Y = 9, 11
_MOVE_X, _MOVE_Y = 12, 13
_OF_X, _OF_Y = [8, 9, 12], [10, 11, 13]
_CONTINUED = 15  # the first of eight, counted by angle


class Crop(NamedTuple):
    """Channels of the network, coordinates, slopes (axis of the coordinate, then of the pixel) and true coordinates."""

    channels: Float32[ndarray, "c h w"]
    fitted: Float32[ndarray, "2 h w"]
    slope: Float32[ndarray, "2 2 h w"]
    true: Float32[ndarray, "2 h w"]


def mirrored(
    channels: Float32[ndarray, "c h w"], fitted: Float32[ndarray, "h w 2"], slope: Float32[ndarray, "h w 2 2"],
    true: Float32[ndarray, "h w 2"], how: int,
) -> Crop:  # fmt: skip
    """One of eight: 1 changes left and right, 2 above and below, 4 rows and columns; `how` is their sum."""
    if how & 1:
        channels = _turned_around(channels[:, :, ::-1], _SINE_X, _MOVE_X, 4)
        sign = np.array([-1, 1], dtype=np.float32)
        fitted, true, slope = fitted[:, ::-1] * sign, true[:, ::-1] * sign, slope[:, ::-1] * sign[:, None] * sign
    if how & 2:
        channels = _turned_around(channels[:, ::-1], _SINE_Y, _MOVE_Y, 0)
        sign = np.array([1, -1], dtype=np.float32)
        fitted, true, slope = fitted[::-1] * sign, true[::-1] * sign, slope[::-1] * sign[:, None] * sign
    if how & 4:
        channels = channels.transpose(0, 2, 1).copy()
        channels[_OF_X + _OF_Y] = channels[_OF_Y + _OF_X]
        channels[_CONTINUED:] = channels[_CONTINUED:][[(2 - k) % 8 for k in range(8)]]
        fitted, true = fitted.transpose(1, 0, 2)[..., ::-1], true.transpose(1, 0, 2)[..., ::-1]
        slope = slope.transpose(1, 0, 2, 3)[..., ::-1, ::-1]
    moved = (np.ascontiguousarray(np.moveaxis(part, (0, 1), (-2, -1))) for part in (fitted, slope, true))
    return Crop(channels, *moved)


def _turned_around(channels: Float32[ndarray, "c h w"], sine: int, move: int, first: int) -> Float32[ndarray, "c h w"]:
    """Channels of an image that was mirrored, with the signs and directions that follow from that."""
    out = channels.copy()
    out[[sine, move]] *= -1
    out[_CONTINUED:] = out[_CONTINUED:][[(first - k) % 8 for k in range(8)]]
    return out
