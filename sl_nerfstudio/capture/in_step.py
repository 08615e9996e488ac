"""Capturing Gray code: a display shows the sequence, and the camera grabs each image when it has settled."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8
from numpy import ndarray

from sl_nerfstudio.capture.camera import Camera
from sl_nerfstudio.capture.folder import CaptureFolder
from sl_nerfstudio.capture.light import Light, measure_light
from sl_nerfstudio.capture.picture import draw_map, draw_pixels, reduced
from sl_nerfstudio.capture.watcher import Watcher
from sl_nerfstudio.capture.windows import Key, Screen
from sl_nerfstudio.decoding.decoded import Decoded, DecodingError
from sl_nerfstudio.decoding.graycode.decode import decode_gray_code
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.images import as_grey, read_image

_CELLS = 48  # columns of the map of the pattern
_BLACK, _WHITE = 0.1, 0.9  # of full scale
_THUMBNAIL = 300  # width, pixels


@dataclass
class Progress:
    """What the frames so far have seen of the pattern, and the last of them."""

    times_seen: Int[ndarray, "rows columns"]
    frames: int = 0
    last: UInt8[ndarray, "h w 3"] | None = None  # what was decoded, in colour

    def add(self, decoded: Decoded, layout: GrayCode, image: UInt8[ndarray, "h w 3"]) -> None:
        """Count a frame; `image` is the one under white light."""
        self.frames += 1
        self.times_seen = self.times_seen + _cells_seen(decoded, layout, self.times_seen.shape)
        small = cv2.resize(image, (_THUMBNAIL, round(_THUMBNAIL * image.shape[0] / image.shape[1])))
        coords = _resized(decoded.coords, (small.shape[1], small.shape[0]))
        xy = coords / np.array([layout.w, layout.h], dtype=np.float32)
        self.last = draw_pixels(small, xy, np.isfinite(xy).all(-1))


def start(layout: GrayCode) -> Progress:
    """Nothing seen yet."""
    return Progress(np.zeros((max(1, round(_CELLS * layout.h / layout.w)), _CELLS), dtype=np.int64))


def resume_sequences(folder: CaptureFolder, layout: GrayCode, progress: Progress) -> None:
    """Count the frames of an earlier run. Raises UserError for one that cannot be decoded."""
    for path in track(folder.frames, "decoding the frames so far"):
        images = [_colour(read_image(file)) for file in sorted(path.iterdir())]
        try:
            decoded = decode_gray_code(images, layout)
        except DecodingError as error:
            raise UserError(f"{path}: {error}") from error
        progress.add(decoded, layout, images[0])


@dataclass(frozen=True)
class Rig:
    """A display and a camera that work in step."""

    camera: Camera
    screen: Screen
    layout: GrayCode
    settle: float  # seconds from a change of the display to the image that is taken
    rate: float  # images a second that are shown while nothing is captured


@dataclass(frozen=True, eq=False)
class Captured:
    """The images of one sequence, and what they show."""

    images: list[UInt8[ndarray, "h w 3"]]
    decoded: Decoded
    drift: float  # brightness under white light at the end, relative to that at the beginning; 1 if nothing changed


def capture_in_step(
    rig: Rig, progress: Progress, watcher: Watcher, words: Callable[[Light, Progress], list[str]], most: int | None
) -> Iterator[Captured | DecodingError]:
    """A sequence at each press of a key, or why it cannot be decoded, until a key ends it or there are `most` frames.

    Between two sequences the display is white. Each image is the first that the camera read `settle` seconds after
    the display had changed.
    """
    patterns = list(rig.layout.sequence())
    while most is None or progress.frames < most:
        rig.screen.show(patterns[0])
        while (early := watcher.key()) is not None:  # pressed while the last sequence was decoded
            if early is Key.END:
                return
        if _watch(rig, progress, watcher, words) is Key.END:
            return
        images = []
        for pattern in (*patterns, patterns[0]):
            rig.screen.show(pattern)
            images.append(rig.camera.after(time.monotonic() + rig.settle)[1])
            if watcher.key() is Key.END:
                return
        white_again = images.pop()
        try:
            yield Captured(images, decode_gray_code(images, rig.layout), _drift(images[0], white_again))
        except DecodingError as error:
            yield error


def _watch(rig: Rig, progress: Progress, watcher: Watcher, words: Callable[[Light, Progress], list[str]]) -> Key:
    """Show what the camera sees until a key is pressed."""
    for _, image in rig.camera.frames(rig.rate):
        small = reduced(image)[0]
        watcher.look(
            lambda small=small: small,
            lambda: [draw_map(progress.times_seen), *([] if progress.last is None else [progress.last])],
            words(measure_light(as_grey(small)), progress),
        )
        key = watcher.key()
        if key in (Key.NEXT, Key.END):
            return key
    raise RuntimeError("a camera never ends")


def _drift(first: UInt8[ndarray, "h w 3"], last: UInt8[ndarray, "h w 3"]) -> float:
    """Brightness of the second image over that of the first, where that is neither black nor saturated.

    1 if there is no such place.
    """
    before, after = as_grey(first), as_grey(last)
    usable = (before > _BLACK) & (before < _WHITE)
    return float(np.median(after[usable] / before[usable])) if usable.any() else 1.0


def _cells_seen(decoded: Decoded, layout: GrayCode, shape: tuple[int, ...]) -> Int[ndarray, "rows columns"]:
    """1 for the parts of the pattern in which something was decoded."""
    rows, columns = shape
    x, y = decoded.coords[decoded.decoded].T
    column = np.clip((x / layout.w * columns).astype(np.int64), 0, columns - 1)
    row = np.clip((y / layout.h * rows).astype(np.int64), 0, rows - 1)
    seen = np.zeros((rows, columns), dtype=np.int64)
    seen[row, column] = 1
    return seen


def _resized(coords: Float32[ndarray, "h w 2"], size: tuple[int, int]) -> Float32[ndarray, "_h _w 2"]:
    """Coordinates at the nearest pixels: means across edges would be places that nothing shows."""
    return cv2.resize(coords, size, interpolation=cv2.INTER_NEAREST)


def _colour(image: ndarray) -> UInt8[ndarray, "h w 3"]:
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, -1)
