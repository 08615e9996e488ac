"""sl-calibrate: intrinsics of a camera and a projector from photographs of a board."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sl_nerfstudio.cli.calibrating.config import CalibrateConfig
from sl_nerfstudio.cli.run import run

if TYPE_CHECKING:
    from sl_nerfstudio.calibration.board.calibrate import BoardCalibration
    from sl_nerfstudio.verdict.verdict import Verdict


def calibrate_devices(config: CalibrateConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    config.check()
    board = config.the_board()
    from sl_nerfstudio.calibration.board.calibrate import calibrate
    from sl_nerfstudio.calibration.board.result_file import MARK, encode_calibration
    from sl_nerfstudio.cli.calibrating.inputs import read_inputs
    from sl_nerfstudio.cli.calibrating.words import next_pose_words, require_determined
    from sl_nerfstudio.evaluation.report.calibration_report import TITLE, render_calibration_report
    from sl_nerfstudio.files.atomic import write_atomic
    from sl_nerfstudio.files.results import held_results
    from sl_nerfstudio.progress import track
    from sl_nerfstudio.verdict.calibration import judge_calibration

    report = config.output.with_suffix(".html")
    with held_results({config.output: MARK, report: TITLE}):
        inputs = read_inputs(config, board)
        found = calibrate(
            inputs.captures.views, board, inputs.camera_size, inputs.pattern_size, config.projector_model, track
        )
        require_determined(found)
        verdict = judge_calibration(found)
        command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
        page = render_calibration_report(found, inputs.captures, verdict, next_pose_words(found), command)
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


def main() -> None:
    """Entry point of the command."""
    run(
        lambda: calibrate_devices(
            tyro.cli(CalibrateConfig, prog="sl-calibrate", config=(tyro.conf.FlagCreatePairsOff,))
        )
    )


if __name__ == "__main__":
    main()
