"""Decoding of Gray-code sequences, with or without inverse images and shifted sines.

A bit is read by comparing an image with its inverse. Indirect light (interreflection, scattering) can make a bit
uncertain; this is judged as in Xu and Aliaga, "Robust pixel classification for 3D modeling with structured light"
(2007), from the direct and the global light of the finest stripes (Nayar et al. 2006).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import Decoded, DecodingError
from sl_nerfstudio.decoding.graycode.phase import cell_places, phase_coordinates
from sl_nerfstudio.decoding.graycode.photographs import Image, Photographs, check_sizes
from sl_nerfstudio.decoding.graycode.subcell import LEVELS, Cells, subcell_coordinates
from sl_nerfstudio.decoding.regions import drop_small_regions
from sl_nerfstudio.pattern.graycode import GrayCode, gray, ungray
from sl_nerfstudio.pattern.sequence import Shown
from sl_nerfstudio.scan.images import as_grey

# Pixels that count as lit.
_FINEST = 4  # bits of each axis that separate direct from global light; the finest alone may be out of focus
_LEAST_DIRECT = 0.02  # of full scale: with less light, bits are lost in the noise
_LEAST_SIGNAL = 4.0  # times the noise
# Bits that count as certain.
_UNCERTAIN = 0.08  # of the direct light: the smallest difference of an image and its inverse that decides a bit
# Captures that are refused.
_LEAST_LIT = 0.002  # of the image: with less, the pattern counts as not seen
_LEAST_DECODED = 0.02  # of the lit pixels
# Regions that are kept.
_LARGEST_STEP = 3.0  # cells, or usual steps where these are larger, between neighbouring pixels of one surface
_LEAST_REGION = 60  # pixels


@dataclass(frozen=True)
class Light:
    """Direct and global light of every pixel, of full scale."""

    direct: Float32[ndarray, "h w"]
    ambient: Float32[ndarray, "h w"]  # global light: from the whole scene, not from the pixel's own ray
    signal: Float32[ndarray, "h w"]  # mean difference of the images from their inverse
    noise: float  # standard deviation of an image

    @property
    def lit(self) -> Bool[ndarray, "h w"]:
        """Pixels that the projector reaches."""
        return self.signal > max(_LEAST_DIRECT, _LEAST_SIGNAL * self.noise)


def decode_gray_code(images: Sequence[Image], layout: GrayCode) -> Decoded:
    """Coordinates of every pixel from the photographs of one sequence, in the order of `layout`.

    Grey or RGB, 8 or 16 bit, all of one size. Coordinates are finer than a cell: they use the places where
    the difference of an image and its inverse changes sign, and sines where there are any. Raises DecodingError if the
    sequence is incomplete, if its images have several sizes, or if nothing can be decoded.
    """
    _check_sequence(images, layout)
    photographs = Photographs(images, layout)
    light = separate(photographs)
    _check_light(images, layout, light)
    coords = np.full((*light.lit.shape, 2), np.nan, dtype=np.float32)
    stripes: list[Float32[ndarray, "h w"]] = []
    for axis in (0, 1):
        coords[..., axis] = _coordinates(photographs, axis, light)
        stripes.append(_stripe_image(photographs, axis, light))
    known = np.isfinite(coords).all(-1) & light.lit
    coords[~known] = np.nan
    coords = drop_small_regions(coords, _LARGEST_STEP * max(layout.cell, _usual_step(coords)), _LEAST_REGION)
    stripe = np.where(light.lit, (stripes[0] + stripes[1]) / 2, 0).astype(np.float32)
    decoded = Decoded(coords, light.lit, stripe, np.where(light.lit, light.direct, np.float32(np.nan)))
    if decoded.rate < _LEAST_DECODED:
        raise DecodingError(
            f"only {decoded.rate:.1%} of the lit pixels could be decoded",
            "the images are not in the order of the sequence, belong to another sequence, or something moved",
            "give the images in the order of the pattern file, named so that sorting puts them in that order; "
            "--sequence names the orders of other programs",
        )
    return decoded


def separate(photographs: Photographs) -> Light:
    """Light of every pixel: direct and global light from the finest stripes, half of which are dark."""
    layout = photographs.layout
    highest = signal = np.zeros(photographs.images[0].shape[:2], dtype=np.float32)
    lowest = np.full_like(highest, np.inf)
    count = 0
    for axis in (0, 1):
        places = layout.bit_images(axis)
        for k, place in enumerate(places):
            p, q = photographs.pair(*place)
            signal, count = signal + np.abs(p - q), count + 1
            if k >= len(places) - _FINEST:
                highest = np.maximum(highest, np.maximum(p, q))
                lowest = np.minimum(lowest, np.minimum(p, q))
        if not places:
            sine = photographs.sine(axis, *layout.sines(axis)[-1])
            signal, count = signal + 2 * sine.amplitude, count + 1
            highest = np.maximum(highest, sine.mean + sine.amplitude)
            lowest = np.minimum(lowest, sine.mean - sine.amplitude)
    black = photographs.shown(Shown("black"))
    ambient = 2 * np.clip(lowest - (0 if black is None else black), 0, None)
    return Light(highest - lowest, ambient, signal / np.float32(count), photographs.noise())


def _coordinates(photographs: Photographs, axis: int, light: Light) -> Float32[ndarray, "h w"]:
    """Coordinates of all pixels along an axis, in pattern pixels."""
    layout = photographs.layout
    cells = _read_cells(photographs, axis, light) if layout.bit_images(axis) else None
    if cells is not None and not layout.sines(axis):
        return subcell_coordinates(cells, (layout.columns, layout.rows)[axis]) * layout.cell
    coarse = None if cells is None else cell_places(cells) * np.float32(layout.cell)
    found = phase_coordinates(photographs, axis, coarse, light.noise)
    size = (layout.w, layout.h)[axis]
    return np.where((found >= 0) & (found <= size), found, np.float32(np.nan))


def _usual_step(coords: Float32[ndarray, "h w 2"]) -> float:
    """Median difference of neighbouring pixels, in pattern pixels: a camera far coarser than the projector."""
    steps = [np.abs(np.diff(coords, axis=axis)).max(-1) for axis in (0, 1)]
    known = np.concatenate([step[np.isfinite(step)] for step in steps])
    return float(np.median(known)) if len(known) else 0.0


def check_count(count: int, layout: GrayCode) -> None:
    """Raise DecodingError unless there is one image for each pattern of the sequence."""
    if count != layout.images:
        raise DecodingError(
            f"holds {count} images, the sequence of the pattern has {layout.images}",
            "images are missing or too many, or the pattern file describes another sequence "
            f"({layout.w} x {layout.h} pixels in cells of {layout.cell})",
            f"give one image of each of the {layout.images} patterns, or the pattern file that they were made with",
        )


def _check_sequence(images: Sequence[Image], layout: GrayCode) -> None:
    check_count(len(images), layout)
    check_sizes(images)


def _check_light(images: Sequence[Image], layout: GrayCode, light: Light) -> None:
    share = float(light.lit.mean())
    if share >= _LEAST_LIT:
        return
    brightness = float(as_grey(images[layout.place(Shown("white")) or 0]).mean())
    what = "black" if brightness < _LEAST_DIRECT else "white" if brightness > 1 - _LEAST_DIRECT else "not changing"
    raise DecodingError(
        f"no stripes are seen: the images are {what} (lit: {share:.2%} of the pixels)",
        {"black": "the exposure was far too short, the lens covered, or the projector off",
         "white": "the exposure was far too long",
         "not changing": "the projector was off, or its light missed what the camera sees"}[what],
        "capture this frame again, with stripes visible on the object in every image except white and black",
    )  # fmt: skip


def _read_cells(photographs: Photographs, axis: int, light: Light) -> Cells:
    """Cells of all pixels along an axis."""
    layout = photographs.layout
    places = layout.bit_images(axis)
    bits = len(places)
    code = np.zeros(light.lit.shape, dtype=np.int32)
    uncertain = np.zeros_like(code)
    differences = np.empty((bits, *code.shape), dtype=np.int16)
    for k, place in enumerate(places):
        p, q = photographs.pair(*place)
        difference = p - q
        value = np.int32(1 << (bits - 1 - k))
        code += value * (difference > 0)
        uncertain += value * _uncertain(p, q, light)
        differences[k] = np.rint(difference * 32767)
    cell = ungray(code, bits)
    level = np.full(code.shape, -1, dtype=np.int8)
    for coarser in reversed(range(LEVELS)):
        # An uncertain bit is harmless at the border of two cells that differ in just that bit.
        c = cell >> coarser
        harmless = ((code >> coarser) ^ gray(c - 1)) | ((code >> coarser) ^ gray(c + 1))
        level[(uncertain >> coarser) & ~harmless == 0] = coarser
    level[~light.lit | (cell >= (layout.columns, layout.rows)[axis])] = -1
    return Cells(cell, level, differences)


def _uncertain(p: Float32[ndarray, "h w"], q: Float32[ndarray, "h w"], light: Light) -> Bool[ndarray, "h w"]:
    """Where image `p` and its inverse `q` do not decide a bit.

    Their difference is plus or minus the direct light, plus a share of the global light between -1 and 1. Its sign is
    certain if it is larger than what global light alone could cause with the wrong sign.
    """
    difference = np.abs(p - q)
    noise = 2 * np.sqrt(2) * light.noise
    return (difference <= light.ambient - light.direct) | (difference < np.maximum(_UNCERTAIN * light.direct, noise))


def _stripe_image(photographs: Photographs, axis: int, light: Light) -> Float32[ndarray, "h w"]:
    """The finest stripes of an axis in [0, 1], with albedo and shading removed."""
    layout, direct = photographs.layout, np.maximum(light.direct, _LEAST_DIRECT)
    places = layout.bit_images(axis)
    if places:
        p, q = photographs.pair(*places[-1])
        difference = p - q
    else:
        sine = photographs.sine(axis, *layout.sines(axis)[-1])
        difference = 2 * sine.amplitude * np.cos(sine.phase)
    return np.clip(0.5 + difference / (2 * direct), 0, 1).astype(np.float32)
