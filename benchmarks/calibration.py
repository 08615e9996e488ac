"""Intrinsics by sl-calibrate against the truth, and the stated uncertainties against the errors.

    python -m benchmarks.calibration [--seeds 3] [--poses 12] [--resolution 960] [--output FILE]
    python -m benchmarks.calibration --real FOLDER --corners 9x7 --square "75 mm" --sequence opencv

Rendered boards: every kind of board, pattern, lens and projector, through the commands a user runs. Real ones: FOLDER
holds a folder of photographs for each pose; the whole procedure is repeated without each pose.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from benchmarks.common.measuring import Rows, options
from sl_nerfstudio.calibration.board import BoardCalibration, calibrate
from sl_nerfstudio.cli.calibrate import CalibrateConfig, calibrate_devices, read_inputs
from sl_nerfstudio.cli.run import run as run_main
from sl_nerfstudio.pattern.files import make_grid
from sl_nerfstudio.synthesis.boards import BOARDS, write_board_captures
from sl_nerfstudio.synthesis.config import SynthConfig

_LENS = (-0.12, 0.06, 0.0, 0.0)
_PROJECTOR_LENS = (-0.05, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class BoardSet:
    """What is rendered. A kind of board, a kind of pattern, and two devices."""

    board: Literal["chessboard", "charuco"]
    pattern: Literal["gray code", "coded grid"]
    lens: bool = False  # both devices distort
    projector: Literal["OPENCV", "DOE"] = "OPENCV"

    def __str__(self) -> str:
        """Name the set in words."""
        lens = ", distorting lenses" if self.lens else ""
        return f"{self.board}, {self.pattern}{lens}{', DOE projector' if self.projector == 'DOE' else ''}"


SETS = (
    BoardSet("chessboard", "gray code"), BoardSet("chessboard", "gray code", lens=True),
    BoardSet("charuco", "gray code", lens=True), BoardSet("chessboard", "coded grid", lens=True),
    BoardSet("charuco", "coded grid"), BoardSet("chessboard", "gray code", projector="DOE"),
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """Errors and stated uncertainties of one device of one calibration."""

    set: str
    seed: int
    device: Literal["camera", "projector"]
    poses: int
    verdict: str
    rms_px: float
    focal_percent: float
    focal_sigma_percent: float
    centre_px: tuple[float, float]
    centre_sigma_px: tuple[float, float]
    seconds: float  # of sl-calibrate, for both devices

    def errors_over_sigma(self) -> tuple[float, float, float]:
        """Errors of focal length and principal point over their stated sigma."""
        x, y = (abs(e) / s for e, s in zip(self.centre_px, self.centre_sigma_px, strict=True))
        return abs(self.focal_percent) / self.focal_sigma_percent, x, y


def calibrate_rendered(kind: BoardSet, seed: int, poses: int, resolution: int, coded: Path) -> list[Row]:
    """Render, calibrate as a user does, and compare. `coded` is the pattern.json of a coded grid."""
    pattern = coded if kind.pattern == "coded grid" else None
    config = SynthConfig(
        scene=kind.board, frames=poses, resolution=resolution, seed=seed, pattern=pattern,
        projector_model=kind.projector, camera_distortion=_LENS if kind.lens else (0.0, 0.0, 0.0, 0.0),
        projector_distortion=_PROJECTOR_LENS if kind.lens else (0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "captures"
        write_board_captures(config, root)
        output = Path(folder) / "intrinsics.json"
        start = time.perf_counter()
        calibrate_devices(_flags(kind, root, output))
        seconds = time.perf_counter() - start
        found = json.loads(output.read_text())
        truth = json.loads((root / "ground_truth" / "intrinsics.json").read_text())
    return [
        _row(kind, seed, device, found, truth[device], found["rms_px"][k], seconds)
        for k, device in enumerate(("camera", "projector"))
    ]


def _flags(kind: BoardSet, root: Path, output: Path) -> CalibrateConfig:
    board = asdict(BOARDS[kind.board])
    sizes: dict[str, Any] = {"square": f"{board['square']} mm"}
    if kind.board == "chessboard":
        sizes["corners"] = f"{board['columns']}x{board['rows']}"
    else:
        sizes |= {"squares": f"{board['columns']}x{board['rows']}", "marker": f"{board['marker']} mm"}
    return CalibrateConfig(
        images=root / "images", output=output, board=kind.board, pattern=root / "pattern.json",
        projector_model=kind.projector, **sizes,
    )  # fmt: skip


def _row(kind: BoardSet, seed: int, device: Any, found: Any, true: Any, rms_px: float, seconds: float) -> Row:
    got = found[device]
    percent = 100 / true["fl_x"]
    return Row(
        set=str(kind), seed=seed, device=device, poses=len(found["poses"]), verdict=found["verdict"], rms_px=rms_px,
        focal_percent=percent * (got["fl_x"] - true["fl_x"]), focal_sigma_percent=percent * got["sigma"]["fl_x"],
        centre_px=(got["cx"] - true["cx"], got["cy"] - true["cy"]),
        centre_sigma_px=(got["sigma"]["cx"], got["sigma"]["cy"]), seconds=seconds,
    )  # fmt: skip


RESULTS = Path("benchmarks/results")


@dataclass(frozen=True)
class RealRow:
    """The whole procedure on real photographs, model selection included, with all poses or without one."""

    left_out: str  # name of the pose; empty: all were used
    focal_px: tuple[float, ...]  # of the camera, and of the projector
    focal_moved_percent: tuple[float, ...]  # against all poses
    rms_px: tuple[float, ...]
    left_out_px: tuple[float, ...]  # RMS of the predictions of left-out poses
    models: tuple[str, ...]


def leave_each_out(config: CalibrateConfig) -> Iterator[RealRow]:
    """Calibrate with all poses first, then without each."""
    config.check()
    board = config.the_board()
    inputs = read_inputs(config, board)
    views = inputs.captures.views

    def found(left_out: int | None) -> BoardCalibration:
        some = [view for k, view in enumerate(views) if k != left_out]
        return calibrate(some, board, inputs.camera_size, inputs.pattern_size, config.projector_model, lambda x, _: x)

    whole = found(None)
    focal = [device.fl_x for device in whole.adjusted.rig.devices]
    for k in (None, *range(len(views))):
        one = whole if k is None else found(k)
        mine = tuple(device.fl_x for device in one.adjusted.rig.devices)
        moved = tuple(100 * (f / g - 1) for f, g in zip(mine, focal, strict=True))
        name = "" if k is None else views[k].name
        yield RealRow(name, mine, moved, one.rms_px, one.left_out.error_px, tuple(map(str, one.free)))


def main() -> None:
    """Run, print, and write after every calibration."""
    given = options(__doc__, seeds=3, poses=12, resolution=960, output=Path, real=Path, corners="9x7", square="75 mm",
                    sequence="opencv")  # fmt: skip
    if given.real is None:
        _rendered(given)
        return
    rows: Rows[RealRow] = Rows(given.output or RESULTS / "calibration_real.json")
    config = CalibrateConfig(
        given.real, Path("intrinsics.json"), corners=given.corners, square=given.square, sequence=given.sequence
    )
    for row in leave_each_out(config):
        rows.add(row)


def _rendered(given: argparse.Namespace) -> None:
    rows: Rows[Row] = Rows(given.output or RESULTS / "calibration.json", resolution=given.resolution)
    with tempfile.TemporaryDirectory() as folder:
        coded = Path(folder) / "pattern.json"
        coded.write_bytes(make_grid("1280x720").encode())
        for kind in SETS:
            for seed in range(1, given.seeds + 1):
                rows.add(*calibrate_rendered(kind, seed, given.poses, given.resolution, coded))
    over = np.array([row.errors_over_sigma() for row in rows])
    for name, share in zip(("focal length", "principal point x", "y"), over.T, strict=True):
        print(f"{name}: {np.mean(share <= 1):.0%} within 1 sigma, {np.mean(share <= 2):.0%} within 2")


if __name__ == "__main__":
    run_main(main)
