"""How sharp the frames of a video are, and how far the picture moves from one to the next."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

SHARP = 0.42  # sharpness of a picture whose edges are blurred by a standard deviation of two pixels, of 960
_WIDTH = 960  # pixels of the longer side, for the sharpness
_NOISE = 0.024  # of the square of the median Laplacian: what noise adds to the fine detail's strongest tenth
_LEAST_DETAIL = 4.0  # squares of grey levels: with less, nothing is seen
_EDGES = 0.05  # of the other direction's detail: a direction with less has no edges
_SMALL = 480  # the same, for the motion
_POINTS, _QUALITY, _APART = 300, 0.01, 7  # tracked corners, as in cv2.goodFeaturesToTrack
_LEAST_POINTS = 12
_PERCENTILE = 75  # of the tracked corners' motion: a pattern that moves with the devices stays in place
_RETURN_PX = 1.0  # tracked there and back


@dataclass(frozen=True)
class FrameMeasure:
    """One frame of a video."""

    number: int
    time_s: float
    sharpness: float
    moved: float  # since the frame before, share of the image's diagonal


class VideoMeter:
    """Measures one frame after the other."""

    def __init__(self) -> None:
        self._before: UInt8[ndarray, "h w"] | None = None

    def measure(self, number: int, time_s: float, grey: UInt8[ndarray, "h w"]) -> FrameMeasure:
        """Sharpness of a frame, and its motion since the frame before; 0 for the first."""
        small = _resized(grey, _SMALL)
        moved = 0.0 if self._before is None or self._before.shape != small.shape else _motion(self._before, small)
        self._before = small
        return FrameMeasure(number, time_s, sharpness(grey), moved)


def sharpness(grey: UInt8[ndarray, "h w"]) -> float:
    """Detail between 1 and 2 pixels against that between 2 and 4: about 0.7 for sharp edges, 0.25 for blurred ones.

    It does not depend on contrast. The smaller value of both directions counts, because motion blurs in one; a
    direction without edges does not.
    """
    image = _resized(grey, _WIDTH).astype(np.float32)
    noise = float(np.median(np.abs(cv2.Laplacian(image, cv2.CV_32F)))) ** 2 * _NOISE
    found = []
    for axis in (0, 1):
        smooth = [_smoothed(image, sigma, axis) for sigma in (1.0, 2.0, 4.0)]
        fine, coarse = _energy(smooth[0] - smooth[1]) - noise, _energy(smooth[1] - smooth[2]) - noise / 2
        found.append((max(fine, 0.0), max(coarse, 0.0)))
    strongest = max(coarse for _, coarse in found)
    if strongest < _LEAST_DETAIL:
        return 0.0
    return min(float(np.sqrt(fine / coarse)) for fine, coarse in found if coarse >= _EDGES * strongest)


def _smoothed(image: Float32[ndarray, "h w"], sigma: float, axis: int) -> Float32[ndarray, "h w"]:
    kernel = cv2.getGaussianKernel(2 * round(4 * sigma) + 1, sigma)
    one = np.ones((1, 1))
    return np.asarray(cv2.sepFilter2D(image, -1, *((one, kernel) if axis == 0 else (kernel, one))))


def _energy(detail: Float32[ndarray, "h w"]) -> float:
    """Mean square of the strongest tenth: edges, not the flat areas between them."""
    squares = np.square(detail).reshape(-1)
    count = max(len(squares) // 10, 1)
    return float(np.partition(squares, len(squares) - count)[-count:].mean())


def _motion(before: UInt8[ndarray, "h w"], now: UInt8[ndarray, "h w"]) -> float:
    """Motion of the picture, share of its diagonal, from corners that are found again."""
    points = cv2.goodFeaturesToTrack(before, _POINTS, _QUALITY, _APART)
    if points is None or len(points) < _LEAST_POINTS:
        return 0.0
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, points, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    back, found_again, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    good = (found & found_again)[:, 0].astype(bool)
    good &= np.linalg.norm((back - points)[:, 0], axis=1) < _RETURN_PX
    diagonal = float(np.hypot(before.shape[0], before.shape[1]))
    if good.sum() < _LEAST_POINTS:
        return 1 / 10  # nothing was found again: a jump, or a blurred frame
    return float(np.percentile(np.linalg.norm((there - points)[good, 0], axis=1), _PERCENTILE)) / diagonal


def _resized(grey: UInt8[ndarray, "h w"], longest: int) -> UInt8[ndarray, "h w"]:
    factor = longest / max(grey.shape)
    if factor >= 1:
        return grey
    h, w = (max(round(side * factor), 1) for side in grey.shape)
    return np.asarray(cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA))
