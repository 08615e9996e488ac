"""Which scan a run was trained on: a hash that its config.yml and its checkpoints carry."""

import hashlib
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan import FileError, Scan
from sl_nerfstudio.scan.document import TRANSFORMS

_CHUNK = 1 << 20  # bytes


def scan_fingerprint(scan: Scan) -> str:
    """SHA-256 (hexadecimal) of transforms.json and of every frame's coordinates and mask, in the order of the frames.

    Neither the folder's place nor the times of its files have a part in it. Raises UserError for unreadable files.
    """
    whole = hashlib.sha256()
    paths = [path for frame in scan.frames for path in (frame.coords_path, frame.mask_path) if path is not None]
    for path in (scan.root / TRANSFORMS, *paths):
        whole.update(_file_hash(path))
    return whole.hexdigest()


def _file_hash(path: Path) -> bytes:
    found = hashlib.sha256()
    try:
        with path.open("rb") as stream:
            while chunk := stream.read(_CHUNK):
                found.update(chunk)
    except OSError as error:
        raise FileError(
            path, f"cannot be read ({error.strerror})", "it was removed meanwhile", "restore the file"
        ) from error
    return found.digest()


def require_same_scan(root: Path, actual: str, stated: str | None, of_what: str) -> None:
    """Raise UserError if the scan in `root` is not the one that a file (`of_what`) was made from."""
    if actual != stated:
        raise UserError(
            f"{root}: does not belong to {of_what}, which was trained on another scan\n"
            "    cause:  the scan was changed, processed again or exchanged since the training "
            f"(its {TRANSFORMS}, coordinates or masks)\n"
            "    remedy: give the unchanged scan with --data FOLDER, or train again under another name"
        )
