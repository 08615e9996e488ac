"""sl-calibrate: intrinsics of a camera and a projector from photographs of a board."""

import shlex
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sl_nerfstudio.cli.arguments import PHOTOGRAPHS, parse
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import command, next_steps, phase, say, track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.layout import SequenceName

if TYPE_CHECKING:
    from sl_nerfstudio.calibration.board import BoardCalibration
    from sl_nerfstudio.calibration.board_captures import BoardCaptures
    from sl_nerfstudio.decoding.decoder import Decoder
    from sl_nerfstudio.pattern.boards import Board
    from sl_nerfstudio.processing.captures import Captures
    from sl_nerfstudio.review.verdict import Help, Verdict

# The flags of sl-calibrate.

_FLAGS = {"chessboard": ("corners",), "charuco": ("squares", "marker", "dictionary")}


@dataclass(frozen=True)
class CalibrateConfig:
    """Find the intrinsics of a camera and a projector from photographs of a board in at least 3 poses, better 10.

    For the projector, each pose is a folder of photographs: of a Gray-code sequence, or one under the coded grid and
    one without it, with nothing moved in between. Both devices stand still while the board moves.
    """

    images: Path
    """folder with one sub-folder for each pose; for the camera alone, one image for each pose"""
    output: Path
    """file to write, intrinsics.json; the report goes beside it, with the ending .html"""
    board: Literal["chessboard", "charuco"] = "chessboard"
    """kind of the board; a ChArUco board may be partly out of view"""
    corners: str | None = None
    """inner corners of a chessboard, where four squares meet, as 9x7"""
    squares: str | None = None
    """squares of a ChArUco board, as 25x18"""
    square: str | None = None
    """side of a square with its unit, as "75 mm"; measure it on the paper"""
    marker: str | None = None
    """side of a ChArUco board's markers with its unit, as "5.6 mm\""""
    dictionary: str = "5X5_1000"
    """OpenCV's name of the set of markers"""
    pattern: Path | None = None
    """pattern.json of what was projected; for the Gray code of another program its projector's size, as 1024x768"""
    sequence: SequenceName | None = None
    """order of the images of a Gray-code sequence, by the program that showed it; default: what pattern.json states, or
    for a --pattern that is a resolution what the images show. Alone, without --pattern: cells of one pixel on a
    projector of a usual resolution"""
    camera_only: bool = False
    """calibrate the camera alone"""
    projector_model: Literal["OPENCV", "DOE"] = "OPENCV"
    """pinhole, or a diffractive element whose pattern is uniform in direction cosines"""

    def check(self) -> None:
        """Raise UserError, naming the flag, if flags are missing or contradict each other."""
        for kind, names in _FLAGS.items():
            for name in names:
                if kind != self.board and getattr(self, name) not in (None, "5X5_1000"):
                    raise UserError(
                        f"--{name}: says nothing about a {self.board}\n    cause:  it describes a {kind}\n"
                        f"    remedy: give --board {kind}, or leave it out"
                    )
        needed = {"chessboard": ("corners", "square"), "charuco": ("squares", "square", "marker")}[self.board]
        for name in needed:
            if getattr(self, name) is None:
                example = {"corners": "9x7", "squares": "25x18", "square": '"75 mm"', "marker": '"5.6 mm"'}[name]
                raise UserError(
                    f"--{name} is missing\n    cause:  a {self.board} is described by {', '.join(needed)}\n"
                    f"    remedy: give for example --{name} {example}; sl-pattern prints it for its own boards"
                )
        if self.camera_only and (self.pattern is not None or self.sequence is not None):
            raise UserError(
                "--camera-only: no pattern is needed\n    cause:  --pattern and --sequence are for the projector\n"
                "    remedy: leave them out, or calibrate both devices without --camera-only"
            )
        if not self.camera_only and self.pattern is None and self.sequence is None:
            raise UserError(
                "--pattern is missing\n    cause:  without it nothing is known of the projector\n"
                "    remedy: give the pattern.json of what was projected, the order of a Gray code as --sequence "
                "opencv, or --camera-only"
            )
        if self.output.suffix.lower() != ".json":
            raise UserError(f"--output {self.output}: the file must end in .json")

    def the_board(self) -> "Board":
        """The board that the flags describe. Raises UserError if there can be none."""
        from sl_nerfstudio.pattern.boards import CharucoBoard, Chessboard, counts, millimetres

        side = millimetres(self.square or "", "--square")
        try:
            if self.board == "chessboard":
                return Chessboard(*counts(self.corners or "", "--corners"), side)
            marker = millimetres(self.marker or "", "--marker")
            return CharucoBoard(*counts(self.squares or "", "--squares"), side, marker, self.dictionary)
        except ValueError as error:
            raise UserError(f"--{' --'.join(_FLAGS[self.board])}: {error}") from error


