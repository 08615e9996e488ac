"""The coordinates of a frame as files: an array, a pair of 16-bit images, or one TIFF with both; and what they mean."""

import logging
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from jaxtyping import Float32, UInt16
from numpy import ndarray
from numpy.lib import format as npy

from sl_nerfstudio.scan.document import Fields, FileError, check_file, read_bytes, read_path
from sl_nerfstudio.scan.images import MAX_PIXELS, read_header, read_image
from sl_nerfstudio.storage import encode_npz

if TYPE_CHECKING:
    from tifffile import TiffPage

# What the numbers of images mean. Those of arrays are always pattern pixels.

CoordsUnits = Literal["pixels", "parts_of_65535"]
UNITS_KEY = "sl_coords_units"
PAIR_KEYS = ("coords_x", "coords_y")
COORDS_KEYS = ("sl_coords_path", *PAIR_KEYS)
FULL = 65535  # the number of the pattern's right and lower border in `parts_of_65535`
_STATE_UNITS = f'state "{UNITS_KEY}": "pixels" or "parts_of_65535" in the frame, or once for all frames'


@dataclass(frozen=True)
class CoordinateFiles:
    """The files that hold a frame's coordinates: one of both, or that of x and that of y."""

    paths: tuple[Path, ...]
    units: CoordsUnits = "pixels"
    pattern: tuple[int, int] = (0, 0)  # width and height in pixels; read for `parts_of_65535` only

    @property
    def are_images(self) -> bool:
        """Whether they are images; otherwise an array."""
        return all(map(is_image, self.paths)) or len(self.paths) == 2

    def read(self) -> Float32[ndarray, "h w 2"]:
        """Pattern coordinates (x_p, y_p) of each pixel in pattern pixels, NaN where not decoded.

        Arrays and images of floating-point pixels are returned as stored. A 16-bit number counts whole pattern pixels,
        and stands for the centre of the one that it counts. Raises FileError for a file that cannot be used.
        """
        first, *second = self.paths
        if not self.are_images:
            return read_coords(first)
        values = _read_pair(first, second[0]) if second else _read_both(first)
        if self.units == "pixels" and values.dtype == np.float32:
            return values
        coords = values.astype(np.float64)
        if self.units == "pixels":
            coords += 0.5
        else:
            coords *= np.array(self.pattern) / FULL
        if values.dtype == np.uint16:
            coords[(values == 0).any(-1)] = np.nan
        return coords.astype(np.float32)


def read_coords_keys(
    frame: Fields, top: Fields, root: Path, needed: bool
) -> tuple[dict[str, Path], CoordsUnits | None]:
    """The files of a frame's coordinates by their keys, and their unit; None after adding a fault."""
    pair = [key for key in PAIR_KEYS if frame.record.get(key) is not None]
    alone = frame.record.get("sl_coords_path") is not None
    if pair and alone:
        frame.fault(
            pair[0], "is given together with sl_coords_path", "the coordinates were exported twice, and may differ",
            "keep one of the two forms",
        )  # fmt: skip
        return {}, None
    if len(pair) == 1:
        frame.fault(
            PAIR_KEYS[1 - PAIR_KEYS.index(pair[0])], f"is missing, although {pair[0]} is given",
            "only one of the two images was exported or listed", "give both: a coordinate is a pair of numbers",
        )  # fmt: skip
    keys = pair or (["sl_coords_path"] if alone or needed else [])
    found = {key: path for key in keys if (path := read_path(frame, key, root)) is not None}
    if not found:
        return {}, None
    images = bool(pair) or is_image(found["sl_coords_path"])
    return found, _read_units(frame, top, images)


