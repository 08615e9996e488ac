"""The user's masks: one image for each frame, named like the frame."""

import hashlib
import os
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import Decoded, DecodingError
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.selection.mask_file import read_mask
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.file_error import FileError, unreadable
from sl_nerfstudio.verdict.verdict import listed

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
_LISTED = 20  # frames in a message


@dataclass(frozen=True)
class UserMasks:
    """The file of each frame's mask, and a digest of the pixels that it selects."""

    folder: Path
    sizes: dict[str, tuple[int, int]]  # (w, h) by the frame's name
    files: dict[str, Path]  # by the frame's name
    digests: dict[str, str]

    def applied(self, frame: str, decoded: Decoded) -> Decoded:
        """A decoded frame without what is outside its mask.

        Stored frames are not masked, so that other masks need no decoding. Raises DecodingError if nothing decoded is
        inside the mask, UserError if the mask is another one than at the start of the run.
        """
        path = self.files[frame]
        mask = read_mask(path, self.sizes[frame])
        if _digest(mask) != self.digests[frame]:
            raise UserError(
                f"{path}: was changed while sl-process was running\n    cause:  another program wrote it\n"
                "    remedy: start again; decoded frames are kept"
            )
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
        """Of all masks together."""
        lines = "\n".join(f"{name} {digest}" for name, digest in sorted(self.digests.items()))
        return hashlib.sha256(lines.encode()).hexdigest()[:24]


def find_masks(folder: Path, frames: dict[str, tuple[int, int]]) -> UserMasks:
    """The masks of all frames, each read and checked. `frames` are the sizes (w, h) of the captures by their names.

    Raises FileError that names all frames without a mask, or all masks that cannot be used.
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
            folder, f"has no mask for {_count(len(missing), len(frames))}: {listed(missing, _LISTED)}",
            "masks are found by the name of the frame, without its ending",
            "add these masks (all white to use a whole capture), or take the captures out",
        )  # fmt: skip
    twice = [name for name, number in Counter(p.stem for p in found).items() if number > 1 and name in frames]
    if twice:
        raise FileError(
            folder,
            f"holds several masks for {listed(twice, _LISTED)}",
            "the same mask in two formats",
            "keep one of them",
        )
    used = {name: files[name] for name in frames}
    return UserMasks(folder, frames, used, _checked(used, frames))


def _checked(files: dict[str, Path], sizes: dict[str, tuple[int, int]]) -> dict[str, str]:
    digests, faults = {}, []
    for name, path in track(files.items(), "reading masks", len(files)):
        try:
            digests[name] = _digest(read_mask(path, sizes[name]))
        except FileError as error:
            faults.append(error)
    if faults:
        first, others = faults[0], [fault.path.name for fault in faults[1:]]
        more = f" (and {len(others)} more cannot be used: {listed(others, _LISTED)})" if others else ""
        raise FileError(first.path, first.problem + more, first.cause, first.remedy)
    return digests


def _digest(mask: Bool[ndarray, "h w"]) -> str:
    return hashlib.sha256(np.packbits(mask).tobytes()).hexdigest()[:24]


def _count(some: int, total: int) -> str:
    return f"{some} of {total} frames"
