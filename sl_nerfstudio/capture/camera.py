"""Images from a camera, or from a video file in its place."""

import hashlib
import json
import re
import shutil
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.document import read_document
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.storage import LOCK, cannot_write, locked, remove_partial, write_atomic

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
            patience = _PATIENCE + max(0.0, moment - time.monotonic())
            here = self._changed.wait_for(lambda: self._gone or self._time > moment, patience)
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


# The picture in the preview: what the camera sees, what of it is decoded, what is still missing, and a few words.

_WIDTH, _HEIGHT = 960, 600  # most of the camera's image
_MAP = 300  # width of the map of the pattern
_GAP = 8
_LEAST_WIDTH = 640
_LINE = 24  # height of a line of text, pixels
_OPACITY = 0.65
_GREEN = 0.35  # as in the report of sl-process: x gives red, y gives blue
_ENOUGH = 3  # kept views of a node
_MAP_COLOURS = np.array([[70, 70, 70], [150, 60, 40], [200, 150, 50], [60, 170, 80]], dtype=np.uint8)  # 0, 1, 2, more


def pattern_colours(xy: Float32[ndarray, "*n 2"]) -> Float32[ndarray, "*n 3"]:
    """A colour in [0, 1] for every place of the pattern, whose coordinates go from 0 to 1."""
    return np.stack([xy[..., 0], np.full(xy.shape[:-1], _GREEN), xy[..., 1]], -1).astype(np.float32)


def reduced(image: UInt8[ndarray, "h w 3"]) -> tuple[UInt8[ndarray, "_h _w 3"], float]:
    """The image at the size of the preview, and the factor of its pixel coordinates."""
    factor = min(1.0, _WIDTH / image.shape[1], _HEIGHT / image.shape[0])
    size = max(1, round(image.shape[1] * factor)), max(1, round(image.shape[0] * factor))
    return (cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor < 1 else image.copy()), factor


def draw_nodes(
    picture: UInt8[ndarray, "h w 3"], uv: Float32[ndarray, "rows columns 2"], radius: float
) -> UInt8[ndarray, "h w 3"]:
    """The picture with a disc at every node that was found, in the colour of its place in the pattern."""
    rows, columns = uv.shape[:2]
    place = np.stack(np.meshgrid(np.arange(columns) / max(columns, 1), np.arange(rows) / max(rows, 1)), -1)
    colours = np.rint(255 * pattern_colours(place.astype(np.float32)))
    drawn = picture.copy()
    for row, column in np.argwhere(np.isfinite(uv[..., 0])):
        centre = tuple(int(v) for v in uv[row, column])
        cv2.circle(drawn, centre, max(1, round(radius)), tuple(map(float, colours[row, column])), -1, cv2.LINE_AA)
    return cv2.addWeighted(drawn, _OPACITY, picture, 1 - _OPACITY, 0)


def draw_pixels(
    picture: UInt8[ndarray, "h w 3"], xy: Float32[ndarray, "h w 2"], known: Bool[ndarray, "h w"]
) -> UInt8[ndarray, "h w 3"]:
    """The picture with every decoded pixel in the colour of its place in the pattern, from 0 to 1."""
    colours = 255 * pattern_colours(np.nan_to_num(xy))
    mixed = np.rint(_OPACITY * colours + (1 - _OPACITY) * picture).astype(np.uint8)
    return np.where(known[..., None], mixed, picture)


def draw_map(times_seen: Int[ndarray, "rows columns"]) -> UInt8[ndarray, "h w 3"]:
    """A map of the pattern: grey where no kept frame has seen it, red once, yellow twice, green more often."""
    cell = max(1, _MAP // max(times_seen.shape[1], 1))
    colours = _MAP_COLOURS[np.clip(times_seen, 0, _ENOUGH)]
    return np.repeat(np.repeat(colours, cell, 0), cell, 1)


def compose(
    picture: UInt8[ndarray, "h w 3"], beside: Sequence[UInt8[ndarray, "_h _w 3"]], lines: Sequence[str]
) -> UInt8[ndarray, "H W 3"]:
    """The camera's image, smaller pictures beside it, and text below."""
    parts = [picture]
    if beside:  # below each other, as wide as the widest
        widest = max(part.shape[1] for part in beside)
        parts.append(np.concatenate([np.pad(p, ((0, _GAP), (0, widest - p.shape[1]), (0, 0))) for p in beside]))
    height = max(part.shape[0] for part in parts)
    width = sum(part.shape[1] for part in parts) + _GAP * (len(parts) - 1)
    out = np.full((height + _LINE * (len(lines) + 1), max(width, _LEAST_WIDTH), 3), 30, dtype=np.uint8)
    left = 0
    for part in parts:
        out[: part.shape[0], left : left + part.shape[1]] = part
        left += part.shape[1] + _GAP
    for k, line in enumerate(lines):
        origin = (8, height + _LINE * (k + 1))
        cv2.putText(out, line, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235, 235, 235), 1, cv2.LINE_AA)
    return out


def share_seen(times_seen: Int[ndarray, "rows columns"], times: int = 1) -> float:
    """Share of the pattern that at least so many kept frames have seen."""
    return float((times_seen >= times).mean()) if times_seen.size else 0.0


# The folder of captures: frames appear complete or not at all, nothing is overwritten, and it can be continued.

DESCRIPTION = "capture.json"
FORMAT = 1
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
        with ExitStack() as held:
            held.enter_context(locked(root))
            remove_partial(root)
            if (root / DESCRIPTION).exists():
                self._check(described)
            elif all(path.name == LOCK for path in root.iterdir()):
                write_atomic(root / DESCRIPTION, content)
            else:
                raise UserError(
                    f"{root}: is not empty\n    cause:  it holds something else than captures of this command\n"
                    "    remedy: choose another output, or remove it first"
                )
            shutil.rmtree(root / _UNFINISHED, ignore_errors=True)
            self._lock = held.pop_all()

    def _check(self, described: dict[str, object]) -> None:
        found = read_document(self.root / DESCRIPTION)
        words = {"sl_capture": "format", "pattern": "pattern", "w": "image width", "h": "image height"}
        for key, what in words.items():
            if found.get(key) != described[key]:
                raise UserError(
                    f"{self.root}: was begun with another {what}\n"
                    f"    cause:  {DESCRIPTION} says {found.get(key)}, now it is {described[key]}\n"
                    "    remedy: choose another output; a scan needs one pattern and one camera mode"
                )

    @property
    def frames(self) -> list[Path]:
        """Images or folders of the frames so far, by their number."""
        return [path for _, path in self._numbered()]

    def _numbered(self) -> list[tuple[int, Path]]:
        names = ((_FRAME.fullmatch(path.name), path) for path in self.root.iterdir())
        return sorted((int(match[1]), path) for match, path in names if match)

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
        last = max((number for number, _ in self._numbered()), default=-1)
        return f"frame_{last + 1:04d}"

    def __enter__(self) -> "CaptureFolder":
        """The folder itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Let go of the folder; it is removed if it holds no frame."""
        with self._lock:
            if not self.frames:
                (self.root / DESCRIPTION).unlink(missing_ok=True)
