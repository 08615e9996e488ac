"""Images from a camera, or from a video file in its place."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.errors import UserError

Image = UInt8[ndarray, "h w 3"]
_PATIENCE = 5.0  # seconds without an image after which a camera counts as gone
_USUAL_RATE = 30.0  # images a second of a video that does not say it
_MANUAL_EXPOSURE = 1.0  # of CAP_PROP_AUTO_EXPOSURE with V4L2


class Video:
    """The images of a video file, as if a camera took them."""

    live = False

    def __init__(self, path: Path) -> None:
        """Open the file. Raises UserError if it is not there or cannot be read."""
        self.name = str(path)
        if not path.is_file():
            raise UserError(
                f"--camera {path}: there is no such file\n    cause:  a typing error\n"
                "    remedy: give the number of a camera (0 is the first), or a video file"
            )
        self._capture = cv2.VideoCapture(self.name)
        ok, image = self._capture.read()
        if not ok:
            raise UserError(
                f"{path}: is no video that can be read\n    cause:  it is damaged, or of a kind that is not supported\n"
                "    remedy: convert it, for example to MP4 with H.264"
            )
        self.size = image.shape[1], image.shape[0]
        self._first: ndarray | None = image

    def frames(self, rate: float) -> Iterator[tuple[float, Image]]:
        """Time in seconds and image, about `rate` of them for each second of the video."""
        stated = self._capture.get(cv2.CAP_PROP_FPS)
        per_second = stated if np.isfinite(stated) and stated > 0 else _USUAL_RATE
        step = max(1, round(per_second / rate))
        index, image = 0, self._first
        while image is not None:
            yield index / per_second, _rgb(image)
            index += step
            image = None
            if all(self._capture.grab() for _ in range(step)):
                ok, image = self._capture.retrieve()
                image = image if ok else None

    def close(self) -> None:
        """Let go of the file."""
        self._capture.release()


class Camera:
    """The newest image of a camera: a thread reads all of them, so that none is old when it is used."""

    live = True

    def __init__(
        self, number: int, size: tuple[int, int] | None, exposure: float | None = None, focus: float | None = None
    ) -> None:
        """Open the camera; `exposure` and `focus` are in its own units. Raises UserError if it refuses anything."""
        self.name = f"camera {number}"
        self._capture = cv2.VideoCapture(number)
        self._capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)  # intrinsics hold for one focus
        if size is not None:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        if exposure is not None:
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
            self._set("exposure", cv2.CAP_PROP_EXPOSURE, exposure)
        if focus is not None:
            self._set("focus", cv2.CAP_PROP_FOCUS, focus)
        ok, image = self._capture.read()
        if not ok:
            self._capture.release()
            raise UserError(
                f"--camera {number}: gives no image\n    cause:  there is no such camera, or another program uses it\n"
                "    remedy: connect it, close other programs that use it, or give another number (0 is the first)"
            )
        self.size = image.shape[1], image.shape[0]
        if size is not None and self.size != size:
            self._capture.release()
            raise UserError(
                f"--size {size[0]}x{size[1]}: {self.name} gives images of {self.size[0]} x {self.size[1]} pixels\n"
                "    cause:  it has no such mode\n    remedy: give a size that it has, or leave --size out"
            )
        self._image, self._time, self._gone = image, time.monotonic(), False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _set(self, flag: str, setting: int, value: float) -> None:
        if not self._capture.set(setting, value):
            self._capture.release()
            raise UserError(
                f"--{flag} {value:g}: {self.name} does not accept it\n"
                "    cause:  it cannot be set, or the value is out of its range\n"
                f"    remedy: leave --{flag} out and set it with the camera's own program"
            )

    def _read(self) -> None:
        while not self._gone:
            begun = time.monotonic()
            ok, image = self._capture.read()
            with self._changed:
                self._gone = self._gone or not ok
                if ok:
                    self._image, self._time = image, begun
                self._changed.notify_all()

    def after(self, moment: float) -> tuple[float, Image]:
        """Time and image of the first one whose reading began after a moment (of time.monotonic).

        Raises UserError if the camera gives none for some seconds.
        """
        with self._changed:
            here = self._changed.wait_for(lambda: self._gone or self._time > moment, _PATIENCE + self._until(moment))
            if self._gone or not here:
                raise UserError(
                    f"{self.name} gives no more images\n    cause:  it was unplugged, or another program took it\n"
                    "    remedy: connect it, and run the same command again: it goes on where it was"
                )
            return self._time, _rgb(self._image)

    @property
    def newest(self) -> Image:
        """The last image that was read."""
        with self._changed:
            return _rgb(self._image)

    def frames(self, rate: float) -> Iterator[tuple[float, Image]]:
        """Time in seconds and image: always the newest, at most `rate` a second."""
        moment = -1.0
        while True:
            moment, image = self.after(moment)
            yield moment, image
            moment += 1 / rate

    def close(self) -> None:
        """Let go of the camera."""
        self._gone = True
        self._thread.join(_PATIENCE)
        self._capture.release()

    @staticmethod
    def _until(moment: float) -> float:
        return max(0.0, moment - time.monotonic())


def open_camera(
    text: str, size: tuple[int, int] | None = None, exposure: float | None = None, focus: float | None = None
) -> Camera | Video:
    """A camera by its number, or a video file. Raises UserError if it cannot be opened."""
    if text.isdecimal():
        return Camera(int(text), size, exposure, focus)
    for flag, value in (("size", size), ("exposure", exposure), ("focus", focus)):
        if value is not None:
            raise UserError(f"--{flag}: has no meaning for the video file {text}; leave it out")
    return Video(Path(text))


def _rgb(image: ndarray) -> Image:
    return np.ascontiguousarray(image[..., ::-1])