def _read_units(frame: Fields, top: Fields, images: bool) -> CoordsUnits | None:
    stated = [fields for fields in (frame, top) if fields.record.get(UNITS_KEY) is not None]
    texts = [
        fields.read_choice(UNITS_KEY, get_args(CoordsUnits), "it is not a unit of coordinates") for fields in stated
    ]
    values = [unit for unit in get_args(CoordsUnits) if unit in texts]
    if None in texts:
        return None
    if len(values) > 1:
        frame.fault(
            UNITS_KEY, f"is {texts[0]} here but {texts[1]} for all frames", "the unit was stated twice",
            "state it once for all frames, or in every frame",
        )  # fmt: skip
    elif images and not values:
        cause = "an image does not say whether its numbers are pattern pixels or parts of the pattern's size"
        frame.fault(UNITS_KEY, "is missing, although the coordinates are images", cause, _STATE_UNITS)
    elif not images and "parts_of_65535" in values:
        cause = "coordinates in .npz and .npy files are always pattern pixels"
        remedy = "state it only in frames whose coordinates are images"
        frame.fault(UNITS_KEY, "is parts_of_65535, although the coordinates are an array", cause, remedy)
    else:
        return values[0] if values else "pixels"
    return None


# Images of coordinates: 16-bit pairs of grey images; TIFF with x, y and perhaps a third channel without content.

_TIFF = (".tif", ".tiff")
_EXR = ".exr"
_STORE = (
    'tifffile.imwrite(file, array, photometric="minisblack", planarconfig="contig") from a float32 or uint16 array '
    "of shape (H, W, 2)"
)
logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what is wrong with a file is said here
_LOSSLESS = (1, 5, 8, 32773, 32946)  # numbers of TIFF's compressions: none, LZW, Deflate, PackBits, Deflate
_LZW, _FLOATING_PREDICTOR = 5, 3
_PLAIN = (1, 2)  # numbers of TIFF's colour models: grey with black at 0, and RGB
_TIFF_DAMAGE = (
    *(OSError, ValueError, EOFError, RuntimeError, LookupError, TypeError, AttributeError, ArithmeticError),
    *(MemoryError, struct.error, zlib.error),
)


def is_image(path: Path) -> bool:
    """Whether a file of coordinates is an image, by its ending."""
    return path.suffix.lower() in (*_TIFF, _EXR)


def read_half_size(path: Path) -> tuple[int, int]:
    """(w, h) of the image of x or of y, from its header. Raises FileError unless it is grey with 16 bits."""
    header = read_header(path)
    if header.mode != "grey":
        raise FileError(
            path, "is in colour", "it holds both coordinates, or was saved by a program that writes only RGB",
            "save x and y as one grey 16-bit PNG each; or both as a TIFF, under sl_coords_path",
        )  # fmt: skip
    if header.bits != 16:
        raise FileError(
            path, f"has {header.bits} bits a pixel instead of 16", "it was saved with the 256 levels of a photograph",
            "save the coordinates again as a 16-bit PNG: in 256 levels they are too coarse",
        )  # fmt: skip
    return header.w, header.h


def _read_pair(path_x: Path, path_y: Path) -> UInt16[ndarray, "h w 2"]:
    sizes = read_half_size(path_x), read_half_size(path_y)
    if sizes[0] != sizes[1]:
        (w, h), (other_w, other_h) = sizes
        raise FileError(
            path_y, f"is {other_w} x {other_h} pixels, but that of x is {w} x {h}", "one of the two was resized",
            "give the original files",
        )  # fmt: skip
    return np.stack([read_image(path_x), read_image(path_y)], -1).astype(np.uint16)


def _read_both(path: Path) -> UInt16[ndarray, "h w 2"] | Float32[ndarray, "h w 2"]:
    """x and y of a TIFF with two or three channels, as stored; a third one must say nothing."""
    with _page(path) as page:
        w, h = _tiff_size(path, page)
        by_opencv = page.compression == _LZW or page.predictor == _FLOATING_PREDICTOR
        values = None if by_opencv else np.asarray(page.asarray())
        separate, dtype = page.planarconfig == 2, page.dtype
    if values is None:
        values = _by_opencv(path)
    elif separate:
        values = np.moveaxis(values, 0, -1)
    if values.shape[:2] != (h, w) or values.dtype != dtype:
        raise FileError(
            path, "has other pixels than its header says", "it is damaged", f"write it again, with {_STORE}"
        )
    if values.shape[2] == 3:
        third = values[..., 2][~_undecoded(values[..., :2])]
        if third.size and not (third == third[0]).all():
            raise FileError(
                path,
                f"has a third channel that is not the same at all decoded pixels ({third.min():g} to {third.max():g})",
                "it is a picture, or the order of its channels is not x, y",
                "store x, y and 0 (or a mask) in this order: red, green, blue",
            )
    return np.ascontiguousarray(values[..., :2])


