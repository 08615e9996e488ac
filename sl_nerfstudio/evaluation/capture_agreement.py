"""How well a mesh and the poses agree with the captures, frame by frame; the truth is not needed.

What `frame_pixels` predicts is compared with the decoded coordinates and, looked up in the pattern, with the captured
pattern image.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from sl_nerfstudio.evaluation.frame_pixels import FramePixels, frame_pixels, most_pixels
from sl_nerfstudio.evaluation.holes import Holes, find_holes
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.scan import Frame, Scan
from sl_nerfstudio.threads import results, threads


@dataclass(frozen=True)
class FrameAgreement:
    """Figures of one frame; NaN where no pixel has one."""

    name: str
    pixels: int  # inside the mask, all of them
    hit_share: float  # of the masked pixels
    lit_share: float
    decoded_share: float
    coordinate_px_median: float
    coordinate_px_p95: float
    epipolar_px_median: float
    pattern_cosine: float
    depth_per_px: float
    ray_angle_deg: float
    covered_share: float  # of the decoded pixels, those at which the mesh has a surface
    agreeing_share: float  # of those, the share that agrees within the noise
    hole_share: float  # of the decoded pixels, those whose ray passes the measured point without meeting a surface
    largest_hole: float  # the largest connected area of such pixels, as a share of the decoded ones


@dataclass(frozen=True)
class CaptureAgreement:
    """Figures of the whole scan."""

    coordinate_px_median: float
    coordinate_px_p95: float
    epipolar_px_median: float
    pattern_cosine: float
    hit_share: float
    depth_per_px: float
    ray_angle_deg: float
    frames: tuple[FrameAgreement, ...]


def frame_agreement(name: str, masked: int, pixels: FramePixels, holes: Holes) -> FrameAgreement:
    """Summary of one frame's pixels, and of what is missing there."""
    both = pixels.lit & np.isfinite(pixels.rendered)
    return FrameAgreement(
        name=name,
        pixels=masked,
        hit_share=_mean(pixels.hit),
        lit_share=_mean(pixels.lit),
        decoded_share=_mean(pixels.decoded),
        coordinate_px_median=_median(pixels.coordinate),
        coordinate_px_p95=_percentile(pixels.coordinate, 95.0),
        epipolar_px_median=_median(np.abs(pixels.epipolar)),
        pattern_cosine=_cosine(pixels.captured[both], pixels.rendered[both]),
        depth_per_px=_median(pixels.depth_per_px),
        ray_angle_deg=_median(pixels.ray_angle_deg),
        covered_share=_mean(pixels.hit[pixels.decoded]),
        agreeing_share=_mean(pixels.coordinate[pixels.decoded & pixels.hit] < pixels.tolerance_px),
        hole_share=holes.missing,
        largest_hole=holes.largest,
    )


class AgreementAccumulator:
    """Collects frames one by one; keeps the residuals (float32), not the images."""

    def __init__(self) -> None:
        self._frames: list[FrameAgreement] = []
        self._coordinate: list[ndarray] = []
        self._epipolar: list[ndarray] = []
        self._depth: list[ndarray] = []
        self._products = np.zeros(3)

    def add(self, figures: FrameAgreement, pixels: FramePixels) -> None:
        """Add one more frame."""
        self._frames.append(figures)
        self._coordinate.append(_known(pixels.coordinate))
        self._epipolar.append(_known(np.abs(pixels.epipolar)))
        self._depth.append(_known(pixels.depth_per_px))
        both = pixels.lit & np.isfinite(pixels.rendered)
        a, b = pixels.captured[both], pixels.rendered[both]
        self._products += (float(a @ b), float(a @ a), float(b @ b))

    def result(self) -> CaptureAgreement:
        """Figures over all pixels of all frames added."""
        coordinate = np.concatenate(self._coordinate)
        ab, aa, bb = self._products
        weight = np.array([f.pixels for f in self._frames], np.float64)
        return CaptureAgreement(
            coordinate_px_median=_median(coordinate),
            coordinate_px_p95=_percentile(coordinate, 95.0),
            epipolar_px_median=_median(np.concatenate(self._epipolar)),
            pattern_cosine=float(ab / np.sqrt(aa * bb)) if aa * bb > 0 else float("nan"),
            hit_share=float(np.average([f.hit_share for f in self._frames], weights=weight)) if weight.sum() else 0.0,
            depth_per_px=_median(np.concatenate(self._depth)),
            ray_angle_deg=_median(np.array([f.ray_angle_deg for f in self._frames])),
            frames=tuple(self._frames),
        )


def compare_captures(
    surface: IndexedMesh,
    scan: Scan,
    poses: DevicePoses,
) -> Iterator[tuple[Frame, FrameAgreement, FramePixels]]:
    """Figures and pixels of every frame in turn; as many frames are in memory at a time as there are threads."""
    pattern = scan.read_pattern()
    tasks = [
        partial(_compare, surface, scan, pattern, frame, T_c, T_p)
        for frame, T_c, T_p in zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True)
    ]
    for first in range(0, len(tasks), threads()):
        yield from results(tasks[first : first + threads()])


def _compare(
    surface: IndexedMesh,
    scan: Scan,
    pattern: Float[ndarray, "ph pw"],
    frame: Frame,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> tuple[Frame, FrameAgreement, FramePixels]:
    most = most_pixels(len(scan.frames))
    pixels = frame_pixels(surface, frame, scan, pattern, T_world_camera, T_world_projector, most)
    masked, holes = len(pixels.row) * pixels.stride**2, find_holes(pixels, surface.diagonal)
    return frame, frame_agreement(frame.name, masked, pixels, holes), pixels


def _known(values: Float[ndarray, "n"]) -> Float[ndarray, "m"]:
    return values[np.isfinite(values)].astype(np.float32)


def _median(values: Float[ndarray, "n"]) -> float:
    return _percentile(values, 50.0)


def _percentile(values: Float[ndarray, "n"], percent: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if len(known) else float("nan")


def _mean(flags: Bool[ndarray, "n"]) -> float:
    return float(flags.mean()) if len(flags) else 0.0


def _cosine(a: Float[ndarray, "n"], b: Float[ndarray, "n"]) -> float:
    product = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / product if product > 0 else float("nan")
