"""Frames of a video: those that are sharp, and apart by how far the image moved."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.config import FEWEST_FRAMES
from sl_nerfstudio.scan.document import FileError, check_file
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.write import encode_json
from sl_nerfstudio.storage import write_atomic

# How sharp the frames of a video are, and how far the picture moves from one to the next.

SHARP = 0.42  # sharpness of a picture whose edges are blurred by a standard deviation of two pixels, of 960
_WIDTH = 960  # pixels of the longer side, for the sharpness
_NOISE = 0.024  # of the square of the median Laplacian: what noise adds to the fine detail's strongest tenth
_LEAST_DETAIL = 4.0  # squares of grey levels: with less, nothing is seen
_EDGES = 0.05  # of the other direction's detail: a direction with less has no edges
_SMALL = 480  # the same, for the motion
_POINTS, _QUALITY, _APART = 300, 0.01, 7  # tracked corners, as in cv2.goodFeaturesToTrack
_LEAST_POINTS = 12
_PERCENTILE = 75  # of the tracked corners' motion: a pattern that moves with the devices stays in place
_RETURN_PX = 1.0  # tracked there and back


@dataclass(frozen=True)
class FrameMeasure:
    """One frame of a video."""

    number: int
    time_s: float
    sharpness: float
    moved: float  # since the frame before, share of the image's diagonal


def sharpness(grey: UInt8[ndarray, "h w"]) -> float:
    """Detail between 1 and 2 pixels against that between 2 and 4: about 0.7 for sharp edges, 0.25 for blurred ones.

    It does not depend on contrast. The smaller value of both directions counts, because motion blurs in one; a
    direction without edges does not.
    """
    image = _resized(grey, _WIDTH).astype(np.float32)
    noise = float(np.median(np.abs(cv2.Laplacian(image, cv2.CV_32F)))) ** 2 * _NOISE
    found = []
    for axis in (0, 1):
        smooth = [_smoothed(image, sigma, axis) for sigma in (1.0, 2.0, 4.0)]
        fine, coarse = _energy(smooth[0] - smooth[1]) - noise, _energy(smooth[1] - smooth[2]) - noise / 2
        found.append((max(fine, 0.0), max(coarse, 0.0)))
    strongest = max(coarse for _, coarse in found)
    if strongest < _LEAST_DETAIL:
        return 0.0
    return min(float(np.sqrt(fine / coarse)) for fine, coarse in found if coarse >= _EDGES * strongest)


def _smoothed(image: Float32[ndarray, "h w"], sigma: float, axis: int) -> Float32[ndarray, "h w"]:
    kernel = cv2.getGaussianKernel(2 * round(4 * sigma) + 1, sigma)
    one = np.ones((1, 1))
    return np.asarray(cv2.sepFilter2D(image, -1, *((one, kernel) if axis == 0 else (kernel, one))))


def _energy(detail: Float32[ndarray, "h w"]) -> float:
    """Mean square of the strongest tenth: edges, not the flat areas between them."""
    squares = np.square(detail).reshape(-1)
    count = max(len(squares) // 10, 1)
    return float(np.partition(squares, len(squares) - count)[-count:].mean())


def _motion(before: UInt8[ndarray, "h w"], now: UInt8[ndarray, "h w"]) -> float:
    """Motion of the picture, share of its diagonal, from corners that are found again."""
    points = cv2.goodFeaturesToTrack(before, _POINTS, _QUALITY, _APART)
    if points is None or len(points) < _LEAST_POINTS:
        return 0.0
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, points, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    back, found_again, _ = cv2.calcOpticalFlowPyrLK(now, before, there, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
    good = (found & found_again)[:, 0].astype(bool)
    good &= np.linalg.norm((back - points)[:, 0], axis=1) < _RETURN_PX
    diagonal = float(np.hypot(before.shape[0], before.shape[1]))
    if good.sum() < _LEAST_POINTS:
        return 1 / 10  # nothing was found again: a jump, or a blurred frame
    return float(np.percentile(np.linalg.norm((there - points)[good, 0], axis=1), _PERCENTILE)) / diagonal


def _resized(grey: UInt8[ndarray, "h w"], longest: int) -> UInt8[ndarray, "h w"]:
    factor = longest / max(grey.shape)
    if factor >= 1:
        return grey
    h, w = (max(round(side * factor), 1) for side in grey.shape)
    return np.asarray(cv2.resize(grey, (w, h), interpolation=cv2.INTER_AREA))


# The choice of frames, kept in the work folder.

ENDINGS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
FOLDER = "video"  # in the work folder
_VERSION = 1  # of the choice
_RECORD = "chosen.json"
_STEP = 0.04  # of the image's diagonal, between chosen frames
_MOST = 60  # chosen frames; with more, the step grows
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
        """Describe the choice for the output and the report."""
        numbers = ", ".join(str(frame.number) for frame in self.chosen)
        return [
            f"{self.file}: {len(self.chosen)} of {self.frames_in_video} frames were chosen: numbers {numbers}",
            f"of each {self.step:.1%} of the image's diagonal that the picture moved, the sharpest frame; "
            f"{self.blurred} frames are blurred (sharpness below {self.least_sharpness:.2f})",
        ]


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
        for number, _, pixels in track(_decoded(path, "rgb24"), "keeping frames", kept.frames_in_video):
            if number in numbers:
                write_atomic(folder / f"{numbers[number]}.png", encode_png(pixels))
        write_atomic(folder / _RECORD, encode_json(asdict(kept)))
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
    if sharp.sum() < FEWEST_FRAMES:
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
    if len(chosen) < FEWEST_FRAMES:
        raise FileError(
            path,
            f"moves by {way[-1]:.1%} of the image's diagonal only: {len(chosen)} frame was chosen",
            "the camera stood still, or only its blurred frames show it moving",
            "walk around the object while recording",
        )
    return VideoChoice(path.name, len(measures), int((~sharp).sum()), round(least, 4), round(step, 5), tuple(chosen))


def _measures(path: Path) -> Iterator[FrameMeasure]:
    """Sharpness of every frame, and its motion since the frame before; 0 for the first."""
    before = None
    for number, time_s, grey in _decoded(path, "gray"):
        small = _resized(grey, _SMALL)
        moved = 0.0 if before is None or before.shape != small.shape else _motion(before, small)
        yield FrameMeasure(number, time_s, sharpness(grey), moved)
        before = small


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
    """Digest of the file and of how frames are chosen."""
    found = hashlib.sha256(f"{_VERSION} {_STEP} {_MOST} {SHARP} {_RELATIVE}".encode())
    with path.open("rb") as stream:
        while part := stream.read(1 << 20):
            found.update(part)
    return found.hexdigest()[:16]
