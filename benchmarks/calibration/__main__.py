"""Intrinsics by sl-calibrate against the truth, and the stated uncertainties against the errors.

    python -m benchmarks.calibration [--seeds 3] [--poses 12] [--resolution 960] [--output FILE]
    python -m benchmarks.calibration --real FOLDER --corners 9x7 --square "75 mm" --sequence opencv

Rendered boards: every kind of board, pattern, lens and projector, through the commands a user runs. Real ones: FOLDER
holds a folder of photographs for each pose; the whole procedure is repeated without each pose.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.calibration.real import leave_each_out
from benchmarks.calibration.rendered import SETS, Row, calibrate_rendered
from benchmarks.common.machine import write_rows
from sl_nerfstudio.cli.calibrate import CalibrateConfig
from sl_nerfstudio.cli.run import run as run_main
from sl_nerfstudio.pattern.files import make_grid
from sl_nerfstudio.pattern.layout import SequenceName

RESULTS = Path("benchmarks/results")


@dataclass(frozen=True)
class Arguments:
    """What is calibrated."""

    seeds: int = 3
    """random poses of the board and noise, for each kind of set"""
    poses: int = 12
    """poses of the board"""
    resolution: int = 960
    """width of the rendered images, pixels"""
    output: Path | None = None
    """JSON file to write; default: calibration.json or calibration_real.json in benchmarks/results"""
    real: Path | None = None
    """folder of real photographs, a folder for each pose"""
    corners: str = "9x7"
    """inner corners of the real chessboard"""
    square: str = "75 mm"
    """side of its squares"""
    sequence: SequenceName = "opencv"
    """order of its images"""


def main() -> None:
    """Run, print, and write after every calibration."""
    arguments = tyro.cli(Arguments)
    if arguments.real is not None:
        _real(arguments, arguments.real)
    else:
        _rendered(arguments)


def _rendered(arguments: Arguments) -> None:
    rows: list[Row] = []
    output = arguments.output or RESULTS / "calibration.json"
    with tempfile.TemporaryDirectory() as folder:
        coded = Path(folder) / "pattern.json"
        coded.write_bytes(make_grid("1280x720").encode())
        for kind in SETS:
            for seed in range(1, arguments.seeds + 1):
                rows += calibrate_rendered(kind, seed, arguments.poses, arguments.resolution, coded)
                for row in rows[-2:]:
                    print(_line(row), flush=True)
                write_rows(output, rows, resolution=arguments.resolution)
    over = np.array([row.errors_over_sigma() for row in rows])
    for name, share in zip(("focal length", "principal point x", "y"), over.T, strict=True):
        print(f"{name}: {np.mean(share <= 1):.0%} within 1 sigma, {np.mean(share <= 2):.0%} within 2")


def _line(row: Row) -> str:
    (x, y), (sx, sy) = row.centre_px, row.centre_sigma_px
    return (
        f"{row.set}, seed {row.seed}, {row.device}: focal length {row.focal_percent:+.3f} +- "
        f"{row.focal_sigma_percent:.3f} %, principal point {x:+.2f} +- {sx:.2f}, {y:+.2f} +- {sy:.2f} px, "
        f"RMS {row.rms_px:.2f} px, {row.verdict}, {row.seconds:.0f} s"
    )


def _real(arguments: Arguments, folder: Path) -> None:
    output = arguments.output or RESULTS / "calibration_real.json"
    config = CalibrateConfig(
        folder, Path("intrinsics.json"), corners=arguments.corners, square=arguments.square, sequence=arguments.sequence
    )
    rows = leave_each_out(config)
    for row in rows:
        moved = ", ".join(f"{focal:.1f} px ({part:+.2f} %)" for focal, part in
                          zip(row.focal_px, row.focal_moved_percent, strict=True))  # fmt: skip
        errors = " / ".join(f"{rms:.2f}" for rms in row.rms_px)
        print(f"without {row.left_out or 'none'}: {moved}; RMS {errors} px; {'; '.join(row.models)}")
    write_rows(output, rows)


if __name__ == "__main__":
    run_main(main)
