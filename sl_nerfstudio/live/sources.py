"""Where images come from while a live scan runs: a camera, a video file, or a folder that fills up."""

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.capture.camera import Camera, Video, open_camera
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.images import ENDINGS, read_photograph

RATE = 2.0  # images a second, of a video's own time or of a camera, at most
QUIET_S = 120.0  # without a new image after which a folder is complete
POLL_S = 0.5  # between two looks into a folder


@dataclass(frozen=True)
class Shot:
    """One image, with its name in the source."""

    name: str
    image: UInt8[ndarray, "h w 3"]


class Source(ABC):
    """Gives images one after the other; None while there is nothing new."""

    name: str

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Width and height of the images; waits for the first one."""

    @abstractmethod
    def shots(self, seen: Sequence[str]) -> Iterator[Shot | None]:
        """The images, without those that an earlier run has seen."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the source."""


class CameraSource(Source):
    """The newest image of a camera, or every so-manieth image of a video."""

    def __init__(self, camera: Camera | Video) -> None:
        self.name, self._camera = camera.name, camera

    @property
    def size(self) -> tuple[int, int]:
        """As the camera says."""
        return self._camera.size

    def shots(self, seen: Sequence[str]) -> Iterator[Shot | None]:
        """A camera has no past; the images of a video are numbered."""
        known = set() if self._camera.live else set(seen)
        for number, (_, image) in enumerate(self._camera.frames(RATE)):
            name = f"image {number}"
            if name not in known:
                yield Shot(name, image)

    def close(self) -> None:
        """Let go of the camera."""
        self._camera.close()


class FolderSource(Source):
    """The images of a folder in the order in which they arrived, also of those that come later.

    An image is read when its file has stopped growing. The folder is complete when nothing has come for some time.
    """

    def __init__(self, folder: Path, quiet_s: float = QUIET_S, wait: Callable[[float], None] = time.sleep) -> None:
        self.name, self._folder, self._quiet, self._wait = str(folder), folder, quiet_s, wait
        self._size: tuple[int, int] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Of the first image that arrives. Raises UserError if none does."""
        if self._size is None:
            first = next((shot for shot in self.shots([]) if shot is not None), None)
            if first is None:
                raise UserError(
                    f"--camera {self._folder}: no image has come\n    cause:  nothing is uploaded into this folder\n"
                    f"    remedy: let the camera save its pictures there ({', '.join(ENDINGS)})"
                )
            self._size = first.image.shape[1], first.image.shape[0]
        return self._size

    def shots(self, seen: Sequence[str]) -> Iterator[Shot | None]:
        """None each time that nothing has come."""
        known, sizes, waited = set(seen), dict[str, int](), 0.0
        while waited < self._quiet:
            found = self._images()
            ready = [name for name, size in found if name not in known and sizes.get(name) == size and size > 0]
            sizes = dict(found)
            for name in ready:
                known.add(name)
                waited = 0.0
                yield Shot(name, self._read(name))
            if not ready:
                yield None
                self._wait(POLL_S)
                waited += POLL_S

    def _images(self) -> list[tuple[str, int]]:
        """Names and sizes, the oldest first."""
        try:
            files = [e for e in os.scandir(self._folder) if e.is_file() and Path(e.name).suffix.lower() in ENDINGS]
            states = sorted((e.stat().st_mtime_ns, e.name, e.stat().st_size) for e in files)
        except OSError as error:
            raise UserError(
                f"--camera {self._folder}: cannot be read ({error.strerror})\n"
                "    cause:  the folder was removed, or it may not be read\n    remedy: give a folder that stays"
            ) from error
        return [(name, size) for _, name, size in states]

    def _read(self, name: str) -> UInt8[ndarray, "h w 3"]:
        image = read_photograph(self._folder / name)
        image = image[..., None].repeat(3, -1) if image.ndim == 2 else image[..., :3]
        return image if image.dtype == "uint8" else (image >> 8).astype("uint8")

    def close(self) -> None:
        """Nothing is held."""


def open_source(text: str) -> Source:
    """A camera by its number, a video file, or a folder. Raises UserError if it cannot be opened."""
    folder = Path(text)
    if not text.isdecimal() and not folder.exists():
        raise UserError(
            f"--camera {text}: there is no such file or folder\n    cause:  a typing error\n"
            "    remedy: give the number of a camera (0 is the first), a video file, or a folder that fills up"
        )
    return FolderSource(folder) if folder.is_dir() else CameraSource(open_camera(text))


def require_size(shot: Shot, size: tuple[int, int], source: str) -> None:
    """Raise FileError for an image of another size (w, h) than those before."""
    h, w = shot.image.shape[:2]
    if (w, h) != size:
        raise FileError(
            Path(source) / shot.name,
            f"has {w} x {h} pixels, and the images before have {size[0]} x {size[1]}",
            "another camera or another mode took it, or it is turned",
            "take all images with one camera in one mode; remove this one, and run the same command again",
        )
