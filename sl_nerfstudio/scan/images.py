"""Image files of a scan: grey or RGB, 8 or 16 bit, read exactly as stored or not at all."""

import struct
import warnings
import zlib
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image
from PIL.ImageFile import ImageFile
from PIL.PngImagePlugin import PngImageFile

from sl_nerfstudio.scan.file_error import FileError, check_file, read_bytes, unreadable

FORMATS = ("PNG", "TIFF", "JPEG", "BMP")
_LUMA = (0.299, 0.587, 0.114)  # Rec. 601
_EXIF_ORIENTATION = 0x0112
_OPENING = Lock()  # what Python warns of is set for all threads
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
MAX_PIXELS = 89_000_000  # just below the size at which Pillow warns of decompression bombs
_OTHER_KINDS = {
    "P": "a colour palette",
    "RGBA": "transparency",
    "LA": "transparency",
    "PA": "transparency",
    "1": "one bit per pixel",
}
_DAMAGE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    TypeError,
    KeyError,
    IndexError,
    OverflowError,
    struct.error,
    zlib.error,
)


@dataclass(frozen=True)
class ImageHeader:
    """What the header of an image file says; `mode` is "grey" or "RGB"."""

    w: int
    h: int
    mode: str
    bits: int


def read_header(path: Path) -> ImageHeader:
    """Size and kind of an image, without decoding it. Raises FileError for kinds that a scan must not hold."""
    header, orientation = read_header_and_orientation(path)
    _refuse_orientation(path, orientation)
    return header


def read_header_and_orientation(path: Path) -> tuple[ImageHeader, int]:
    """Size and kind as stored, and the EXIF orientation (1: as stored). Raises FileError for other kinds."""
    check_file(path)
    try:
        with path.open("rb") as stream:
            image = _open(path, stream)
            return _header(path, image), _orientation(path, image)
    except OSError as error:
        raise unreadable(path, error) from error


def read_image(path: Path) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]:
    """All pixels, (h, w) grey or (h, w, 3) RGB, 8 or 16 bit as stored.

    Raises FileError for a file that is missing, damaged, truncated, of an unknown format, rotated by an EXIF tag, or
    that has a palette or transparency: none of this is repaired.
    """
    pixels, orientation = read_pixels_and_orientation(path)
    _refuse_orientation(path, orientation)
    return pixels


def read_pixels_and_orientation(path: Path) -> tuple[UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"], int]:
    """The pixels as stored, and the EXIF orientation (1: as stored). Raises FileError like `read_image`."""
    content = read_bytes(path)
    image = _open(path, BytesIO(content))
    header = _header(path, image)
    _orientation(path, image)
    try:
        image.load()
    except MemoryError as error:
        raise FileError(path, "does not fit into memory", "the image is huge", "use smaller images") from error
    except _DAMAGE as error:
        raise FileError(
            path,
            f"cannot be decoded ({error})",
            "the file is truncated or damaged, for example by an interrupted copy or a full disk",
            "copy or export this image again",
        ) from error
    if isinstance(image, PngImageFile):
        _check_png_sums(path, content)
    orientation = _orientation(path, image)  # again: a PNG may have the tag after its pixels
    if header.bits == 16 and header.mode == "RGB":
        return _decode_deep_colour(path, content), orientation
    pixels = np.array(image)
    return (pixels.astype(np.uint16) if header.bits == 16 else pixels), orientation


def as_grey(image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]) -> Float32[ndarray, "h w"]:
    """Intensity in [0, 1]: full scale of the integer type is 1; colours are weighted as in Rec. 601."""
    scaled = image.astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
    return scaled if scaled.ndim == 2 else scaled @ np.array(_LUMA, dtype=np.float32)


def encode_png(image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]) -> bytes:
    """A PNG file of a grey (h, w) or RGB (h, w, 3) image, 8 or 16 bit as given. Raises ValueError for other shapes."""
    import cv2

    if image.ndim != 2 and image.shape[2:] != (3,):
        raise ValueError(f"an image must be (h, w) or (h, w, 3), got {image.shape}")
    ordered = image if image.ndim == 2 else image[..., ::-1]
    ok, content = cv2.imencode(".png", np.ascontiguousarray(ordered))
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return content.tobytes()


