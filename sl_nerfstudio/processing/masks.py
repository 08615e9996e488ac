"""The user's masks: one image for each frame, named like the frame."""

import hashlib
import os
from collections import Counter
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8, UInt16
from numpy import ndarray
from PIL import Image, UnidentifiedImageError

from sl_nerfstudio.console import track
from sl_nerfstudio.decoding.decoder import Decoded, DecodingError
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.captures import with_others
from sl_nerfstudio.review.verdict import listed
from sl_nerfstudio.scan.document import FileError, read_bytes, unreadable
from sl_nerfstudio.scan.images import FORMATS, read_image, shrunk

# One mask as a user makes it: white is used, black is not.

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


def _read(path: Path) -> tuple[UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"], Bool[ndarray, "h w"]]:
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


ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_LISTED = 20  # frames in a message


@dataclass(frozen=True)
class UserMasks:
    """The file of each frame's mask, and a digest of the pixels that it selects."""

    folder: Path
    sizes: dict[str, tuple[int, int]]  # (w, h) by the frame's name
    files: dict[str, Path]  # by the frame's name
    digests: dict[str, str]
    shrink: int = 1  # by which the captures are shrunk when they are read

    def of(self, frame: str) -> Bool[ndarray, "h w"]:
        """The mask of a frame as its capture is read. Raises UserError if it is another one than at the beginning."""
        path = self.files[frame]
        mask = read_mask(path, self.sizes[frame])
        if _digest(mask) != self.digests[frame]:
            raise UserError(
                f"{path}: was changed while sl-process was running\n    cause:  another program wrote it\n"
                "    remedy: start again; decoded frames are kept"
            )
        return shrunk(255 * mask.astype(np.uint8), self.shrink) >= 128

    def applied(self, frame: str, decoded: Decoded) -> Decoded:
        """A decoded frame without what is outside its mask.

        Stored frames are not masked, so that other masks need no decoding. Raises DecodingError if nothing decoded is
        inside the mask, UserError if the mask is another one than at the start of the run.
        """
        path, mask = self.files[frame], self.of(frame)
        if not (decoded.decoded & mask).any():
            raise DecodingError(
                f"no decoded pixel is inside its mask, {path}", "the mask belongs to another frame, or is inverted",
                "compare mask and capture",
            )  # fmt: skip
        coords = np.where(mask[..., None], decoded.coords, np.float32(np.nan))
        pattern = np.where(mask, decoded.pattern, np.float32(0))
        return replace(decoded, coords=coords, mask=decoded.mask & mask, pattern=pattern)

    @property
    def digest(self) -> str:
        """Digest of all masks together."""
        lines = "\n".join(f"{name} {digest}" for name, digest in sorted(self.digests.items()))
        return hashlib.sha256(lines.encode()).hexdigest()[:24]


def find_masks(folder: Path, frames: dict[str, tuple[int, int]], shrink: int = 1) -> UserMasks:
    """The masks of all frames, each read and checked. `frames` are the sizes (w, h) of the captures by their names.

    A square of `shrink` pixels is used if half of it is. Raises FileError that names all frames without a mask, or all
    masks that cannot be used.
    """
    if not os.path.isdir(folder):  # Path.is_dir raises for a name that is too long
        raise FileError(folder, "is no folder", "a typing error in --masks", "give the folder with the masks")
    try:
        found = sorted(p for p in folder.iterdir() if p.suffix.lower() in ENDINGS and not p.name.startswith("."))
    except OSError as error:
        raise unreadable(folder, error) from error
    if not found:
        raise FileError(
            folder, "holds no masks", "a typing error in --masks, or images of another format",
            f"give a folder of {', '.join(ENDINGS)} files, one for each frame",
        )  # fmt: skip
    files = {path.stem: path for path in found}
    missing = [name for name in frames if name not in files]
    if missing:
        raise FileError(
            folder, f"has no mask for {len(missing)} of {len(frames)} frames: {listed(missing, _LISTED)}",
            "masks are found by the name of the frame, without its ending",
            "add these masks (all white to use a whole capture), or take the captures out",
        )  # fmt: skip
    twice = [name for name, number in Counter(p.stem for p in found).items() if number > 1 and name in frames]
    if twice:
        problem = f"holds several masks for {listed(twice, _LISTED)}"
        raise FileError(folder, problem, "the same mask in two formats", "keep one of them")
    used = {name: files[name] for name in frames}
    return UserMasks(folder, frames, used, _checked(used, frames), shrink)


def _checked(files: dict[str, Path], sizes: dict[str, tuple[int, int]]) -> dict[str, str]:
    digests, faults = {}, []
    for name, path in track(files.items(), "reading masks", len(files)):
        try:
            digests[name] = _digest(read_mask(path, sizes[name]))
        except FileError as error:
            faults.append(error)
    if faults:
        raise with_others(faults)
    return digests


def _digest(mask: Bool[ndarray, "h w"]) -> str:
    return hashlib.sha256(np.packbits(mask).tobytes()).hexdigest()[:24]
