"""Where a pattern resembles itself: how large a window must be, and with what a place can be confused."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray
from scipy.ndimage import maximum_filter

_ALIKE = 0.25  # autocorrelation of a place that can be confused
_REACH = 2.6  # distances of the nearest such place within which others are compared
_MOST_RIVALS, _MOST_DECOYS = 24, 8  # stripes resemble themselves everywhere along themselves
_LOBE_PITCH = 6.0  # widths of the main lobe that count as the distance if there is no such place


@dataclass(frozen=True)
class Ambiguity:
    """Displacements at which a pattern looks nearly the same; pattern pixels."""

    pitch: float  # distance of the nearest one: the period of a grid
    rivals: Float32[ndarray, "r 2"]  # all within a few pitches
    decoys: Float32[ndarray, "d 2"]  # some farther away: no right coordinate is displaced by them

    @staticmethod
    def of(pattern: Float32[ndarray, "h w"]) -> "Ambiguity":
        """From the autocorrelation of the whole pattern."""
        h, w = pattern.shape
        alike = _autocorrelation(pattern)
        y, x = np.mgrid[: alike.shape[0], : alike.shape[1]]
        y, x = y - h // 2, x - w // 2
        distance = np.hypot(y, x)
        lobe = max(float(distance[alike < 0.5].min(initial=max(h, w))), 1.0)
        side = 2 * int(np.ceil(lobe)) + 1
        peak = (alike >= maximum_filter(alike, side)) & (alike > _ALIKE) & (distance > 1.5 * lobe)
        pitch = float(distance[peak].min(initial=np.inf))
        if not np.isfinite(pitch):
            pitch = _LOBE_PITCH * lobe
        found = np.stack([x[peak], y[peak]], 1).astype(np.float32)
        far = distance[peak]
        near = np.flatnonzero(far < _REACH * pitch)
        strongest = np.argsort(-alike[peak][near], kind="stable")[:_MOST_RIVALS]
        rivals = found[near[np.sort(strongest)]]
        decoys = found[(far > 1.2 * _REACH * pitch) & (far < 2.2 * _REACH * pitch)]
        decoys = decoys[:: max(1, -(-len(decoys) // _MOST_DECOYS))]
        if not len(decoys):
            angle = np.arange(8) * np.pi / 4
            decoys = (1.7 * _REACH * pitch * np.stack([np.cos(angle), np.sin(angle)], 1)).astype(np.float32)
        return Ambiguity(pitch, rivals, decoys)


def _autocorrelation(pattern: Float32[ndarray, "h w"]) -> Float64[ndarray, "h w"]:
    """Of displacements up to half the pattern's size, the one of zero in the middle (h // 2, w // 2)."""
    h, w = pattern.shape
    one = np.fft.rfft2(np.ones_like(pattern), (2 * h, 2 * w))
    centred = np.fft.rfft2(pattern - pattern.mean(), (2 * h, 2 * w))
    total, count = (np.fft.irfft2(np.abs(f) ** 2, (2 * h, 2 * w)) for f in (centred, one))
    rows, columns = np.arange(h) - h // 2, np.arange(w) - w // 2
    part = np.ix_(rows, columns)
    mean = total[part] / np.maximum(count[part], 1)
    return mean / max(float(mean[h // 2, w // 2]), 1e-30)
