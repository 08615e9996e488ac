"""The page docs/first-scan.md, command by command, on captures that the project makes itself.

    python -m benchmarks.first_scan [--folder FOLDER] [--output FILE]

Every command of the page runs as it stands there. Those with a display or a camera do not: tests/capture runs them.
What the camera would have seen is rendered: the board under the sequence of the page, and an object under its pattern,
by the same two devices, which no command is told. The known length is replaced by the true one.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import options, write_rows
from sl_nerfstudio.cli.run import run as run_main
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.pattern.boards import Chessboard
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.storage import NewFolder
from sl_nerfstudio.synthesis.boards import BoardPhotographer, make_board_scene, write_photographs
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DevicePair
from sl_nerfstudio.synthesis.synthesise import synthesise

PAGE = Path(__file__).parents[1] / "docs" / "first-scan.md"
_HARDWARE = ("--show", "--camera ")
_LENGTH = "baseline of frame 0 = 85 mm"


def page_commands() -> list[list[str]]:
    """Words of the page's commands, but for those with a display or a camera."""
    lines = re.findall(r"^    (sl-.*|ns-.*)$", PAGE.read_text(), re.MULTILINE)
    return [shlex.split(line) for line in lines if not any(flag in line for flag in _HARDWARE)]


@dataclass(frozen=True)
class Figure:
    """One line of the result."""

    name: str
    value: float | str


def first_scan(config: argparse.Namespace) -> list[Figure]:
    """Run the whole page. Raises UserError where a command fails."""
    folder = config.folder.absolute()
    folder.mkdir(parents=True)
    figures: list[Figure] = []
    for words in page_commands():
        name = words[0]
        if name == "sl-calibrate":
            _capture(config, folder)
        start = time.monotonic()
        _run(folder, [_true_length(folder) if word == _LENGTH else word for word in words])
        figures.append(Figure(f"{name}, seconds", round(time.monotonic() - start, 1)))
    return [*figures, *_accuracy(folder)]


def _capture(config: argparse.Namespace, folder: Path) -> None:
    """What the camera sees: captures/ of an object, and calibration/ of the board, by the same devices."""
    # The pattern of step 4 is that of the preset, so it can be made before its command.
    _run(folder, ["sl-pattern", "--preset", "1280x720", "--output", "rendered-pattern"])
    scene = SynthConfig(
        "frog", "realistic", "table", config.frames, config.resolution, folder / "rendered-pattern/pattern.json",
        config.seed, images_only=True,
    )  # fmt: skip
    synthesise(scene, folder / "rendered")
    os.rename(folder / "rendered/images", folder / "captures")
    devices = _devices(folder / "rendered/intrinsics.json")
    board = make_board_scene(Chessboard(9, 6, 20.0), devices, config.poses, np.random.default_rng(config.seed))
    photographer = BoardPhotographer(board, supersampling=2, noise=0.012)
    with NewFolder(folder / "rendered-board") as new:
        write_photographs(new, photographer, read_layout(folder / "gray/pattern.json"), config.seed)
    os.rename(folder / "rendered-board/images", folder / "calibration")


def _devices(path: Path) -> DevicePair:
    document = json.loads(path.read_text())
    keys = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    camera, projector = ({key: part[key] for key in keys} for part in (document, document["projector"]))
    return DevicePair(Device(**camera), Device(**projector))


def _true_length(folder: Path) -> str:
    frame = json.loads((folder / "rendered/ground_truth/transforms.json").read_text())["frames"][0]
    camera, projector = (np.array(frame[key])[:3, 3] for key in ("transform_matrix", "projector_transform_matrix"))
    return f"baseline of frame 0 = {np.linalg.norm(camera - projector):.9g} mm"


def _run(folder: Path, words: list[str]) -> None:
    print(f"$ {shlex.join(words)}", flush=True)
    command = [str(Path(sys.executable).parent / words[0]), *words[1:]]
    status = subprocess.run(command, cwd=folder, check=False, stdin=subprocess.DEVNULL).returncode
    if status:
        raise UserError(f"{shlex.join(words)}: exit status {status}")


def _accuracy(folder: Path) -> list[Figure]:
    """Errors of the calibration and of the surface, and the verdicts."""
    found, true = json.loads((folder / "intrinsics.json").read_text()), _devices(folder / "rendered/intrinsics.json")
    figures = [Figure("verdict of the calibration", found["verdict"])]
    for name, device in (("camera", true.camera), ("projector", true.projector)):
        centre = np.hypot(found[name]["cx"] - device.cx, found[name]["cy"] - device.cy)
        figures += [
            Figure(f"focal length of the {name}, error in %", 100 * (found[name]["fl_x"] / device.fl_x - 1)),
            Figure("its stated standard deviation, %", 100 * found[name]["sigma"]["fl_x"] / device.fl_x),
            Figure(f"principal point of the {name}, error in px", float(centre)),
        ]
    processing = json.loads((folder / "scan/processing.json").read_text())
    figures.append(Figure("verdict of sl-process", processing["verdict"]))
    figures.append(Figure("frames in the scan", sum(frame["in_scan"] for frame in processing["frames"])))
    shutil.copytree(folder / "rendered/ground_truth", folder / "scan/ground_truth")
    evaluate = "sl-eval --mesh mesh.ply --data scan --poses refined/transforms.json --json evaluation.json"
    _run(folder, shlex.split(evaluate))
    result = json.loads((folder / "evaluation.json").read_text())
    rigid = result["rigid"]["accuracy"]
    figures += [Figure(f"surface to truth, {key}, mm", rigid[key]) for key in ("rmse", "median")]
    return [*figures, Figure("verdict of sl-eval", result["verdict"])]


def main() -> None:
    """Run all commands in a new folder."""
    config = options(
        __doc__, folder=Path("outputs/first-scan"), poses=10, frames=24, resolution=600, seed=7, output=Path
    )
    figures = first_scan(config)
    for figure in figures:
        print(f"{figure.name:45s} {figure.value if isinstance(figure.value, str) else f'{figure.value:.4g}'}")
    write_rows(config.output, figures)


if __name__ == "__main__":
    run_main(main)
