"""Coordinate files of a scan: float32 (H, W, 2), in an .npz under `coords` or as plain .npy, never pickled."""

import math
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedIOBase, BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from numpy.lib import format as npy

from sl_nerfstudio.scan.file_error import FileError, check_file

KEY = "coords"
_MAX_MEMBERS = 64
_EXPORT_AGAIN = "write it with numpy.savez_compressed(file, coords=array) from a float32 array of shape (H, W, 2)"
ARRAY_DAMAGE = (
    OSError,
    ValueError,
    EOFError,
    RuntimeError,
    NotImplementedError,
    KeyError,
    SyntaxError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What reading a damaged .npy or .npz may raise."""


def read_coords_size(path: Path) -> tuple[int, int]:
    """(w, h) of a coordinate file, from its header alone. Raises FileError if it is not of the required kind."""
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
    buffer = BytesIO()
    np.savez_compressed(buffer, **{KEY: coords})
    return buffer.getvalue()


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
            raise FileError(path, "is neither .npz nor .npy", "it is an array in another format", _EXPORT_AGAIN)
    except FileError:
        raise
    except ARRAY_DAMAGE as error:
        raise FileError(
            path,
            f"cannot be read ({error})",
            "the file is truncated, damaged or not what its name says",
            _EXPORT_AGAIN,
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