def _undecoded(values: ndarray) -> ndarray:
    return (values == 0).any(-1) if values.dtype == np.uint16 else np.isnan(values).any(-1)


def _by_opencv(path: Path) -> ndarray:
    """Three channels whose compression tifffile does not know."""
    import cv2

    values = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.ndim != 3:
        raise FileError(path, "cannot be decoded", "it is truncated or damaged", f"write it again, with {_STORE}")
    return values[..., ::-1]


@contextmanager
def _page(path: Path) -> "Iterator[TiffPage]":
    """The only image in a TIFF, its header read; any damage becomes a FileError."""
    check_file(path)
    if path.suffix.lower() == _EXR:
        raise FileError(
            path,
            "is an EXR file, a format that is not read",
            "OpenCV's reader for it is switched off, because prepared files can take it over",
            "convert your own: OPENCV_IO_ENABLE_OPENEXR=1 python -c \"import cv2, numpy; a = cv2.imread('"
            f"{path.name}', -1); numpy.savez_compressed('{path.stem}.npz', coords=a[..., 2:0:-1])\" (coords as float32 "
            "in pattern pixels, red is x and green is y)",
        )
    from tifffile import TiffFile, TiffFileError

    try:
        with path.open("rb") as stream, TiffFile(stream) as file:
            if not len(file.pages):
                raise ValueError("there is no image in it")
            if len(file.pages) > 1:
                raise FileError(
                    path, f"holds {len(file.pages)} images", "each row or channel was written as an image of its own",
                    f"write it with {_STORE}",
                )  # fmt: skip
            page = file.pages.first
            if not (page.dataoffsets and all(page.dataoffsets) and all(page.databytecounts)):
                raise ValueError("a part of the image is not there")  # tifffile would put 0
            yield page
    except FileError:
        raise
    except (*_TIFF_DAMAGE, TiffFileError) as error:
        raise FileError(
            path, f"cannot be read ({error})", "the file is truncated, damaged or not what its name says",
            f"write it again, with {_STORE}",
        ) from error  # fmt: skip


def _tiff_size(path: Path, page: "TiffPage") -> tuple[int, int]:
    """(w, h) from the header. Raises FileError unless it holds coordinates without loss."""
    w, h, channels, kind = page.imagewidth, page.imagelength, page.samplesperpixel, page.dtype
    if w * h > MAX_PIXELS:
        raise FileError(path, f"is {w} x {h} pixels large", "its header is damaged", f"write it again, with {_STORE}")
    if channels not in (2, 3):
        cause = "it holds x or y alone: then give both files as coords_x and coords_y"
        if channels != 1:
            cause = "it is another kind of image"
        raise FileError(
            path, f"has {channels} channel{'s'[: channels - 1]} instead of 2 or 3", cause, f"write it with {_STORE}"
        )
    if page.compression not in _LOSSLESS or page.photometric not in _PLAIN:
        raise FileError(
            path,
            "is compressed as a photograph, which changes its numbers (colour model "
            f"{int(page.photometric or 0)}, compression {int(page.compression)} of TIFF)",
            "OpenCV writes floating-point TIFF in this way unless it is told otherwise",
            "write it with cv2.imwrite(file, array, [cv2.IMWRITE_TIFF_COMPRESSION, 1])",
        )
    if kind not in (np.float32, np.uint16):
        cause = "too few levels for coordinates" if kind in (np.uint8, np.float16) else "it was saved from another type"
        raise FileError(path, f"holds {kind} instead of float32 or uint16", cause, f"write it with {_STORE}")
    if channels == 2 and (page.compression == _LZW or page.predictor == _FLOATING_PREDICTOR):
        raise FileError(
            path, "has two channels with a compression that is not read (LZW)", "the program's default",
            f"write it with {_STORE}",
        )  # fmt: skip
    return w, h


# Arrays: float32 (H, W, 2), in an .npz under `coords` or as plain .npy, never pickled.