def _open(path: Path, stream: BufferedReader | BytesIO) -> ImageFile:
    """The image with its header read, but not its pixels."""
    try:
        with _OPENING, warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            return Image.open(stream, formats=FORMATS)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise FileError(
            path,
            f"is far too large ({str(error).split(',')[0]})",
            "it is not a capture: its header is damaged, or it was made to exhaust memory",
            f"give images of at most {MAX_PIXELS // 10**6} million pixels",
        ) from error
    except _DAMAGE as error:
        raise FileError(
            path,
            "is not an image that can be read",
            f"it is truncated or damaged, or not one of {', '.join(FORMATS)}",
            "export it again, preferably as PNG",
        ) from error


def _header(path: Path, image: ImageFile) -> ImageHeader:
    """Size and kind; FileError for every kind that a scan must not hold."""
    if getattr(image, "n_frames", 1) != 1:
        raise FileError(
            path,
            "holds several images",
            "it is an animation or a multi-page TIFF",
            "write each image to its own file",
        )
    raw = str(image.tile[0][3]) if image.tile else ""
    transparent = "transparency" in image.info
    if image.mode in ("L", "RGB") and not transparent:
        return ImageHeader(*image.size, "grey" if image.mode == "L" else "RGB", 16 if ";16" in raw else 8)
    if image.mode in ("I;16", "I;16B", "I;16L") and not transparent:
        return ImageHeader(*image.size, "grey", 16)
    what = _OTHER_KINDS.get(image.mode, "transparency" if transparent else f"mode {image.mode}")
    raise FileError(
        path,
        f"is of a kind that a scan must not hold ({what})",
        "it is not certain which intensity such a pixel has",
        "save it as grey or RGB with 8 or 16 bits, without palette or transparency",
    )


def _check_png_sums(path: Path, content: bytes) -> None:
    """Pillow decodes pixels without looking at the check sum that PNG keeps of every part. Raises FileError."""
    place = len(_PNG_SIGNATURE)
    while place + 12 <= len(content):
        size, kind = struct.unpack(">I4s", content[place : place + 8])
        end = place + 8 + size
        if content[end : end + 4] != struct.pack(">I", zlib.crc32(content[place + 4 : end])):
            raise FileError(
                path,
                f"is damaged: the check sum of its part {kind.decode('latin-1')!r} is wrong",
                "bytes were changed by a failing disk, a faulty copy or an editor",
                "copy or export this image again",
            )
        if kind == b"IEND":
            return
        place = end + 4


def _orientation(path: Path, image: ImageFile) -> int:
    """The EXIF orientation, 1 to 8; 1 where there is none."""
    # PngImageFile.getexif() would decode the pixels to look for the tag after them.
    found: object = 1
    if not isinstance(image, PngImageFile) or "exif" in image.info:
        try:
            found = image.getexif().get(_EXIF_ORIENTATION, 1)
        except _DAMAGE as error:
            raise FileError(
                path, f"has damaged EXIF data ({error})", "a faulty program wrote it", "remove the EXIF data"
            ) from error
    return found if isinstance(found, int) and found in range(1, 9) else 1


def _refuse_orientation(path: Path, orientation: int) -> None:
    if orientation != 1:
        raise FileError(
            path,
            f"must be rotated before it is shown (EXIF orientation {orientation})",
            "a phone or camera recorded how it was held; some programs rotate such images, others do not",
            "rotate the pixels themselves and remove the tag, before you calibrate",
        )


def _decode_deep_colour(path: Path, content: bytes) -> UInt16[ndarray, "h w 3"]:
    """16-bit RGB, which Pillow would reduce to 8 bit."""
    import cv2

    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise FileError(
            path,
            "cannot be decoded as 16-bit RGB",
            "it is an unusual variant of its format",
            "save it as PNG, grey or RGB, with 8 or 16 bits",
        )
    return np.ascontiguousarray(pixels[..., ::-1])
