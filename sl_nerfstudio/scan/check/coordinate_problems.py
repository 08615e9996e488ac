"""What can be wrong with the numbers of a coordinate file."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.scan.problem import Problem

_OUTSIDE = 0.05  # of the pattern's size: a decoder may extrapolate this far beyond the border
_MANY_OUTSIDE = 0.05  # share of the pixels that may be farther out: wrong decodings
_ABSURD = 4.0  # pattern sizes: no decoder puts a pixel this far beyond the border
_SENTINELS = ((-1.0, -1.0), (0.0, 0.0))
_MANY_EQUAL = 0.02  # share of the decoded pixels with one value; neighbours may share a coordinate, but not so many
_FEW = 20
_FEWEST_NEIGHBOURS = 200
_NOISE = 0.7  # of a typical distance from the median; a surface across 16 pixels has 0.25, independent values 1 to 1.5


def coordinate_problems(coords: Float32[ndarray, "h w 2"], projector: Device | None) -> Iterator[Problem]:
    """Everything that is wrong with one frame's coordinates; fewer checks if the projector is None."""
    x, y = coords[..., 0], coords[..., 1]  # separately: numpy is slow along an axis of two
    infinite = int((np.isinf(x) | np.isinf(y)).sum())
    if infinite:
        yield Problem(
            f"holds infinities at {infinite} pixels",
            "a division by zero in the decoder, or a marker for 'not decoded'",
            "write NaN where a pixel was not decoded",
        )
        return
    has_x, has_y = ~np.isnan(x), ~np.isnan(y)
    half = int((has_x != has_y).sum())
    if half:
        yield Problem(
            f"has only one of x_p and y_p at {half} pixels",
            "the two were decoded separately and not combined",
            "write NaN for both where either is missing",
        )
    values = coords[has_x & has_y]
    if not len(values):
        yield Problem(
            "is NaN everywhere",
            "decoding failed: the pattern was not found in this image",
            "decode it again (exposure, focus, ambient light), or leave the frame out",
        )
        return
    sentinel = _sentinel_problem(values)
    if sentinel is not None:
        yield sentinel
        return
    if _is_noise(coords, values):
        yield Problem(
            "is noise: neighbouring pixels have coordinates as far apart as any two",
            "the array was written in another order or type, or nothing was decoded",
            "decode the image again, or leave the frame out",
        )
        return
    if (values == np.floor(values)).all():
        yield Problem(
            "holds whole numbers only",
            "they are pixel indices, as Gray-code decoders give them; here the centre of a pixel is at .5",
            "add 0.5 to both coordinates",
        )
    if projector is not None:
        yield from _range_problems(values, projector)


def _is_noise(coords: Float32[ndarray, "h w 2"], values: Float32[ndarray, "n 2"]) -> bool:
    """Whether most neighbours in a row differ like pixels anywhere; on a surface they are a footprint apart."""
    left, right = coords[:, :-1], coords[:, 1:]
    both = np.isfinite(left[..., 0]) & np.isfinite(right[..., 0])
    if both.sum() < _FEWEST_NEIGHBOURS:
        return False
    step = np.median(np.abs(right[both] - left[both]), 0)
    spread = np.median(np.abs(values - np.median(values, 0)), 0)
    return bool((step > _NOISE * spread).all())


def _sentinel_problem(values: Float32[ndarray, "n 2"]) -> Problem | None:
    """A value that stands for 'not decoded'."""
    pairs, counts = np.unique(np.ascontiguousarray(values).view(np.uint64).ravel(), return_counts=True)
    most = int(counts.argmax())
    value = pairs[most : most + 1].view(np.float32)
    count = int(counts[most])
    known = any((value == sentinel).all() for sentinel in _SENTINELS)
    if count <= _FEW or (not known and count <= _MANY_EQUAL * len(values)):
        return None
    return Problem(
        f"has the value ({value[0]:g}, {value[1]:g}) at {count} pixels",
        "it stands for 'not decoded'" if known else "it stands for 'not decoded', or the file is a placeholder",
        "write NaN where a pixel was not decoded",
    )


def _range_problems(values: Float32[ndarray, "n 2"], projector: Device) -> Iterator[Problem]:
    size = np.array([projector.w, projector.h], dtype=np.float32)
    low, high = values.min(0), values.max(0)
    span = f"x_p {low[0]:g} to {high[0]:g}, y_p {low[1]:g} to {high[1]:g}; pattern {projector.w} x {projector.h}"
    if (size > 8).all() and (low >= -1.01).all() and (high <= 1.01).all():
        yield Problem(
            f"lies between -1 and 1 ({span})",
            "the coordinates are normalised",
            "store pattern pixels: multiply by the pattern's size, x to the right and y down",
        )
        return
    outside, absurd = _beyond(values, size, _OUTSIDE), _beyond(values, size, _ABSURD)
    if outside.mean() > _MANY_OUTSIDE or absurd.any():
        many = bool(outside.mean() > _MANY_OUTSIDE)
        count = int(absurd.sum())
        some = "1 pixel" if count == 1 else f"{count} pixels"
        share = f"{100 * outside.mean():.0f} % of the pixels" if many else some
        yield Problem(
            f"puts {share} outside the pattern ({span})",
            _outside_cause(values, size, many),
            "store (x, y) in pixels of pattern.png, NaN where not decoded",
        )
    elif projector.model == "DOE":
        yield from _doe_problems(values, projector)


def _beyond(values: Float32[ndarray, "n 2"], size: Float32[ndarray, "2"], margin: float) -> Bool[ndarray, "n"]:
    """Which values lie outside a pattern of `size` by more than `margin` sizes."""
    x, y = values[:, 0] / size[0], values[:, 1] / size[1]
    return (x < -margin) | (x > 1 + margin) | (y < -margin) | (y > 1 + margin)


def _outside_cause(values: Float32[ndarray, "n 2"], size: Float32[ndarray, "2"], many: bool) -> str:
    if not many:
        return "a marker for 'not decoded', or a decoder that diverged"
    if _beyond(values, size[::-1], _OUTSIDE).mean() <= _MANY_OUTSIDE:
        return "x and y are swapped: the other way round they fit the pattern"
    return "they are coordinates of a pattern of another size, or in another unit"


def _doe_problems(values: Float32[ndarray, "n 2"], projector: Device) -> Iterator[Problem]:
    directions = unproject(Intrinsics.of(projector, torch.float64), torch.from_numpy(values.astype(np.float64)))
    beyond = int((~directions.isfinite().all(-1)).sum())
    if beyond:
        yield Problem(
            f"has {beyond} pixels more than 90 degrees from the axis of the DOE projector, where it sends no light",
            "the focal lengths of the projector are too small, or it is not a DOE",
            "check fl_x, fl_y and model of the projector",
        )
