"""One calibration from rendered photographs: sl-synth, sl-calibrate, and the comparison with the truth."""

import json
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from sl_nerfstudio.cli.calibrate import CalibrateConfig, calibrate_devices
from sl_nerfstudio.synthesis.boards import BOARDS, write_board_captures
from sl_nerfstudio.synthesis.config import SynthConfig

CENTRE = ("cx", "cy")
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
        """In words."""
        lens = ", distorting lenses" if self.lens else ""
        return f"{self.board}, {self.pattern}{lens}{', DOE projector' if self.projector == 'DOE' else ''}"


SETS = (
    BoardSet("chessboard", "gray code"),
    BoardSet("chessboard", "gray code", lens=True),
    BoardSet("charuco", "gray code", lens=True),
    BoardSet("chessboard", "coded grid", lens=True),
    BoardSet("charuco", "coded grid"),
    BoardSet("chessboard", "gray code", projector="DOE"),
)


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
        """Of focal length and principal point."""
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
