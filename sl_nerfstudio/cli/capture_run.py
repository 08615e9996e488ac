"""What sl-capture sets up for each kind of pattern, and what it says at the end."""

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from sl_nerfstudio.capture.camera import Camera, Video, open_camera
from sl_nerfstudio.capture.config import CaptureConfig
from sl_nerfstudio.capture.folder import CaptureFolder
from sl_nerfstudio.capture.free_hand import Reader, capture_by_hand, resume
from sl_nerfstudio.capture.grid_view import GridReader, PlainReader
from sl_nerfstudio.capture.in_step import Rig, capture_in_step, resume_sequences, start
from sl_nerfstudio.capture.selection import Selection
from sl_nerfstudio.capture.show import pattern_picture
from sl_nerfstudio.capture.watcher import Watcher
from sl_nerfstudio.capture.windows import Screen, Window
from sl_nerfstudio.cli.capture_words import (
    coverage_words,
    decoded_words,
    failed_words,
    kept_words,
    sequence_lines,
    view_lines,
)  # fmt: skip
from sl_nerfstudio.cli.run import Terminated
from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern


def say(text: str) -> None:
    """A line on the console, at once."""
    print(text, flush=True)


def capture(config: CaptureConfig) -> None:
    """Capture until it is ended, then say what to do next. Raises UserError for what cannot be captured."""
    layout = None if config.pattern is None else read_layout(config.pattern)
    source = open_camera(config.camera, config.image_size, config.exposure, config.focus)
    try:
        if isinstance(layout, GrayCode):
            _sequences(config, source, layout)
        elif isinstance(layout, GridPattern | None):
            _single_images(config, source, layout)
        else:
            raise UserError(f"{config.pattern}: {layout.description} cannot be captured by this command")
    finally:
        source.close()
    say(_next_command(config))


def _single_images(config: CaptureConfig, source: Camera | Video, layout: GridPattern | None) -> None:
    picture = None
    if config.show is not None and config.pattern is not None and layout is not None:
        picture = pattern_picture(config.pattern, layout)
    reader: Reader = PlainReader() if layout is None else GridReader(layout)
    selection = Selection((0, 0) if layout is None else (layout.rows, layout.columns))
    with CaptureFolder(config.output, layout, source.size) as folder, _watcher(config) as (watcher, screen):
        if screen is not None and picture is not None:
            screen.show(picture)
        resume(folder, reader, selection)
        say(f"{_described(source)}; {'control-C ends' if config.headless else 'Space keeps an image, Escape ends'}")
        kept = partial(kept_words, say, selection)
        with _ended_by_control_c():
            capture_by_hand(source, reader, selection, folder, watcher, view_lines, kept, config.rate, config.frames)
        say(coverage_words(len(selection.kept), config.output, selection.times_seen))


def _sequences(config: CaptureConfig, source: Camera | Video, layout: GrayCode) -> None:
    if isinstance(source, Video):
        raise UserError(
            f"--camera {source.name}: Gray code cannot be captured from a video\n"
            "    cause:  each image must be grabbed while the display shows it\n    remedy: give the number of a camera"
        )
    if config.show is None:
        raise UserError(
            "Gray code is shown and captured in step\n    cause:  --show is missing\n"
            "    remedy: give the number of the display, such as --show 1"
        )
    progress = start(layout)
    with CaptureFolder(config.output, layout, source.size) as folder, _watcher(config) as (watcher, screen):
        if screen is None:
            raise RuntimeError("a display was given, but there is no screen")
        resume_sequences(folder, layout, progress)
        say(f"{_described(source)}; Space captures a sequence, Escape ends")
        words = partial(sequence_lines, layout.images)
        rig = Rig(source, screen, layout, config.settle, config.rate)
        with _ended_by_control_c():
            for captured in capture_in_step(rig, progress, watcher, words, config.frames):
                if isinstance(captured, DecodingError):
                    say(failed_words(captured))
                else:
                    path = folder.add_sequence(captured.images)
                    progress.add(captured.decoded, layout, captured.images[0])
                    say(decoded_words(progress, path.name, captured))
        say(coverage_words(progress.frames, config.output, progress.times_seen))


def _described(source: Camera | Video) -> str:
    return f"{source.name}: {source.size[0]} x {source.size[1]} pixels"


@contextmanager
def _watcher(config: CaptureConfig) -> Iterator[tuple[Watcher, Screen | None]]:
    """The preview, and the screen that shows the pattern."""
    screen = None if config.show is None else Screen(config.show)
    window = None
    try:
        window = None if config.headless else Window("sl-capture")
        yield Watcher(say, window, screen), screen
    finally:
        if window is not None:
            window.close()
        if screen is not None:
            screen.close()


@contextmanager
def _ended_by_control_c() -> Iterator[None]:
    """Control-C is a usual end; SIGTERM is not."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if isinstance(stop, Terminated):
            raise
        print(file=sys.stderr)


def _next_command(config: CaptureConfig) -> str:
    images = f"--images {shlex.quote(str(config.output))}"
    if config.pattern is None:
        board = '--board chessboard --corners 9x6 --square "18 mm"'
        words = "next, for images of a board (with its own numbers):"
        return f"{words}\n    sl-calibrate {images} {board} --camera-only --output intrinsics.json"
    pattern = f"--pattern {shlex.quote(str(config.pattern))}"
    return f"next:\n    sl-process {images} {pattern} --intrinsics intrinsics.json --output scan"
