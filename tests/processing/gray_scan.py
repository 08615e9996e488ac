"""Photographs of Gray-code sequences on a synthetic object, in the folders that `sl-process` takes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.api import write_devices
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import sample_bilinear
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import make_setup

LAYOUT = GrayCode(800, 800, 4)


@dataclass(frozen=True)
class GrayScan:
    """Where the captures are, and what is true."""

    root: Path
    T_world_camera: np.ndarray
    T_world_projector: np.ndarray
    coords: list[np.ndarray]

    @property
    def flags(self) -> list[str]:
        """The flags that every call of sl-process needs, except --output."""
        names = ("images", "pattern", "intrinsics")
        files = ("images", "pattern.json", "intrinsics.json")
        return [word for n, f in zip(names, files, strict=True) for word in (f"--{n}", str(self.root / f))]


def make_gray_scan(root: Path, frames=4, resolution=160, noise=0.006, **config) -> GrayScan:
    """The first frames of a walk around the head, each photographed under every pattern of LAYOUT."""
    setup = make_setup(SynthConfig(scene="head", frames=22, resolution=resolution, seed=3, **config))
    rng = np.random.default_rng(0)
    coords = []
    patterns = [p.astype(np.float32) / 255 for p in LAYOUT.sequence()]
    for k in range(frames):
        rendered = setup.render(k, 1)
        coords.append(rendered.coords)
        albedo = 0.5 + 0.4 * gaussian_filter(rng.random(rendered.mask.shape), 3)
        for number, pattern in enumerate(patterns):
            light = np.where(rendered.mask, np.nan_to_num(sample_bilinear(pattern, rendered.coords)), 0)
            image = gaussian_filter(albedo * light + 0.03, 0.4) + noise * rng.standard_normal(light.shape)
            path = root / "images" / f"pose {k}" / f"{number}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(encode_png(np.clip(np.rint(255 * image), 0, 255).astype(np.uint8)))
    (root / "pattern.json").write_bytes(LAYOUT.encode())
    write_devices(root / "intrinsics.json", setup.devices.camera, setup.devices.projector)
    truth = setup.truth
    return GrayScan(root, truth.T_world_camera[:frames], truth.T_world_projector[:frames], coords)
