"""Capturing Gray code: a display shows the sequence, and the camera grabs each image when it has settled."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Int, UInt8
from numpy import ndarray

from sl_nerfstudio.capture.camera import Camera, CaptureFolder, Video, draw_map, draw_nodes, draw_pixels, reduced
from sl_nerfstudio.capture.screen import Key, Screen, Watcher
from sl_nerfstudio.capture.selection import (
    Exposure,
    GridReader,
    GridView,
    PlainReader,
    Selection,
    SelectionVerdict,
    measure_light,
)
from sl_nerfstudio.console import track
from sl_nerfstudio.decoding.decoder import Decoded, DecodingError
from sl_nerfstudio.decoding.gray_code import decode_gray_code
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.scan.images import as_grey, encode_png, read_image
from sl_nerfstudio.storage import write_atomic

# Capturing by hand: images of one static pattern are judged as they come, and kept where they add something.

_RADIUS = 0.4  # of the discs in the preview, periods
_REFRESH = 0.03  # seconds between two pictures of the preview

Reader = GridReader | PlainReader
Words = Callable[[GridView, SelectionVerdict, Selection], list[str]]
"""What to say of a view; the first line matters most."""


def resume(folder: CaptureFolder, reader: Reader, selection: Selection) -> None:
    """Take the frames of an earlier run as kept."""
    for path in track(folder.frames, "reading the frames so far"):
        selection.add(reader.read(read_image(path)))


def capture_by_hand(
    source: Camera | Video,
    reader: Reader,
    selection: Selection,
    folder: CaptureFolder,
    watcher: Watcher,
    words: Words,
    kept: Callable[[str, GridView], None],
    rate: float,
    most: int | None,
) -> None:
    """Judge up to `rate` images a second until a key ends it, a video ends, or the folder holds `most` frames.

    While an image is read, the preview goes on with the newest one of a camera, and with what was read last.
    `kept` is called with the name of each frame that was written.
    """
    pressed: list[Key] = []
    view, lines = None, []

    def show(image: UInt8[ndarray, "h w 3"], view: GridView, lines: list[str], quiet: bool = False) -> None:
        watcher.look(
            lambda: picture_of(image, view),
            lambda: [draw_map(selection.times_seen)] if selection.times_seen.size else [],
            lines,
            quiet,
        )
        pressed.extend(key for key in [watcher.key()] if key is not None)

    def go_on() -> None:
        if view is not None and isinstance(source, Camera):
            show(source.newest, view, lines)

    enough = most is not None and len(selection.kept) >= most
    for seconds, image, view in () if enough else _read(source, reader, rate, go_on if watcher.has_window else None):
        verdict = selection.judge(view, seconds)
        lines = words(view, verdict, selection)
        show(image, view, lines, quiet=verdict is SelectionVerdict.KEEP)
        if Key.END in pressed:
            return
        if verdict is SelectionVerdict.KEEP or Key.NEXT in pressed:
            name = folder.add(image).name
            selection.add(view, seconds)
            kept(name, view)
            if most is not None and len(selection.kept) >= most:
                return
        pressed.clear()


def _read(
    source: Camera | Video, reader: Reader, rate: float, meanwhile: Callable[[], None] | None
) -> Iterator[tuple[float, UInt8[ndarray, "h w 3"], GridView]]:
    """Time, image, and what it shows; `meanwhile` is called again and again while an image is read."""
    with ThreadPoolExecutor(1) as reading:
        for seconds, image in source.frames(rate):
            view = reading.submit(reader.read, image)
            while meanwhile is not None and not wait([view], _REFRESH).done:
                meanwhile()
            yield seconds, image, view.result()


def picture_of(image: UInt8[ndarray, "h w 3"], view: GridView) -> UInt8[ndarray, "_h _w 3"]:
    """The image at the size of the preview, with the nodes that were found in colour."""
    small, factor = reduced(image)
    radius = _RADIUS * view.period * factor if np.isfinite(view.period) else 1.0
    return draw_nodes(small, view.uv * np.float32(factor), radius)


def with_white_light(
    folder: Path,
    frames: Path,
    camera: Camera,
    screen: Screen,
    pattern: UInt8[ndarray, "h w"],
    settle: float,
    kept: Callable[[str, GridView], None],
) -> Callable[[str, GridView], None]:
    """A `kept` for `capture_by_hand` that also photographs each frame with the display white in place of the pattern.

    The pictures have the names of the frames; `frames` is the folder of the captures. Raises UserError if `folder`
    holds pictures of other captures, and so does what it returns if a picture cannot be written.
    """
    others = [path.name for path in sorted(folder.glob("frame_*")) if not (frames / path.name).exists()]
    if others:
        raise UserError(
            f"--color {folder}: holds {others[0]}, and there is no such frame in {frames}\n"
            "    cause:  the pictures are those of other captures\n    remedy: give a new folder"
        )

    def kept_twice(name: str, view: GridView) -> None:
        screen.show(np.full_like(pattern, 255))
        picture = camera.after(time.monotonic() + settle)[1]
        screen.show(pattern)
        write_atomic(folder / name, encode_png(picture))
        kept(name, view)

    return kept_twice


_CELLS = 48  # columns of the map of the pattern
_BLACK, _WHITE = 0.1, 0.9  # of full scale
_THUMBNAIL = 300  # width, pixels


@dataclass
class SequenceProgress:
    """Coverage of the pattern by the frames so far, and the last of them."""

    times_seen: Int[ndarray, "rows columns"]
    frames: int = 0
    last: UInt8[ndarray, "h w 3"] | None = None  # what was decoded, in colour

    def add(self, decoded: Decoded, layout: GrayCode, image: UInt8[ndarray, "h w 3"]) -> None:
        """Count a frame; `image` is the one under white light."""
        self.frames += 1
        self.times_seen = self.times_seen + _cells_seen(decoded, layout, self.times_seen.shape)
        small = cv2.resize(image, (_THUMBNAIL, round(_THUMBNAIL * image.shape[0] / image.shape[1])))
        # at the nearest pixels: means across edges would be places that nothing shows
        coords = cv2.resize(decoded.coords, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        xy = coords / np.array([layout.w, layout.h], dtype=np.float32)
        self.last = draw_pixels(small, xy, all_finite(xy))


def start(layout: GrayCode) -> SequenceProgress:
    """Nothing seen yet."""
    return SequenceProgress(np.zeros((max(1, round(_CELLS * layout.h / layout.w)), _CELLS), dtype=np.int64))


def resume_sequences(folder: CaptureFolder, layout: GrayCode, progress: SequenceProgress) -> None:
    """Count the frames of an earlier run. Raises UserError for one that cannot be decoded."""
    for path in track(folder.frames, "decoding the frames so far"):
        images = [read_image(file) for file in sorted(path.iterdir())]
        images = [image if image.ndim == 3 else np.repeat(image[..., None], 3, -1) for image in images]
        try:
            decoded = decode_gray_code(images, layout)
        except DecodingError as error:
            raise UserError(f"{path}: {error}") from error
        progress.add(decoded, layout, images[0])


@dataclass(frozen=True)
class CaptureRig:
    """A display and a camera that work in step."""

    camera: Camera
    screen: Screen
    layout: GrayCode
    settle: float  # seconds from a change of the display to the image that is taken
    rate: float  # images a second that are shown while nothing is captured


@dataclass(frozen=True, eq=False)
class CapturedSequence:
    """The images of one sequence, and what they show."""

    images: list[UInt8[ndarray, "h w 3"]]
    decoded: Decoded
    drift: float  # brightness under white light at the end, relative to that at the beginning; 1 if nothing changed


def capture_in_step(
    rig: CaptureRig,
    progress: SequenceProgress,
    watcher: Watcher,
    words: Callable[[Exposure, SequenceProgress], list[str]],
    most: int | None,
) -> Iterator[CapturedSequence | DecodingError]:
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
            yield CapturedSequence(images, decode_gray_code(images, rig.layout), _drift(images[0], white_again))
        except DecodingError as error:
            yield error


def _watch(
    rig: CaptureRig,
    progress: SequenceProgress,
    watcher: Watcher,
    words: Callable[[Exposure, SequenceProgress], list[str]],
) -> Key:
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
