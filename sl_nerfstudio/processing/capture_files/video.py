"""Frames of a video: those that are sharp, and apart by how far the image moved."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.processing.capture_files.video_motion import SHARP, FrameMeasure, VideoMeter
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.file_error import FileError, check_file
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.writing import encode_json

ENDINGS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
FOLDER = "video"  # in the work folder
_VERSION = 1  # of the choice
_RECORD = "chosen.json"
_STEP = 0.04  # of the image's diagonal, between chosen frames
_MOST = 60  # chosen frames; with more, the step grows
_FEWEST = 2
_RELATIVE = 0.6  # of the sharpness of the video's sharp frames: less is blurred by motion


@dataclass(frozen=True)
class ChosenFrame:
    """One frame of the video, kept as an image in the work folder."""

    name: str  # of the frame in the scan
    number: int  # in the video, counted from 0
    time_s: float
    sharpness: float  # detail between 1 and 2 pixels against detail between 2 and 4, of an image 960 pixels wide
    moved: float  # since the chosen frame before it, share of the image's diagonal


@dataclass(frozen=True)
class VideoChoice:
    """The frames that were chosen from a video, and why not others."""

    file: str
    frames_in_video: int
    blurred: int  # frames that are less sharp than `least_sharpness`
    least_sharpness: float
    step: float  # least motion between chosen frames, share of the image's diagonal
    chosen: tuple[ChosenFrame, ...]

    def sentences(self) -> list[str]:
        """For the output and the report."""
        numbers = ", ".join(str(frame.number) for frame in self.chosen)
        return [
            f"{self.file}: {len(self.chosen)} of {self.frames_in_video} frames were chosen: numbers {numbers}",
            f"of each {self.step:.1%} of the image's diagonal that the picture moved, the sharpest frame; "
            f"{self.blurred} frames are blurred (sharpness below {self.least_sharpness:.2f})",
        ]

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def is_video(path: Path) -> bool:
    """Whether a path names a video file."""
    return path.suffix.lower() in ENDINGS and not path.is_dir()


def video_frames(path: Path, work: Path) -> tuple[Path, VideoChoice]:
    """A folder with the chosen frames of a video as PNG, and what was chosen.

    They are kept in the work folder: another run takes the same. Frames are turned as the video says. Raises UserError
    if the reader is not installed, if the video cannot be read, or if fewer than two frames are sharp and apart.
    """
    check_file(path)
    folder = work / FOLDER / f"{path.stem}-{_digest(path)}"
    kept = _kept(folder)
    if kept is None:
        kept = _choose(path, list(track(_measures(path), "reading the video")))
        numbers = {frame.number: frame.name for frame in kept.chosen}
        for number, pixels in track(_pixels(path), "keeping frames", kept.frames_in_video):
            if number in numbers:
                write_atomic(folder / f"{numbers[number]}.png", encode_png(pixels))
        write_atomic(folder / _RECORD, encode_json(kept.document()))
    return folder, kept


def _kept(folder: Path) -> VideoChoice | None:
    """The choice of an earlier run, if all of its images are there."""
    try:
        record = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
        found = VideoChoice(**{**record, "chosen": tuple(ChosenFrame(**frame) for frame in record["chosen"])})
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return found if all((folder / f"{frame.name}.png").is_file() for frame in found.chosen) else None


def _choose(path: Path, measures: Sequence[FrameMeasure]) -> VideoChoice:
    """The sharpest frame of every step of motion. Raises FileError if fewer than two are sharp."""
    if not measures:
        raise FileError(path, "holds no frames", "recording it was interrupted", "record it again")
    sharpness = np.array([m.sharpness for m in measures])
    least = max(SHARP, _RELATIVE * float(np.percentile(sharpness, 90)))
    sharp = sharpness >= least
    if sharp.sum() < _FEWEST:
        raise FileError(
            path,
            f"has no two sharp frames (the sharpest: {sharpness.max():.2f}, at least {SHARP:g} is needed)",
            "out of focus, or moved fast under a long exposure, or compressed too much",
            "lock the focus on the object, light it more brightly or expose shorter, and move slowly; or stop for each "
            "view and give single photographs",
        )
    way = np.cumsum([m.moved for m in measures])
    step = max(_STEP, float(way[-1]) / _MOST)
    best: dict[int, int] = {}
    for k in np.flatnonzero(sharp):
        part = int(way[k] / step)
        if part not in best or sharpness[k] > sharpness[best[part]]:
            best[part] = int(k)
    chosen: list[ChosenFrame] = []
    last = -np.inf
    for k in sorted(best.values()):
        if way[k] - last < step / 2:  # both at the border of their steps
            continue
        moved = 0.0 if not chosen else float(way[k] - last)
        figures = (round(float(sharpness[k]), 4), round(moved, 5))
        chosen.append(ChosenFrame(f"video_{measures[k].number:06d}", measures[k].number, measures[k].time_s, *figures))
        last = float(way[k])
    if len(chosen) < _FEWEST:
        raise FileError(
            path,
            f"moves by {way[-1]:.1%} of the image's diagonal only: {len(chosen)} frame was chosen",
            "the camera stood still, or only its blurred frames show it moving",
            "walk around the object while recording",
        )
    return VideoChoice(path.name, len(measures), int((~sharp).sum()), round(least, 4), round(step, 5), tuple(chosen))


def _measures(path: Path) -> Iterator[FrameMeasure]:
    meter = VideoMeter()
    for number, time_s, grey in _decoded(path, "gray"):
        yield meter.measure(number, time_s, grey)


def _pixels(path: Path) -> Iterator[tuple[int, UInt8[ndarray, "h w 3"]]]:
    for number, _, pixels in _decoded(path, "rgb24"):
        yield number, pixels


def _decoded(path: Path, kind: str) -> Iterator[tuple[int, float, UInt8[ndarray, "h w *c"]]]:
    """Number, time in seconds and pixels of every frame, turned as the video says."""
    try:
        import av
    except ImportError as error:
        raise UserError(
            f"{path}: is a video, for which a reader is missing\n    cause:  PyAV is not installed\n"
            "    remedy: pip install 'sl-nerfstudio[video]', or give a folder of single images"
        ) from error
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise FileError(path, "holds no pictures", "a sound recording", "give a video")
            stream = container.streams.video[0]
            stream.thread_type = "SLICE"  # as on one core: the same frames, in the same order
            for number, frame in enumerate(container.decode(stream)):
                pixels = np.rot90(frame.to_ndarray(format=kind), round(frame.rotation / 90))
                yield number, round(float(frame.time or 0.0), 4), np.ascontiguousarray(pixels)
    except (av.FFmpegError, ValueError, EOFError) as error:
        raise FileError(
            path,
            f"cannot be read as a video ({str(error).splitlines()[0]})",
            "recording or copying it was interrupted, or its kind is not known",
            "copy it again, or convert it to MP4 (H.264)",
        ) from error


def _digest(path: Path) -> str:
    """Of the file and of how frames are chosen."""
    found = hashlib.sha256(f"{_VERSION} {_STEP} {_MOST} {SHARP} {_RELATIVE}".encode())
    with path.open("rb") as stream:
        while part := stream.read(1 << 20):
            found.update(part)
    return found.hexdigest()[:16]
