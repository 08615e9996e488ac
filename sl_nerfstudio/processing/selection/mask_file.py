"""One mask as a user makes it: white is used, black is not."""

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8, UInt16
from numpy import ndarray
from PIL import Image, UnidentifiedImageError

from sl_nerfstudio.scan.file_error import FileError, read_bytes
from sl_nerfstudio.scan.images import FORMATS, read_image

_MOST_BETWEEN = 0.05  # share of the pixels that may be neither black nor white: smooth edges, JPEG
_NEARLY = 0.1  # of full scale: what differs so little from black or white is black or white
_EXIF_ORIENTATION = 0x0112


def read_mask(path: Path, size: tuple[int, int]) -> Bool[ndarray, "h w"]:
    """The pixels to use. `size` is the captures' (w, h).

    With one value beside zero (0 and 255, 0 and 1), everything that is not zero is used. Otherwise at most 5 % of the
    pixels may be between black and white, and they are used from half of full scale on. A palette stands for its
    colours; what is transparent is not used; colours must be greys.
    Raises FileError for any other mask, for one of another size, and for one that is all black.
    """
    values, visible = _read(path)
    if values.shape[:2] != size[::-1]:
        raise FileError(
            path, f"is {values.shape[1]} x {values.shape[0]} pixels, the captures are {size[0]} x {size[1]}",
            "the mask was drawn on a reduced or cropped capture", "make a mask of the size of the captures",
        )  # fmt: skip
    if values.ndim == 3:
        if (values != values[..., :1]).any():
            raise FileError(
                path, "has colours; a mask is white where the capture is used and black elsewhere",
                "it is a capture, or a cut-out whose transparency is the mask", "save the mask itself, in grey",
            )  # fmt: skip
        values = values[..., 0]
    mask = _used(path, np.where(visible, values, 0).astype(values.dtype))
    if not mask.any():
        raise FileError(
            path, "is all black: no pixel of its capture would be used",
            "an empty mask, or one in which black stands for the object",
            "paint white what is to be used, or take the frame out of both folders",
        )  # fmt: skip
    return mask


def _used(path: Path, values: UInt8[ndarray, "h w"] | UInt16[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    if len(np.unique(values[values > 0])) <= 1:
        return values > 0
    share = values / float(np.iinfo(values.dtype).max)
    between = float(((share > _NEARLY) & (share < 1 - _NEARLY)).mean())
    if share.max() < 0.5 or between > _MOST_BETWEEN:
        raise FileError(
            path,
            f"is no mask: {between:.0%} of its pixels are between black and white"
            if between > _MOST_BETWEEN
            else f"is no mask: its values go from 0 to {values.max()}, with several in between",
            "it is a capture, a depth map, or numbers of several regions",
            "give two values: 0 for what is not used, and 255 (or 1) for what is used",
        )
    return share >= 0.5


def _read(
    path: Path,
) -> tuple[UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"], Bool[ndarray, "h w"]]:
    """Pixels in grey or RGB, and which of them are not transparent."""
    try:
        with Image.open(BytesIO(read_bytes(path)), formats=FORMATS) as image:
            plain = image.mode in ("1", "P", "PA", "LA", "RGBA") or "transparency" in image.info
            turned = plain and image.getexif().get(_EXIF_ORIENTATION, 1) not in (0, 1)
            pixels = np.array(image.convert("RGBA")) if plain and not turned else None
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        pixels = None  # read_image says what is wrong
    if pixels is None:
        values = read_image(path)
        return values, np.ones(values.shape[:2], dtype=bool)
    return pixels[..., :3], pixels[..., 3] >= 128