KEY = "coords"
_MAX_MEMBERS = 64
_EXPORT_AGAIN = "write it with numpy.savez_compressed(file, coords=array) from a float32 array of shape (H, W, 2)"
ARRAY_DAMAGE = (OSError, ValueError, EOFError, RuntimeError, KeyError, SyntaxError, zipfile.BadZipFile, zlib.error)
"""What reading a damaged .npy or .npz may raise."""


def read_coords_size(path: Path) -> tuple[int, int]:
    """(w, h) of a file of both coordinates, from its header alone. Raises FileError if it is not of a required kind."""
    if is_image(path):
        with _page(path) as page:
            return _tiff_size(path, page)
    with _open_member(path) as (stream, size):
        return _read_head(path, stream, size)


def read_coords(path: Path) -> Float32[ndarray, "h w 2"]:
    """Pattern coordinates (x_p, y_p) of every pixel, as stored.

    Raises FileError if the file is missing, damaged, pickled, or not float32 of shape (H, W, 2); the header is
    checked against the size of the file before any memory is allocated.
    """
    with _open_member(path) as (stream, size):
        _read_head(path, stream, size)
    with _open_member(path) as (stream, _):
        coords = npy.read_array(stream, allow_pickle=False)
    return np.ascontiguousarray(coords, dtype=np.float32)


def encode_coords(coords: Float32[ndarray, "h w 2"]) -> bytes:
    """A compressed .npz file of the coordinates."""
    return encode_npz({KEY: coords})


@contextmanager
def _open_member(path: Path) -> Iterator[tuple[BufferedIOBase, int]]:
    """The .npy stream in `path` and its length in bytes; any damage becomes a FileError."""
    size = check_file(path)
    try:
        if path.suffix.lower() == ".npy":
            with path.open("rb") as stream:
                yield stream, size
        elif path.suffix.lower() == ".npz":
            with zipfile.ZipFile(path) as archive:
                member = _member(path, archive)
                with archive.open(member) as stream:
                    yield stream, member.file_size  # type: ignore[misc]
        else:
            raise FileError(path, "is neither .npz nor .npy nor .tif", "it is in another format", _EXPORT_AGAIN)
    except FileError:
        raise
    except ARRAY_DAMAGE as error:
        raise FileError(
            path, f"cannot be read ({error})", "the file is truncated, damaged or not what its name says", _EXPORT_AGAIN
        ) from error


def _member(path: Path, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    members = archive.infolist()
    if len(members) > _MAX_MEMBERS:
        raise FileError(path, f"holds {len(members)} members", "it is not a coordinate file", _EXPORT_AGAIN)
    found = [member for member in members if member.filename == f"{KEY}.npy"]
    if len(found) != 1:
        names = ", ".join(repr(member.filename.removesuffix(".npy")) for member in members[:5]) or "nothing"
        raise FileError(
            path,
            f"must hold exactly one array called {KEY!r}, but holds {names}",
            "it was saved under another key, or without a key (numpy then calls it 'arr_0')",
            _EXPORT_AGAIN,
        )
    return found[0]


def _read_head(path: Path, stream: BufferedIOBase, size: int) -> tuple[int, int]:
    """Check the header of a .npy stream of `size` bytes in total; return (w, h)."""
    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise FileError(path, f"is of .npy version {version}", "it does not hold plain numbers", _EXPORT_AGAIN)
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(stream)
    if dtype.hasobject:
        raise FileError(
            path,
            "holds pickled Python objects, which are never loaded",
            "it was saved from an array of dtype object; such a file can run code when it is loaded",
            _EXPORT_AGAIN,
        )
    if dtype.kind != "f" or dtype.itemsize != 4:
        raise FileError(
            path, f"holds {dtype} instead of float32", "it was saved from an array of another type", _EXPORT_AGAIN
        )
    if len(shape) != 3 or shape[2] != 2 or 0 in shape:
        cause = "the channels come first" if len(shape) == 3 and shape[0] == 2 else "it is another kind of array"
        raise FileError(path, f"has the shape {shape} instead of (H, W, 2)", cause, _EXPORT_AGAIN)
    expected = math.prod(shape) * dtype.itemsize + stream.tell()
    if size != expected:
        raise FileError(
            path,
            f"has {size} bytes, but its header says {expected}",
            "the file is truncated, or its header is wrong",
            _EXPORT_AGAIN,
        )
    return shape[1], shape[0]
