"""Photographs as cameras and phones write them: turned as their EXIF tag says, HEIC too; raw files are refused.

A scan folder itself holds only images that need no turning (`images.py`).
"""

import math
import struct
from numbers import Real
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray
from PIL import Image

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.file_error import FileError, check_file
from sl_nerfstudio.scan.images import ImageHeader, as_grey, read_header_and_orientation, read_pixels_and_orientation

PHONE = (".heic", ".heif")
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", *PHONE)
RAW = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw", ".x3f", ".raw")
Pixels = UInt8[ndarray, "..."] | UInt16[ndarray, "..."]  # (h, w) or (h, w, 3)
_EXIF_IFD = 0x8769
_TRANSPOSED = (5, 6, 7, 8)  # EXIF orientations that exchange rows and columns
# Mosaics of a colour filter.
_TILE = 16  # pixels
_BRIGHT = 0.3  # of the bright tiles: darker ones are not looked at
_LEAST_TILES = 20
_CONTRAST = 0.08  # of the tile's mean: between the brightest and the darkest of its four pixel classes
_GREENS = 0.3  # of that contrast: between the two green classes
_SHARE = 0.7  # of the tiles


def read_photograph(path: Path) -> Pixels:
    """All pixels, (h, w) grey or (h, w, 3) RGB, 8 or 16 bit, turned as the EXIF tag says.

    Raises FileError for what cannot be read, and for raw files, with the command that converts them.
    """
    if path.suffix.lower() in RAW:
        raise raw_file(path)
    if path.suffix.lower() in PHONE:
        return np.asarray(_open_heif(path).to_pillow().convert("RGB"))
    pixels, orientation = read_pixels_and_orientation(path)
    return turned(pixels, orientation)


def photograph_header(path: Path) -> ImageHeader:
    """Size and kind after turning, without decoding the pixels. Raises FileError like `read_photograph`."""
    if path.suffix.lower() in RAW:
        raise raw_file(path)
    if path.suffix.lower() in PHONE:
        w, h = _open_heif(path).size
        return ImageHeader(w, h, "RGB", 8)
    header, orientation = read_header_and_orientation(path)
    if orientation in _TRANSPOSED:
        return ImageHeader(header.h, header.w, header.mode, header.bits)
    return header


def turned_by_tag(path: Path) -> bool:
    """Whether an EXIF tag says that the pixels are stored turned or mirrored. Raises FileError if it is no image."""
    return path.suffix.lower() not in PHONE and read_header_and_orientation(path)[1] != 1


def turned(pixels: Pixels, orientation: int) -> Pixels:
    """Pixels as they are to be shown, for an EXIF orientation from 1 to 8."""
    if orientation in _TRANSPOSED:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def raw_file(path: Path) -> FileError:
    """The error of a camera's raw file."""
    return FileError(
        path,
        "is a raw file of a camera",
        "it holds the sensor's values, which each program develops differently",
        f'develop all of them in the same way, for example with LibRaw\'s "dcraw_emu -T -W {path.name}" (16-bit TIFF: '
        "add -6), or save JPEG or PNG in the camera",
    )


def is_mosaic(pixels: Pixels) -> bool:
    """Whether a grey image is the raw mosaic of a colour filter (Bayer).

    Then the same two of the four pixels of every 2 x 2 square, on one diagonal, are equally bright (green), and the
    others are not, in nearly all bright parts of the image.
    """
    if pixels.ndim != 2 or min(pixels.shape) < 2 * _TILE:
        return False
    grey = as_grey(pixels)
    h, w = (size // _TILE * _TILE for size in grey.shape)
    tiles = grey[:h, :w].reshape(h // _TILE, _TILE // 2, 2, w // _TILE, _TILE // 2, 2).mean((1, 4))
    classes = tiles.transpose(0, 2, 1, 3).reshape(-1, 4)  # (0, 0), (0, 1), (1, 0), (1, 1) of every tile
    mean = classes.mean(1)
    classes = classes[(mean > _BRIGHT * np.percentile(mean, 95)) & (mean > 0)]
    if len(classes) < _LEAST_TILES:
        return False
    contrast = np.ptp(classes, axis=1)
    apart = contrast > _CONTRAST * classes.mean(1)
    for a, b in ((0, 3), (1, 2)):
        greens = np.abs(classes[:, a] - classes[:, b]) < _GREENS * contrast
        others = [k for k in range(4) if k not in (a, b)]
        brighter = np.sign(classes[:, [a, b]].mean(1) - classes[:, others].mean(1))
        if (apart & greens).mean() > _SHARE and abs(brighter[apart].mean()) > _SHARE:
            return True
    return False


def refuse_mosaic(path: Path) -> None:
    """Raise FileError if an image is a raw mosaic; one that cannot be read is not looked at."""
    try:
        mosaic = path.suffix.lower() not in PHONE and is_mosaic(read_pixels_and_orientation(path)[0])
    except FileError:
        return
    if mosaic:
        raise FileError(
            path,
            "is the raw mosaic of a colour filter (Bayer), not a picture",
            "the camera's program saved the sensor's values",
            "convert all images, with the letters that the camera's maker states (RG, GR, BG or GB), by: python -c "
            f"\"import cv2; cv2.imwrite('grey.png', cv2.cvtColor(cv2.imread('{path.name}', -1), "
            'cv2.COLOR_BayerRG2GRAY))"; if it is none, --not-mosaic says so',
        )


def _open_heif(path: Path):
    """A phone's picture, already turned. Raises FileError, and UserError if the reader is not installed."""
    check_file(path)
    try:
        import pillow_heif
    except ImportError as error:
        raise UserError(
            f"{path}: is a HEIC file, for which a reader is missing\n    cause:  pillow-heif is not installed\n"
            "    remedy: pip install 'sl-nerfstudio[phone]', or set the phone to \"most compatible\" (JPEG)"
        ) from error
    try:
        return pillow_heif.open_heif(str(path))
    except (ValueError, OSError, EOFError, RuntimeError, SyntaxError) as error:
        raise FileError(
            path,
            f"cannot be read as HEIC ({error})",
            "it is truncated, damaged, or another kind of file",
            "copy it again, or export it as JPEG",
        ) from error


def exif_numbers(path: Path) -> dict[int, float]:
    """All tags of the EXIF data whose value is a number, by their codes; empty if there are none.

    Raises FileError if the file is no photograph.
    """
    if path.suffix.lower() in RAW:
        raise raw_file(path)
    exif = Image.Exif()
    try:
        if path.suffix.lower() in PHONE:
            exif.load(_open_heif(path).info.get("exif") or b"")
        else:
            photograph_header(path)
            with Image.open(path) as image:
                exif = image.getexif()
        tags = {**exif, **exif.get_ifd(_EXIF_IFD)}
        return {int(key): float(value) for key, value in tags.items() if _is_number(value)}
    except (OSError, ValueError, SyntaxError, TypeError, KeyError, struct.error, ZeroDivisionError):
        return {}


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(float(value))
