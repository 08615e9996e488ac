"""What the flags of sl-calibrate name: photographs, the pattern on them, and the corners of the board."""

from dataclasses import dataclass
from typing import Any

from sl_nerfstudio.calibration.board.calibrate import FEWEST_VIEWS
from sl_nerfstudio.calibration.board.captures import BoardCaptures, BoardPhotographs, read_board_captures
from sl_nerfstudio.cli.calibrating.config import CalibrateConfig
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.decoders import choose_decoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.boards import Board
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.processing.capture_files.projector_size import likely_layout
from sl_nerfstudio.processing.capture_files.sequences import (
    describe_sequence,
    incomplete,
    layout_in_order,
    recognise_sequence,
    resolution,
)
from sl_nerfstudio.processing.captures import Captures, find_captures
from sl_nerfstudio.progress import track

Size = tuple[int, int]


@dataclass(frozen=True)
class CalibrationInputs:
    """Everything a calibration starts from."""

    captures: BoardCaptures
    camera_size: Size
    pattern_size: Size | None  # None: the camera alone


def read_inputs(config: CalibrateConfig, board: Board) -> CalibrationInputs:
    """Find the board in all photographs, and say which poses cannot be used.

    Raises UserError if fewer than three remain, with what is wrong with each of the others.
    """
    found = _photographs(config)
    decoder = None if config.camera_only else _decoder(config, found)
    if decoder is not None and isinstance(decoder.layout, GrayCode):
        print(describe_sequence(decoder.layout), flush=True)
        found = found.with_faults(incomplete(found, decoder.layout))
    poses = [BoardPhotographs(frame.name, frame.images) for frame in found.frames if frame.name not in found.faults]
    captures = read_board_captures(poses, board, decoder, track)
    faults = [*found.faults.values(), *captures.faults]
    if len(captures.views) < FEWEST_VIEWS:
        listed = "\n".join(map(str, faults))
        raise UserError(
            f"{config.images}: {len(captures.views)} poses of the board can be used, {FEWEST_VIEWS} are needed\n"
            "    cause:  too few were captured, or those below cannot be used\n"
            f"    remedy: capture 10 poses, tilted to all sides, near and far, all over the image\n{listed}".rstrip()
        )
    for fault in faults:
        print(f"not used: {fault}", flush=True)
    layout = None if decoder is None else decoder.layout
    return CalibrationInputs(captures, found.size, None if layout is None else (layout.w, layout.h))


def _photographs(config: CalibrateConfig) -> Captures:
    """Poses in sub-folders; for the camera alone, also single images."""
    if config.camera_only and any(path.is_file() for path in _content(config)):
        return find_captures(config.images, sequences=False)
    return find_captures(config.images, sequences=True)


def _content(config: CalibrateConfig) -> list[Any]:
    try:
        return [path for path in config.images.iterdir() if not path.name.startswith(".")]
    except OSError:
        return []  # said by find_captures


def _decoder(config: CalibrateConfig, found: Captures) -> Decoder[Any]:
    """For the pattern that was projected."""
    if config.pattern is None:
        layout = likely_layout(found, config.sequence or "opencv")
        print(
            f"projector: taken to have {layout.w} x {layout.h} pixels; if not, say so as --pattern 1024x768", flush=True
        )
        return choose_decoder(layout, None, config.images)
    size = resolution(config.pattern)
    if size is not None:
        return choose_decoder(recognise_sequence(found, size, config.sequence, None), None, config.pattern)
    return choose_decoder(layout_in_order(config.pattern, config.sequence), None, config.pattern)
