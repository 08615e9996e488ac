"""sl-capture: capture frames with a camera, and keep those that add something."""

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sl_nerfstudio.cli.arguments import parse, require_paths
from sl_nerfstudio.cli.run import Terminated, run
from sl_nerfstudio.console import command, next_steps, say
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Int
    from numpy import ndarray

    from sl_nerfstudio.capture.camera import Camera, Video
    from sl_nerfstudio.capture.capture import CapturedSequence, SequenceProgress
    from sl_nerfstudio.capture.screen import Screen, Watcher
    from sl_nerfstudio.capture.selection import Exposure, GridView, Selection, SelectionVerdict
    from sl_nerfstudio.pattern.gray_code import GrayCode
    from sl_nerfstudio.pattern.grid import GridPattern

# What is captured, and how; the docstrings of the fields are the help text of `sl-capture`.

_MOST = 1000.0  # images a second, or seconds


@dataclass(frozen=True)
class CaptureConfig:
    """Capture frames for sl-process.

    Coded grid: move camera and projector slowly around the object. Images are decoded as they come, and one is kept
    when it is sharp, well exposed, and shows the pattern at other places than those kept before. Gray code (with
    --show): each press of Space shows the whole sequence and captures it; nothing may move meanwhile. Space keeps an
    image whatever is said about it, Escape ends. Run the same command again to go on.
    """

    camera: str
    """number of the camera, 0 for the first, or a video file"""
    output: Path
    """folder for the captures: a new one, or one that this command has begun"""
    pattern: Path | None = None
    """pattern.json of what is projected; without it, nothing is decoded, and images are kept by key alone"""
    show: int | None = None
    """number of the display on which to show the pattern, full screen; 0 is the first, and 1 usually the projector"""
    size: str | None = None
    """width x height of the camera's images, such as 1920x1080; default: the camera's choice"""
    exposure: float | None = None
    """fixed exposure in the camera's own unit; default: as the camera is set"""
    focus: float | None = None
    """fixed focus in the camera's own unit; default: as it is, without autofocus if the camera can"""
    rate: float = 4.0
    """images per second that are decoded at most; of a video, per second of its time"""
    settle: float = 0.25
    """seconds that each image of a Gray-code sequence, and the light of --color, is shown before it is captured"""
    color: Path | None = None
    """folder for a picture of each kept frame in white light instead of the pattern, for the colours of the mesh; with
    --show, for a coded grid: hold still until it is taken (Gray code has such images)"""
    frames: int | None = None
    """end when the folder holds so many frames; default: when Escape is pressed or the video ends"""
    headless: bool = False
    """lines on the console instead of a preview window; control-C ends"""

    def check(self) -> None:
        """Raise UserError for flags that mean nothing."""
        for name in ("rate", "settle"):
            value = getattr(self, name)
            if not 0 < value < _MOST:
                raise UserError(f"--{name} {value:g}: give a number above 0 and below {_MOST:g}")
        if self.frames is not None and self.frames < 1:
            raise UserError(f"--frames {self.frames}: give a number of at least 1")
        if self.show is not None and self.pattern is None:
            raise UserError(f"--show {self.show}: give --pattern, which says what is to be shown")
        if self.color is not None and (self.show is None or not self.camera.isdigit()):
            raise UserError(
                f"--color {self.color}: needs a camera, and a display that shows the pattern\n"
                "    cause:  --show is missing, or --camera is a video: nothing else can be shown instead\n"
                "    remedy: give --show; or photograph the colours yourself, from the same places, for --color of "
                "sl-process"
            )
        if self.headless and self.pattern is None:
            raise UserError(
                "--headless: without a pattern, frames are kept by key alone, and there is no window to press it in\n"
                "    cause:  --pattern is missing\n    remedy: give --pattern, or leave --headless out"
            )

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(w, h) of --size. Raises UserError."""
        from sl_nerfstudio.pattern.boards import counts  # --help does not need it

        return None if self.size is None else counts(self.size, "--size")


_GROUPS = {
    "the pattern": ("pattern", "show", "settle", "color"),
    "the camera": ("size", "exposure", "focus", "rate"),
    "this run": ("frames", "headless"),
}


# What sl-capture says about what it sees.

_VERDICTS = {
    "keep": "kept",
    "no pattern": "the pattern is not seen: point the camera at what the projector lights, or go closer",
    "blurred": "blurred: move more slowly, or focus again",
    "saturated": "too bright: shorten the exposure",
    "dark": "too dark: lengthen the exposure, or use less room light and a brighter projector",
    "known": "this view is known: move on",
    "wait": "good; it is kept if you stay for a moment",
    "by key": "Space keeps this image",
}
_LEGEND = "map of the pattern: grey: not seen yet, red: in one frame, yellow: in two, green: in more"
_MOST_DRIFT = 0.1  # of the brightness during a sequence
_USUAL_LEAST = 10  # frames of a scan
_OFTEN = 3


def view_lines(view: "GridView", verdict: "SelectionVerdict", selection: "Selection") -> list[str]:
    """The verdict, what was measured, and what is still missing."""
    from sl_nerfstudio.capture.camera import share_seen

    measured = [_light_words(view.light)]
    if view.edge is not None:
        measured.append(f"edges {view.edge:.1f} px wide")
    if view.uv.size == 0:
        return [_VERDICTS[verdict.value], ", ".join(measured), f"{len(selection.kept)} frames kept"]
    if view.blur is not None:
        measured.append(f"blur {view.blur:.2f} periods")
    nodes = f"{int(view.seen.sum())} of {view.seen.size} nodes"
    seen = selection.times_seen
    share = f"they show {share_seen(seen):.0%} of the pattern, {share_seen(seen, _OFTEN):.0%} of it three times"
    return [
        _VERDICTS[verdict.value],
        ", ".join([nodes, *measured]),
        f"{len(selection.kept)} frames kept; {share}",
        _LEGEND,
    ]


def kept_words(say: Callable[[str], None], selection: "Selection", name: str, view: "GridView") -> None:
    """Say that a frame was written."""
    from sl_nerfstudio.capture.camera import share_seen

    if view.uv.size == 0:
        say(f"  kept {name}")
        return
    seen = share_seen(selection.times_seen)
    say(f"  kept {name}: {int(view.seen.sum())} of {view.seen.size} nodes; all frames show {seen:.0%} of the pattern")


def sequence_lines(images: int, light: "Exposure", progress: "SequenceProgress") -> list[str]:
    """What to do, the light under the white image, and what is still missing."""
    from sl_nerfstudio.capture.camera import share_seen

    return [
        f"Space captures the sequence of {images} images: nothing may move meanwhile",
        f"{_light_words(light)} (under white light)",
        f"{progress.frames} frames; they show {share_seen(progress.times_seen):.0%} of the pattern",
        _LEGEND,
    ]


def decoded_words(progress: "SequenceProgress", name: str, captured: "CapturedSequence") -> str:
    """A sequence was written; a warning where the light was not the same throughout."""
    from sl_nerfstudio.capture.camera import share_seen

    decoded = captured.decoded
    lit = f"{decoded.decoded.mean():.0%} of the image are decoded, {decoded.rate:.0%} of what the pattern lights"
    said = f"  kept {name}: {lit}; all frames show {share_seen(progress.times_seen):.0%} of the pattern"
    if abs(captured.drift - 1) <= _MOST_DRIFT:
        return said
    changed = f"{abs(captured.drift - 1):.0%} {'brighter' if captured.drift > 1 else 'darker'}"
    return (
        f"{said}\n  warning: white was {changed} after the sequence than before it\n"
        "    cause:  the camera sets its exposure by itself, or the room light changed\n"
        "    remedy: give --exposure, remove this frame, and capture it again"
    )


def coverage_words(frames: int, output: Path, times_seen: 'Int[ndarray, "rows columns"]') -> str:
    """The summary at the end."""
    from sl_nerfstudio.capture.camera import share_seen

    if frames == 0:
        return f"no frame was kept, so {output} was not written"
    text = f"{frames} frame{'s' if frames != 1 else ''} in {output}"
    if times_seen.size:
        often = share_seen(times_seen, _OFTEN)
        text += f"; they show {share_seen(times_seen):.0%} of the pattern, {often:.0%} three times"
        if frames < _USUAL_LEAST:
            text += f"\na scan usually takes {_USUAL_LEAST} frames or more: run the same command again to go on"
    return text


def _light_words(light: "Exposure") -> str:
    return f"{light.saturated:.0%} saturated, {light.dark:.0%} dark"


# What sl-capture sets up for each kind of pattern, and what it says at the end.


def capture(config: CaptureConfig) -> None:
    """Capture until it is ended, then say what to do next. Raises UserError for what cannot be captured."""
    config.check()
    if not config.camera.isdigit():
        remedy = "give the number of a camera (0 is the first), or a video file"
        require_paths({"--camera": (Path(config.camera), remedy)})
    from sl_nerfstudio.capture.camera import open_camera
    from sl_nerfstudio.pattern.files import read_layout
    from sl_nerfstudio.pattern.gray_code import GrayCode
    from sl_nerfstudio.pattern.grid import GridPattern

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


def _single_images(config: CaptureConfig, source: "Camera | Video", layout: "GridPattern | None") -> None:
    from sl_nerfstudio.capture.camera import Camera, CaptureFolder
    from sl_nerfstudio.capture.capture import Reader, capture_by_hand, resume, with_white_light
    from sl_nerfstudio.capture.screen import pattern_picture
    from sl_nerfstudio.capture.selection import GridReader, GridView, PlainReader, Selection

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
        kept: Callable[[str, GridView], None] = partial(kept_words, say, selection)
        if config.color is not None and picture is not None and screen is not None and isinstance(source, Camera):
            kept = with_white_light(config.color, config.output, source, screen, picture, config.settle, kept)
        with _ended_by_control_c():
            capture_by_hand(source, reader, selection, folder, watcher, view_lines, kept, config.rate, config.frames)
        say(coverage_words(len(selection.kept), config.output, selection.times_seen))


def _sequences(config: CaptureConfig, source: "Camera | Video", layout: "GrayCode") -> None:
    from sl_nerfstudio.capture.camera import CaptureFolder, Video
    from sl_nerfstudio.capture.capture import CaptureRig, capture_in_step, resume_sequences, start
    from sl_nerfstudio.decoding.decoder import DecodingError

    if isinstance(source, Video):
        raise UserError(
            f"--camera {source.name}: Gray code cannot be captured from a video\n"
            "    cause:  each image must be grabbed while the display shows it\n    remedy: give the number of a camera"
        )
    if config.color is not None:
        raise UserError(
            f"--color {config.color}: Gray code has its own images in white light, which give the colours\n"
            "    remedy: leave --color out"
        )
    if config.show is None:
        raise UserError(
            "Gray code is shown and captured in step\n    cause:  --show is missing\n"
            "    remedy: give the number of the display, such as --show 1"
        )
    progress = start(layout)
    with CaptureFolder(config.output, layout, source.size) as folder, _watcher(config) as (watcher, screen):
        assert screen is not None
        resume_sequences(folder, layout, progress)
        say(f"{_described(source)}; Space captures a sequence, Escape ends")
        words = partial(sequence_lines, layout.images)
        rig = CaptureRig(source, screen, layout, config.settle, config.rate)
        with _ended_by_control_c():
            for captured in capture_in_step(rig, progress, watcher, words, config.frames):
                if isinstance(captured, DecodingError):
                    say(f"  not kept: this sequence {captured}")
                else:
                    path = folder.add_sequence(captured.images)
                    progress.add(captured.decoded, layout, captured.images[0])
                    say(decoded_words(progress, path.name, captured))
        say(coverage_words(progress.frames, config.output, progress.times_seen))


def _described(source: "Camera | Video") -> str:
    return f"{source.name}: {source.size[0]} x {source.size[1]} pixels"


@contextmanager
def _watcher(config: CaptureConfig) -> "Iterator[tuple[Watcher, Screen | None]]":
    """The preview, and the screen that shows the pattern."""
    from sl_nerfstudio.capture.screen import Screen, Watcher, Window

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
    words = ["sl-scan", config.output, "--pattern", config.pattern, "--intrinsics", "intrinsics.json"]
    color = () if config.color is None else ("--color", config.color)
    return next_steps([command(*words, *color, "--output", "result")])


def main() -> None:
    """Entry point of the command."""
    inputs = {"pattern": "give the pattern.json that sl-pattern wrote"}
    run(lambda: capture(parse(CaptureConfig, "sl-capture", inputs, _GROUPS)))


if __name__ == "__main__":
    main()
