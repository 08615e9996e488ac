"""Everything about the captures that the flags name: the pattern, the frames, and what is to be said about them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sl_nerfstudio.calibration.formats.plain_json import camera_names
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.decoders import choose_decoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.processing.capture_files.sequences import (
    describe_sequence,
    incomplete,
    layout_in_order,
    recognise_sequence,
    resolution,
)
from sl_nerfstudio.processing.capture_files.video import VideoChoice, is_video, video_frames
from sl_nerfstudio.processing.captures import Captures, find_captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.photographs import refuse_mosaic


@dataclass(frozen=True)
class CaptureNotes:
    """What was found out about the captures, for the output, processing.json and the report."""

    sentences: tuple[str, ...] = ()
    sequence: str | None = None  # names of the order of a Gray code
    recognised: bool = False  # the order, from the images
    video: VideoChoice | None = None
    camera: dict[str, Any] | None = None  # figures of a camera that no file describes

    def with_camera(self, sentence: str, figures: dict[str, Any]) -> "CaptureNotes":
        """With what is known of a camera that no file describes."""
        return replace(self, sentences=(*self.sentences, sentence), camera=figures)

    def document(self) -> dict[str, Any]:
        """As JSON."""
        video = None if self.video is None else self.video.document()
        names = {"sequence": self.sequence, "sequence_recognised": self.recognised}
        return {**names, "video": video, "camera_focal": self.camera}


@dataclass(frozen=True)
class Captured:
    """The captures with their pattern."""

    decoder: Decoder[Any]
    captures: Captures
    notes: CaptureNotes


def read_captured(config: ProcessConfig) -> Captured:
    """Find the captures, and the pattern that they show. Raises UserError for flags and files that are wrong."""
    size = resolution(config.pattern)
    layout = None if size is not None else _layout(config)
    video = None
    root = config.images
    if is_video(root):
        if size is not None or isinstance(layout, GrayCode):
            raise FileError(
                root,
                "is a video, and Gray code needs one image for each pattern",
                "only the coded grid is decoded from single pictures",
                "give a folder with one sub-folder for each frame",
            )
        root, video = video_frames(root, config.work_folder)
    cameras = () if config.intrinsics is None else camera_names(config.intrinsics)
    if video is not None and cameras:
        raise FileError(
            config.images,
            "is one video, and the intrinsics file names several cameras",
            "a video shows the frames of one camera",
            "give a file with this camera alone",
        )
    decoder = None if layout is None else choose_decoder(layout, config.decoder, config.pattern)
    captures = find_captures(root, decoder is None or decoder.sequence, cameras)
    if not config.not_mosaic and video is None:
        _refuse_mosaics(captures)
    if layout is None and size is not None:
        layout = recognise_sequence(captures, size, config.sequence, config.cell)
    if layout is None:
        raise ValueError("a pattern is a file or a resolution")
    decoder = decoder or choose_decoder(layout, config.decoder, config.pattern)
    sentences: Sequence[str] = [] if video is None else video.sentences()
    if not isinstance(layout, GrayCode):
        return Captured(decoder, captures, CaptureNotes(tuple(sentences), video=video))
    captures = captures.with_faults(incomplete(captures, layout))
    recognised = size is not None and config.sequence is None
    said = describe_sequence(layout) + (", recognised from the images" if recognised else "")
    return Captured(decoder, captures, CaptureNotes((said,), layout.order, recognised))


def _layout(config: ProcessConfig) -> PatternLayout:
    """The pattern of a file, in the order of --sequence."""
    if config.cell is not None:
        raise UserError(
            "--cell: pattern.json states it\n    cause:  the flag is for a --pattern like 1024x768\n"
            "    remedy: leave --cell out"
        )
    return layout_in_order(config.pattern, config.sequence)


def _refuse_mosaics(captures: Captures) -> None:
    """Look at three images of the first whole frame of every camera. Raises FileError for raw mosaics."""
    for camera in captures.sizes:
        whole = [f for f in captures.frames if f.camera == camera and f.name not in captures.faults]
        if whole:
            images = whole[0].images
            for path in dict.fromkeys((images[0], images[len(images) // 2], images[-1])):
                refuse_mosaic(path)
