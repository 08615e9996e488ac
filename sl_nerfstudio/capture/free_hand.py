"""Capturing by hand: images of one static pattern are judged as they come, and kept where they add something."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.capture.camera import Camera, Video
from sl_nerfstudio.capture.folder import CaptureFolder
from sl_nerfstudio.capture.grid_view import GridReader, GridView, PlainReader
from sl_nerfstudio.capture.picture import draw_map, draw_nodes, reduced
from sl_nerfstudio.capture.selection import Selection, Verdict
from sl_nerfstudio.capture.watcher import Watcher
from sl_nerfstudio.capture.windows import Key
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.images import read_image

_RADIUS = 0.4  # of the discs in the preview, periods
_REFRESH = 0.03  # seconds between two pictures of the preview

Reader = GridReader | PlainReader
Words = Callable[[GridView, Verdict, Selection], list[str]]  # what to say of a view; the first line matters most


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
        show(image, view, lines, quiet=verdict is Verdict.KEEP)
        if Key.END in pressed:
            return
        if verdict is Verdict.KEEP or Key.NEXT in pressed:
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
