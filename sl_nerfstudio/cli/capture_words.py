"""What sl-capture says about what it sees."""

from collections.abc import Callable
from pathlib import Path

from jaxtyping import Int
from numpy import ndarray

from sl_nerfstudio.capture.grid_view import GridView
from sl_nerfstudio.capture.in_step import Captured, Progress
from sl_nerfstudio.capture.light import Light
from sl_nerfstudio.capture.picture import share_seen
from sl_nerfstudio.capture.selection import Selection, Verdict
from sl_nerfstudio.decoding.decoded import DecodingError

_VERDICTS = {
    Verdict.KEEP: "kept",
    Verdict.NO_PATTERN: "the pattern is not seen: point the camera at what the projector lights, or go closer",
    Verdict.BLURRED: "blurred: move more slowly, or focus again",
    Verdict.SATURATED: "too bright: shorten the exposure",
    Verdict.DARK: "too dark: lengthen the exposure, or use less room light and a brighter projector",
    Verdict.KNOWN: "this view is known: move on",
    Verdict.WAIT: "good; it is kept if you stay for a moment",
    Verdict.BY_KEY: "Space keeps this image",
}
_LEGEND = "map of the pattern: grey: not seen yet, red: in one frame, yellow: in two, green: in more"
_MOST_DRIFT = 0.1  # of the brightness during a sequence
_USUAL_LEAST = 10  # frames of a scan
_OFTEN = 3


def view_lines(view: GridView, verdict: Verdict, selection: Selection) -> list[str]:
    """The verdict, what was measured, and what is still missing."""
    measured = [_light_words(view.light)]
    if view.edge is not None:
        measured.append(f"edges {view.edge:.1f} px wide")
    if view.uv.size == 0:
        return [_VERDICTS[verdict], ", ".join(measured), f"{len(selection.kept)} frames kept"]
    if view.blur is not None:
        measured.append(f"blur {view.blur:.2f} periods")
    nodes = f"{int(view.seen.sum())} of {view.seen.size} nodes"
    seen = selection.times_seen
    share = f"they show {share_seen(seen):.0%} of the pattern, {share_seen(seen, _OFTEN):.0%} of it three times"
    return [_VERDICTS[verdict], ", ".join([nodes, *measured]), f"{len(selection.kept)} frames kept; {share}", _LEGEND]


def kept_words(say: Callable[[str], None], selection: Selection, name: str, view: GridView) -> None:
    """Say that a frame was written."""
    if view.uv.size == 0:
        say(f"  kept {name}")
        return
    seen = share_seen(selection.times_seen)
    say(f"  kept {name}: {int(view.seen.sum())} of {view.seen.size} nodes; all frames show {seen:.0%} of the pattern")


def sequence_lines(images: int, light: Light, progress: Progress) -> list[str]:
    """What to do, the light under the white image, and what is still missing."""
    return [
        f"Space captures the sequence of {images} images: nothing may move meanwhile",
        f"{_light_words(light)} (under white light)",
        f"{progress.frames} frames; they show {share_seen(progress.times_seen):.0%} of the pattern",
        _LEGEND,
    ]


def decoded_words(progress: Progress, name: str, captured: Captured) -> str:
    """A sequence was written; a warning where the light was not the same throughout."""
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


def failed_words(error: DecodingError) -> str:
    """A sequence was not kept."""
    return f"  not kept: this sequence {error}"


def coverage_words(frames: int, output: Path, times_seen: Int[ndarray, "rows columns"]) -> str:
    """The summary at the end."""
    if frames == 0:
        return f"no frame was kept, so {output} was not written"
    text = f"{frames} frame{'s' if frames != 1 else ''} in {output}"
    if times_seen.size:
        text += (
            f"; they show {share_seen(times_seen):.0%} of the pattern, {share_seen(times_seen, _OFTEN):.0%} three times"
        )
        if frames < _USUAL_LEAST:
            text += f"\na scan usually takes {_USUAL_LEAST} frames or more: run the same command again to go on"
    return text


def _light_words(light: Light) -> str:
    return f"{light.saturated:.0%} saturated, {light.dark:.0%} dark"
