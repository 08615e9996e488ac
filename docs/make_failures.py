"""Makes captures with the usual mistakes, and lets `sl-process` say what is wrong: what docs/failures.md quotes.

.venv/bin/python docs/make_failures.py [outputs/failures]    # docs/pictures/failures.jpg, and what was said as text
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey, encode_png, read_image
from sl_nerfstudio.scan.write import device_fields, encode_json
from sl_nerfstudio.synthesis.config import PathKind, SynthConfig
from sl_nerfstudio.synthesis.devices import DevicePair, disturb_image
from sl_nerfstudio.synthesis.render import RayCaster
from sl_nerfstudio.synthesis.synthesise import GAIN, Setup, make_setup

ROOT = Path(__file__).parents[1]
FRAMES, RESOLUTION = 9, 480
NOISE = 0.012  # of the sensor at full scale
STEP = np.radians(20.0)  # of the turntable
GLOSS, EXPONENT = 2.0, 30.0

Picture = np.ndarray
Take = Callable[[Setup, int], Picture]


def plain(setup: Setup, frame: int, exposure: float = 1.0) -> Picture:
    """A capture without a mistake, unless it is exposed too little or too much."""
    light = setup.render(frame, 2).radiance
    return disturb_image(light, GAIN * exposure, NOISE, np.random.default_rng(frame))


def another_pattern(setup: Setup, frame: int) -> Picture:
    """The same place under the pattern of another seed."""
    return plain(replace(setup, pattern=GridPattern(seed=1).render()), frame)


def defocused(setup: Setup, frame: int) -> Picture:
    """The lens set to another distance."""
    return np.rint(gaussian_filter(plain(setup, frame).astype(np.float32), 6.0)).astype(np.uint8)


def glossy(setup: Setup, frame: int) -> Picture:
    """A lacquered object."""
    assert setup.photography is not None
    look = setup.photography.look
    lacquer = replace(look.material, gloss=GLOSS, exponent=EXPONENT)
    photography = replace(setup.photography, look=replace(look, material=lacquer))
    return setup.photograph(frame, 2, photography, 0).image


def turned(setup: Setup, frame: int) -> Picture:
    """The object on a turntable, seen from afar; what is around it stands still, as both devices do."""
    truth = setup.truth
    c, s = np.cos(STEP * frame), np.sin(STEP * frame)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    scene = replace(setup.scene, vertices=(setup.scene.vertices - setup.scene.centre) @ R.T + setup.scene.centre)
    still = DevicePoses(*(np.repeat(T[:1], FRAMES, 0) for T in (truth.T_world_camera, truth.T_world_projector)))
    return plain(
        replace(
            setup, scene=scene, devices=wider(setup.devices), caster=RayCaster(scene, setup.surroundings), truth=still
        ),
        frame,
    )


def wider(devices: DevicePair) -> DevicePair:
    """Both devices with half the focal length."""
    return DevicePair(*(replace(d, fl_x=d.fl_x / 2, fl_y=d.fl_y / 2) for d in (devices.camera, devices.projector)))


MISTAKES: dict[int, tuple[str, Take]] = {
    2: ("too dark", lambda setup, k: plain(setup, k, 0.004)),
    3: ("overexposed", lambda setup, k: plain(setup, k, 20.0)),
    4: ("out of focus", defocused),
    5: ("another pattern", another_pattern),
    6: ("mirrored", lambda setup, k: plain(setup, k)[:, ::-1]),
}
PATH: PathKind = "half-turn"  # neighbours share most of what they see
SETS: dict[str, tuple[SynthConfig, Take]] = {
    "mistakes": (
        SynthConfig(scene="head", background="table", frames=FRAMES, resolution=RESOLUTION, path=PATH, seed=5),
        lambda setup, k: MISTAKES.get(k, ("", plain))[1](setup, k),
    ),
    "glossy": (
        SynthConfig(scene="head", appearance="realistic", frames=FRAMES, resolution=RESOLUTION, path=PATH, seed=5),
        glossy,
    ),
    "slipping": (SynthConfig(scene="vase", frames=FRAMES, resolution=RESOLUTION, path=PATH, seed=5), plain),
    "turntable": (
        SynthConfig(scene="head", background="walls", frames=FRAMES, resolution=RESOLUTION, path="rigid-rig", seed=5),
        turned,
    ),
}


def make_captures(folder: Path, config: SynthConfig, take: Take) -> None:
    """Photographs, pattern and intrinsics, as a user has them."""
    setup = make_setup(config)
    assert setup.layout is not None
    (folder / "captures").mkdir(parents=True)
    for k in range(config.frames):
        (folder / f"captures/frame_{k:05d}.png").write_bytes(encode_png(np.ascontiguousarray(take(setup, k))))
        print(f"{folder.name}: {k + 1} of {config.frames}", flush=True)
    (folder / "pattern.json").write_bytes(setup.layout.encode())
    pair = wider(setup.devices) if take is turned else setup.devices
    devices = {"camera": pair.camera, "projector": pair.projector}
    document = {name: device_fields(device, "model") for name, device in devices.items()}
    (folder / "intrinsics.json").write_bytes(encode_json(document))


def process(folder: Path) -> None:
    """Run `sl-process` in the folder, and keep what it says."""
    flags = ("--images", "captures", "--pattern", "pattern.json", "--intrinsics", "intrinsics.json", "--output", "scan")
    command = [sys.executable, "-m", "sl_nerfstudio.cli.process", *flags]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    report = next(folder.glob("scan*/processing.json"), None)
    frames = [] if report is None else json.loads(report.read_text())["frames"]
    reasons = [f"\n{frame['name']}: {frame['reason']}" for frame in frames if frame.get("reason")]
    (folder / "said.txt").write_text("".join([ended.stdout, ended.stderr if ended.returncode else "", *reasons]))
    print(f"{folder / 'said.txt'}: status {ended.returncode}")


SIDE = 300  # pixels of each photograph in the picture
COLUMNS = 4


def draw(root: Path) -> None:
    """One of the photographs of each mistake, with its name."""
    shown = [("as it should be", "mistakes", 0), *((name, "mistakes", k) for k, (name, _) in MISTAKES.items()),
             ("glossy", "glossy", 4), ("slipping: looks alike from all sides", "slipping", 4),
             *((f"turntable, photograph {k}", "turntable", k) for k in range(4))]  # fmt: skip
    panels = []
    for name, folder, k in shown:
        grey = as_grey(read_image(root / folder / f"captures/frame_{k:05d}.png"))
        panel = cv2.resize(np.rint(255 * grey).astype(np.uint8), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        words = np.full((28, SIDE), 255, np.uint8)
        cv2.putText(words, name, (4, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0,), 1, cv2.LINE_AA)
        panels.append(np.pad(np.concatenate([words, panel]), 3, constant_values=255))
    rows = [np.concatenate(panels[k : k + COLUMNS], 1) for k in range(0, len(panels), COLUMNS)]
    path = ROOT / "docs/pictures/failures.jpg"
    cv2.imwrite(str(path), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(f"{path}: {path.stat().st_size // 1000} kB")


def main(root: Path) -> None:
    """Make and process what is not there yet, and draw the picture."""
    for name, (config, take) in SETS.items():
        if not (root / name / "said.txt").exists():
            shutil.rmtree(root / name, ignore_errors=True)
            make_captures(root / name, config, take)
            process(root / name)
    draw(root)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/failures"))
