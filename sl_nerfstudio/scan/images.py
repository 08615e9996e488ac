"""Image files: those of a scan, read exactly as stored or not at all, and photographs."""

import math
import shlex
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from numbers import Real
from pathlib import Path
from threading import Lock

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray
from PIL import Image
from PIL.ImageFile import ImageFile
from PIL.PngImagePlugin import PngImageFile

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.document import FileError, check_file, read_bytes, unreadable

# Images of a scan: grey or RGB, 8 or 16 bit.

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
_DAMAGE = (OSError, SyntaxError, ValueError, EOFError, TypeError, LookupError, OverflowError, struct.error, zlib.error)
"""What reading a damaged image may raise."""


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image file; `mode` is "grey" or "RGB"."""

    w: int
    h: int
    mode: str
    bits: int


def read_header(path: Path) -> ImageHeader:
    """Size and kind of an image, without decoding it. Raises FileError for kinds that a scan must not hold."""
    header, orientation = read_header_and_orientation(path)
    _refuse_orientation(path, orientation)
    return header


def read_header_and_orientation(path: Path, photograph: bool = False) -> tuple[ImageHeader, int]:
    """Size and kind as stored, and the EXIF orientation (1: as stored). Raises FileError for other kinds.

    Of a photograph with a palette or an alpha channel the pixels are decoded, too: they say whether it can be used.
    """
    check_file(path)
    try:
        with path.open("rb") as stream:
            image = _open(path, stream)
            if photograph and _has_more(image):
                pixels = _plain_pixels(path, read_bytes(path), image)
                h, w = pixels.shape[:2]
                header = ImageHeader(w, h, "grey" if pixels.ndim == 2 else "RGB", 8 * pixels.itemsize)
                return header, _orientation(path, image)
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


def read_pixels_and_orientation(
    path: Path, photograph: bool = False
) -> tuple[UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"], int]:
    """The pixels as stored, and the EXIF orientation (1: as stored). Raises FileError like `read_image`.

    A photograph may have an alpha channel that is opaque, a palette of greys, or one bit per pixel.
    """
    content = read_bytes(path)
    image = _open(path, BytesIO(content))
    if photograph and _has_more(image):
        return _plain_pixels(path, content, image), _orientation(path, image)
    header = _header(path, image)
    _orientation(path, image)
    with _decoding(path):
        image.load()
    if isinstance(image, PngImageFile):
        _check_png_sums(path, content)
    orientation = _orientation(path, image)  # again: a PNG may have the tag after its pixels
    if header.bits == 16 and header.mode == "RGB":
        return _decode_deep(path, content, 3), orientation
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
            path, "holds several images", "it is an animation or a multi-page TIFF", "write each image to its own file"
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


def _has_more(image: ImageFile) -> bool:
    """Whether an image has a palette, transparency, or one bit per pixel."""
    return image.mode in _OTHER_KINDS or "transparency" in image.info


def _plain_pixels(path: Path, content: bytes, image: ImageFile) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]:
    """The pixels of a photograph without its palette and its alpha channel.

    Raises FileError if it is transparent anywhere, or its palette has colours: which intensity such pixels have is not
    certain.
    """
    deep = ";16" in (str(image.tile[0][3]) if image.tile else "")
    with _decoding(path):
        values = _decode_deep(path, content, 4) if deep else np.array(image.convert("RGBA"))
    if isinstance(image, PngImageFile):
        _check_png_sums(path, content)
    pixels, alpha = values[..., :3], values[..., 3]
    opaque = bool((alpha == np.iinfo(values.dtype).max).all())
    grey = image.mode in ("1", "LA", "L") or (image.mode in ("P", "PA") and bool((pixels == pixels[..., :1]).all()))
    if not opaque or (image.mode in ("P", "PA") and not grey):
        raise FileError(
            path,
            "has a palette of colours" if opaque else "is transparent in places",
            "it was cut out or reduced to few colours by a program; which intensity such pixels had is not certain",
            'save the photographs again from the camera, or convert them: python -c "import sys, pathlib; from PIL '
            "import Image; [Image.open(p).convert('RGB').save('converted/' + pathlib.Path(p).name) for p in "
            f'sys.argv[1:]]" {shlex.quote(str(path.parent))}/*{path.suffix}, after mkdir converted',
        )
    return np.ascontiguousarray(pixels[..., 0] if grey else pixels)


@contextmanager
def _decoding(path: Path) -> Iterator[None]:
    try:
        yield
    except MemoryError as error:
        raise FileError(path, "does not fit into memory", "the image is huge", "use smaller images") from error
    except _DAMAGE as error:
        raise FileError(
            path,
            f"cannot be decoded ({error})",
            "the file is truncated or damaged, for example by an interrupted copy or a full disk",
            "copy or export this image again",
        ) from error


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


def _decode_deep(path: Path, content: bytes, channels: int) -> UInt16[ndarray, "h w c"]:
    """16-bit RGB or RGBA, which Pillow would reduce to 8 bit."""
    import cv2

    pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] != channels:
        raise FileError(
            path,
            f"cannot be decoded as 16-bit RGB{'A' * (channels - 3)}",
            "it is an unusual variant of its format",
            "save it as PNG, grey or RGB, with 8 or 16 bits",
        )
    return np.ascontiguousarray(pixels[..., [2, 1, 0, 3][:channels]])


# Photographs as cameras and phones write them: turned as their EXIF tag says, HEIC too; raw files are refused.
#
# A scan folder itself holds only images that need no turning.

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


def read_photograph(path: Path, shrink: int = 1) -> Pixels:
    """All pixels, (h, w) grey or (h, w, 3) RGB, 8 or 16 bit, turned as the EXIF tag says, then `shrunk`.

    Raises FileError for what cannot be read, and for raw files, with the command that converts them.
    """
    if path.suffix.lower() in RAW:
        raise raw_file(path)
    if path.suffix.lower() in PHONE:
        return shrunk(np.asarray(_open_heif(path).to_pillow().convert("RGB")), shrink)
    pixels, orientation = read_pixels_and_orientation(path, photograph=True)
    return shrunk(turned(pixels, orientation), shrink)


def shrunk(pixels: Pixels, factor: int) -> Pixels:
    """Means over squares of `factor` pixels, of the same type; rows and columns that fill no square are left out."""
    import cv2

    if factor == 1:
        return pixels
    h, w = pixels.shape[0] // factor, pixels.shape[1] // factor
    return cv2.resize(pixels[: h * factor, : w * factor], (w, h), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def photograph_header(path: Path) -> ImageHeader:
    """Size and kind after turning, without decoding the pixels. Raises FileError like `read_photograph`."""
    if path.suffix.lower() in RAW:
        raise raw_file(path)
    if path.suffix.lower() in PHONE:
        w, h = _open_heif(path).size
        return ImageHeader(w, h, "RGB", 8)
    header, orientation = read_header_and_orientation(path, photograph=True)
    if orientation in _TRANSPOSED:
        return ImageHeader(header.h, header.w, header.mode, header.bits)
    return header


def turned_by_tag(path: Path) -> bool:
    """Whether an EXIF tag says that the pixels are stored turned or mirrored. Raises FileError if it is no image."""
    return path.suffix.lower() not in PHONE and read_header_and_orientation(path, True)[1] != 1


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
        mosaic = path.suffix.lower() not in PHONE and is_mosaic(read_pixels_and_orientation(path, True)[0])
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
