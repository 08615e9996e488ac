"""Captures of ramps on a synthetic object: two small images per frame, decoded quickly and almost exactly."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from sl_nerfstudio.api import write_devices
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frames import FrameJob
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import Setup, make_setup
from tests.decoding.ramps_decoder import Ramps, RampsDecoder

LAYOUT = Ramps(800, 800)
NAMES = ("a 1", "a 2", "a 3", "a 10")


@dataclass(frozen=True)
class RampScan:
    """Where the captures are, and what is true."""

    root: Path
    camera: Device
    projector: Device
    T_world_camera: np.ndarray
    coords: tuple[np.ndarray, ...]

    def config(self, output: Path, **changes) -> ProcessConfig:
        files = [self.root / name for name in ("images", "pattern.json", "intrinsics.json")]
        return ProcessConfig(*files, output, **{"jobs": 1, **changes})

    def job(self, work: Path) -> FrameJob:
        return FrameJob(work, RampsDecoder(LAYOUT), self.camera, self.projector, 0)

    def flags(self, output: Path) -> list[str]:
        files = {"images": "images", "pattern": "pattern.json", "intrinsics": "intrinsics.json"}
        given = [word for flag, name in files.items() for word in (f"--{flag}", str(self.root / name))]
        return [*given, "--output", str(output), "--jobs", "1"]


@cache
def _rendered():
    setup = make_setup(SynthConfig(scene="head", frames=22, resolution=130, seed=3))
    return setup, tuple(setup.render(k, 1).coords for k in range(len(NAMES)))


def make_ramp_scan(root: Path) -> RampScan:
    """Neighbouring frames of a walk around the head."""
    return make_captures(root, *_rendered())


def make_captures(root: Path, setup: Setup, coords: Sequence[np.ndarray], names: Sequence[str] = NAMES) -> RampScan:
    """The captures of the first frames of a setup, from their exact coordinates."""
    for name, uv in zip(names, coords, strict=True):
        folder = root / "images" / name
        folder.mkdir(parents=True)
        for axis, size in enumerate((LAYOUT.w, LAYOUT.h)):
            value = np.clip(np.nan_to_num(uv[..., axis]) / size, 0, 1)
            (folder / f"{axis}.png").write_bytes(encode_png(np.rint(65535 * value).astype(np.uint16)))
    (root / "pattern.json").write_bytes(LAYOUT.encode())
    camera, projector = setup.devices.camera, setup.devices.projector
    write_devices(root / "intrinsics.json", camera, projector)
    return RampScan(root, camera, projector, setup.truth.T_world_camera[: len(names)], tuple(coords))


def write_poses(path: Path, poses: Mapping[str, np.ndarray], **extra) -> Path:
    """A transforms.json with camera poses by the names of their frames."""
    frames = [{"file_path": f"x/{name}.png", "transform_matrix": np.asarray(T).tolist()} for name, T in poses.items()]
    path.write_text(json.dumps({"frames": frames, **extra}))
    return path
