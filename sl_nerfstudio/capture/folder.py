"""The folder of captures: frames appear complete or not at all, nothing is overwritten, and it can be continued."""

import hashlib
import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.atomic import remove_partial, write_atomic
from sl_nerfstudio.files.lock import LOCK, locked
from sl_nerfstudio.files.paths import cannot_write
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.document import read_document
from sl_nerfstudio.scan.images import encode_png

DESCRIPTION = "capture.json"
FORMAT = 1
_COMPARED = {"sl_capture": "format", "pattern": "pattern", "w": "image width", "h": "image height"}
_UNFINISHED = ".sl-unfinished"  # a sequence that is being written
_FRAME = re.compile(r"frame_(\d+)(\.png)?")


class CaptureFolder:
    """Takes frames: single images, or sequences in sub-folders of their own."""

    def __init__(self, root: Path, pattern: PatternLayout | None, size: tuple[int, int]) -> None:
        """Make the folder, or go on with one of the same pattern and image size (w, h).

        Raises UserError if it holds anything else, or is in use.
        """
        self.root = root
        digest = None if pattern is None else hashlib.sha256(pattern.encode()).hexdigest()
        described = {"sl_capture": FORMAT, "pattern": digest, "w": size[0], "h": size[1]}
        content = f"{json.dumps(described, indent=1)}\n".encode()
        self._lock = locked(root)
        self._lock.__enter__()
        try:
            remove_partial(root)
            if (root / DESCRIPTION).exists():
                self._check(described)
            else:
                self._require_new()
                write_atomic(root / DESCRIPTION, content)
            shutil.rmtree(root / _UNFINISHED, ignore_errors=True)
        except BaseException as error:
            self._lock.__exit__(type(error), error, error.__traceback__)
            raise

    def _require_new(self) -> None:
        if any(path.name != LOCK for path in self.root.iterdir()):
            raise UserError(
                f"{self.root}: is not empty\n    cause:  it holds something else than captures of this command\n"
                "    remedy: choose another output, or remove it first"
            )

    def _check(self, described: dict[str, object]) -> None:
        found = read_document(self.root / DESCRIPTION)
        for key, what in (
            ("sl_capture", "format"),
            ("pattern", "pattern"),
            ("w", "image width"),
            ("h", "image height"),
        ):
            if found.get(key) != described[key]:
                raise UserError(
                    f"{self.root}: was begun with another {what}\n"
                    f"    cause:  {DESCRIPTION} says {found.get(key)}, now it is {described[key]}\n"
                    "    remedy: choose another output; a scan needs one pattern and one camera mode"
                )

    @property
    def frames(self) -> list[Path]:
        """Images or folders of the frames so far, by their number."""
        found = {path: match for path in self.root.iterdir() if (match := _FRAME.fullmatch(path.name))}
        return sorted(found, key=lambda path: int(found[path][1]))

    def add(self, image: UInt8[ndarray, "h w *c"]) -> Path:
        """Write a frame of one image."""
        path = self.root / f"{self._next()}.png"
        write_atomic(path, encode_png(image))
        return path

    def add_sequence(self, images: Sequence[UInt8[ndarray, "h w *c"]]) -> Path:
        """Write a frame of several images, 00.png and so on, into a sub-folder."""
        path, unfinished = self.root / self._next(), self.root / _UNFINISHED
        for index, image in enumerate(images):
            write_atomic(unfinished / f"{index:02d}.png", encode_png(image))
        try:
            unfinished.rename(path)
        except OSError as error:
            raise cannot_write(path, error) from error
        return path

    def _next(self) -> str:
        numbers = [int(match[1]) for path in self.root.iterdir() if (match := _FRAME.fullmatch(path.name))]
        return f"frame_{max(numbers, default=-1) + 1:04d}"

    def __enter__(self) -> "CaptureFolder":
        """The folder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let go of the folder; it is removed if it holds no frame."""
        if not self.frames:
            (self.root / DESCRIPTION).unlink(missing_ok=True)
        self._lock.__exit__(kind, error, trace)