_INPUTS = {"images": "give the folder with the captures of the board", "pattern": PHOTOGRAPHS["pattern"]}
_GROUPS = {
    "the board": ("board", "corners", "squares", "square", "marker", "dictionary"),
    "the projector": ("pattern", "sequence", "projector_model", "camera_only"),
}


# What the flags of sl-calibrate name: photographs, the pattern on them, and the corners of the board.

Size = tuple[int, int]


@dataclass(frozen=True)
class CalibrationInputs:
    """What a calibration starts from."""

    captures: "BoardCaptures"
    camera_size: Size
    pattern_size: Size | None  # None: the camera alone


def read_inputs(config: CalibrateConfig, board: "Board") -> CalibrationInputs:
    """Find the board in all photographs, and say which poses cannot be used.

    Raises UserError if fewer than three remain, with what is wrong with each of the others.
    """
    from sl_nerfstudio.calibration.board import FEWEST_VIEWS
    from sl_nerfstudio.calibration.board_captures import BoardPhotographs, read_board_captures
    from sl_nerfstudio.pattern.gray_code import GrayCode
    from sl_nerfstudio.processing.captures import describe_sequence, incomplete
    from sl_nerfstudio.processing.frames import capture_sentences

    found = _photographs(config)
    decoder = None if config.camera_only else _decoder(config, found)
    if decoder is not None and isinstance(decoder.layout, GrayCode):
        say(describe_sequence(decoder.layout))
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
        say(f"not used: {fault}")
    for sentence in capture_sentences(captures.noted):
        say(sentence)
    layout = None if decoder is None else decoder.layout
    return CalibrationInputs(captures, found.size, None if layout is None else (layout.w, layout.h))


def _photographs(config: CalibrateConfig) -> "Captures":
    """Poses in sub-folders; for the camera alone, also single images."""
    from sl_nerfstudio.calibration.board import FEWEST_VIEWS
    from sl_nerfstudio.processing.captures import find_captures

    single = False
    if config.camera_only:
        with suppress(OSError):  # said by find_captures
            single = any(path.is_file() for path in config.images.iterdir() if not path.name.startswith("."))
    return find_captures(config.images, not single, needs=f"a calibration needs {FEWEST_VIEWS} poses at least")


def _decoder(config: CalibrateConfig, found: "Captures") -> "Decoder[Any]":
    """Choose the decoder of the pattern that was projected."""
    from sl_nerfstudio.decoding.decoders import choose_decoder
    from sl_nerfstudio.processing.captures import layout_in_order, likely_layout, recognise_sequence, resolution

    if config.pattern is None:
        layout = likely_layout(found, config.sequence or "opencv")
        say(f"projector: taken to have {layout.w} x {layout.h} pixels; if not, say so as --pattern 1024x768")
        return choose_decoder(layout, None, config.images, config.sequence is not None)
    size = resolution(config.pattern)
    if size is None:
        layout = layout_in_order(config.pattern, config.sequence)
    else:
        layout = recognise_sequence(found, size, config.sequence, None)
    return choose_decoder(layout, None, config.pattern, config.sequence is not None)


# What sl-calibrate says about its result.

_HELP: "dict[Help, str]" = {
    "boards": "add poses, tilted to all sides, near and far, and run the same sl-calibrate again"
}


