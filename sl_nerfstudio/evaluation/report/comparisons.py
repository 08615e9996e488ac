"""Captured and rendered pattern of a few frames, side by side."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.capture_agreement import CaptureAgreement
from sl_nerfstudio.evaluation.frame_pixels import FramePixels, frame_pixels
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.report.pictures import (
    NO_SURFACE,
    NO_VALUE,
    ColourScale,
    data_uri,
    pixel_map,
    residual_colours,
    shrink,
)
from sl_nerfstudio.evaluation.report.thumbnails import brightness_ratio
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.scan import Scan

_SIDE = 420


@dataclass(frozen=True)
class Comparison:
    """One frame's pictures as data addresses, all cropped in the same way."""

    name: str
    why: str  # why this frame is shown
    captured: str
    rendered: str
    difference: str
    cosine: float


def compare_frames(
    surface: IndexedMesh,
    scan: Scan,
    agreement: CaptureAgreement,
    poses: DevicePoses,
) -> list[Comparison]:
    """The frames with the best, the median and the worst pattern agreement."""
    pattern = scan.read_pattern()
    shown = []
    for index, why in _chosen(agreement):
        frame = scan.frames[index]
        pixels = frame_pixels(
            surface, frame, scan, pattern, poses.T_world_camera[index], poses.T_world_projector[index]
        )
        shown.append(_compare(frame.name, why, agreement.frames[index].pattern_cosine, pixels))
    return shown


def _chosen(agreement: CaptureAgreement) -> list[tuple[int, str]]:
    """Indices of frames, and why."""
    order = sorted(
        (i for i, f in enumerate(agreement.frames) if math.isfinite(f.pattern_cosine)),
        key=lambda i: -agreement.frames[i].pattern_cosine,
    )
    picks: dict[int, str] = {}
    for place, why in ((0, "best agreement"), (len(order) // 2, "median"), (-1, "worst agreement")):
        if order:
            picks.setdefault(order[place], why)
    return list(picks.items())


def _compare(name: str, why: str, cosine: float, pixels: FramePixels) -> Comparison:
    rendered = pixels.rendered * brightness_ratio(pixels)
    white = max(float(np.nanpercentile(pixels.captured, 99.5)), 1e-6) if len(pixels.captured) else 1.0
    return Comparison(
        name=name,
        why=why,
        captured=_picture(pixels, _grey(pixels.captured / white, pixels, np.ones_like(pixels.hit))),
        rendered=_picture(pixels, _grey(rendered / white, pixels, pixels.lit)),
        difference=_picture(pixels, _signed((pixels.captured - rendered) / white, pixels)),
        cosine=cosine,
    )


def _grey(values: Float[ndarray, "n"], pixels: FramePixels, known: ndarray) -> Float[ndarray, "n 3"]:
    rgb = np.repeat(np.clip(np.nan_to_num(values), 0, 1)[:, None], 3, axis=1)
    rgb[~known] = NO_VALUE
    rgb[~known & ~pixels.hit] = NO_SURFACE
    return rgb


def _signed(values: Float[ndarray, "n"], pixels: FramePixels) -> Float[ndarray, "n 3"]:
    return residual_colours(values, ColourScale("RdBu_r", -0.6, 0.6), ~pixels.hit)


def _picture(pixels: FramePixels, rgb: Float[ndarray, "n 3"]) -> str:
    return data_uri(shrink(pixel_map(pixels.row, pixels.column, pixels.stride, rgb), _SIDE), quality=85)