def next_pose_words(found: "BoardCalibration") -> str:
    """The further pose that would help most, as a sentence."""
    pose = found.next_pose
    if pose is None:
        return "no further pose was found that fits the images of both devices"
    place = "middle" if pose.row == pose.column == "middle" else f"{pose.row} {pose.column}"
    return (
        f"most useful next: the board in the {place} of the image, {pose.tilt}, {pose.distance}; focal lengths would "
        f"be known to {pose.sigma_after:.2%} instead of {pose.sigma_before:.2%} by the noise of the corners"
    )


def require_determined(found: "BoardCalibration") -> None:
    """Raise UserError if the poses do not determine a focal length."""
    from sl_nerfstudio.review.verdict import shortcomings, undetermined

    devices = undetermined(found)
    if not devices:
        return
    lacking = shortcomings(found)
    cause = "; ".join(lacking) if lacking else "the corners contradict each other from pose to pose"
    sigmas = [f"{s.focal() / d.fl_x:.0%}" for s, d in zip(found.sigmas, found.adjusted.rig.devices, strict=True)]
    raise UserError(
        f"the poses do not determine the focal length of the {' and of the '.join(devices)} (1 sigma: "
        f"{', '.join(sigmas)}); nothing was written\n    cause:  {cause}\n"
        f"    remedy: add poses; {next_pose_words(found)}"
    )


def calibrate_devices(config: CalibrateConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    config.check()
    with phase("start"):
        board = config.the_board()
        from sl_nerfstudio.calibration.board import MARK, calibrate, encode_calibration
        from sl_nerfstudio.evaluation.report.capture_reports import TITLE, render_calibration_report
        from sl_nerfstudio.review.verdict import judge_calibration
        from sl_nerfstudio.storage import held_results, write_atomic

    report = config.output.with_suffix(".html")
    with held_results({config.output: MARK, report: TITLE}):
        with phase("read"):
            inputs = read_inputs(config, board)
        with phase("calibrate"):
            found = calibrate(
                inputs.captures.views, board, inputs.camera_size, inputs.pattern_size, config.projector_model, track
            )
            require_determined(found)
        verdict = judge_calibration(found).with_help(_HELP)
        called = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
        page = render_calibration_report(found, inputs.captures, verdict, next_pose_words(found), called)
        write_atomic(config.output, encode_calibration(found, verdict.band, verdict.reasons))
        write_atomic(report, page.encode())
    _print_summary(config, found, verdict, next_pose_words(found))


def _print_summary(config: CalibrateConfig, found: "BoardCalibration", verdict: "Verdict", next_pose: str) -> None:
    for name, device, sigma, model, rms, left_out in zip(
        ("camera", "projector"), found.adjusted.rig.devices, found.sigmas, found.free, found.rms_px,
        found.left_out.error_px, strict=False,
    ):  # fmt: skip
        print(
            f"{name}: focal length {device.fl_x:.1f} +- {sigma.focal():.1f} px, principal point ({device.cx:.1f}, "
            f"{device.cy:.1f}) +- {sigma.centre():.1f} px, of {device.w} x {device.h} px\n"
            f"  fitted: {model}; residual {rms:.2f} px, in left-out poses {left_out:.2f} px (RMS)"
        )
    print(f"verdict: {verdict.band}")
    for reason in verdict.reasons:
        print(f"  {reason}")
    print(next_pose)
    print(f"wrote {config.output}\nreport: {config.output.with_suffix('.html')}")
    pattern = config.pattern or "pattern.json"
    flags = ("--images", "captures", "--pattern", pattern, "--intrinsics", config.output, "--output", "scan")
    print(next_steps([command("sl-process", *flags, *(["--estimate-projector"] if config.camera_only else []))]))


def main() -> None:
    """Entry point of the command."""
    run(lambda: calibrate_devices(parse(CalibrateConfig, "sl-calibrate", _INPUTS, _GROUPS)))


if __name__ == "__main__":
    main()
