"""`sl-data`: a scan folder as nerfstudio's dataparser. Must not import datamanagers, trainer or methods."""

import sys
import warnings
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from sl_nerfstudio.dataparser.fingerprint import scan_fingerprint
from sl_nerfstudio.dataparser.normalise import normalisation
from sl_nerfstudio.dataparser.samples import PixelSamples, build_samples
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import UNCHANGED, Device, IntrinsicsChange
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.late_compiler import begin_imports
from sl_nerfstudio.scan import Scan, read_scan
from sl_nerfstudio.scan.intrinsics import device_problems

# nerfstudio 1.1.5 uses what torch has deprecated, and a user can do nothing about it. Every command of it imports this
# module before those parts.
warnings.filterwarnings("ignore", r"`torch\.cuda\.amp\.", FutureWarning, module="nerfstudio")
warnings.filterwarnings("ignore", "Using a non-tuple sequence for multidimensional indexing", module="nerfstudio")
begin_imports(sys.argv)


@dataclass
class SLDataParserConfig(DataParserConfig):
    """A scan folder: frames of a camera, each with a pattern projector (docs/scan-format.md)."""

    _target: type = field(default_factory=lambda: SLDataParser)
    data: Path = Path()
    """The scan folder, or its transforms.json."""
    downscale_factor: float | None = None
    """Shrink whole images by this factor in evaluation, rendering and the viewer. Training uses every pixel."""
    intrinsics_change: IntrinsicsChange = UNCHANGED
    """Change of the scan's focal lengths and principal points; `refine_intrinsics` sets it."""


@dataclass(frozen=True)
class LoadedScan:
    """A scan with the table of its pixels and its normalisation."""

    scan: Scan
    samples: PixelSamples
    S_scene_world: Similarity

    @cached_property
    def fingerprint(self) -> str:
        """Which scan it is, wherever its folder lies; see fingerprint.py."""
        return scan_fingerprint(self.scan)


@dataclass
class SLDataParser(DataParser):
    """Cameras in the normalised scene. All splits hold all frames: poses are refined, so every frame is needed.

    Training never uses small blocks of pixels in every frame (`held_out`).
    """

    config: SLDataParserConfig

    def __init__(self, config: SLDataParserConfig) -> None:
        super().__init__(config=config)
        # An attribute, because nerfstudio overwrites it to switch resizing off.
        self.downscale_factor: float | int | None = config.downscale_factor

    @property
    def loaded(self) -> LoadedScan:
        """The scan, its pixels and its normalisation. Raises UserError for a folder that cannot be used."""
        return load_scan(self.config.data, self.config.intrinsics_change)

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: dict | None) -> DataparserOutputs:
        scan, S = self.loaded.scan, self.loaded.S_scene_world
        return DataparserOutputs(
            image_filenames=[frame.image_path for frame in scan.frames],
            cameras=scene_cameras(scan, S, self.downscale_factor),
            scene_box=SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
            metadata={"sl_scan": scan, "sl_S_scene_world": S},
            dataparser_transform=torch.from_numpy(S.matrix()[:3] / S.scale).float(),
            dataparser_scale=S.scale,
        )


def scene_cameras(scan: Scan, S_scene_world: Similarity, downscale_factor: float | int | None = None) -> Cameras:
    """The scan's cameras in the normalised scene; `metadata["sl_view"]` is the number of the frame."""
    poses = torch.from_numpy(S_scene_world.poses(scan.poses.T_world_camera)[:, :3]).float()
    devices = [frame.camera for frame in scan.frames]
    distortion = _column(devices, "k1", "k2", "zero", "zero", "p1", "p2")
    cameras = Cameras(
        camera_to_worlds=poses,
        fx=_column(devices, "fl_x"),
        fy=_column(devices, "fl_y"),
        cx=_column(devices, "cx"),
        cy=_column(devices, "cy"),
        width=_column(devices, "w").long(),
        height=_column(devices, "h").long(),
        distortion_params=distortion if bool((distortion != 0).any()) else None,
        camera_type=CameraType.PERSPECTIVE,
        metadata={"sl_view": torch.arange(len(devices))[:, None]},
    )
    if downscale_factor is not None and downscale_factor != 1:
        cameras.rescale_output_resolution(1 / downscale_factor)
    return cameras


def _column(devices: list[Device], *names: str) -> torch.Tensor:
    """The named intrinsics of every device, [n, names]."""
    return torch.tensor([[float(getattr(device, name, 0.0)) for name in names] for device in devices])


def scan_root(data: Path) -> Path:
    """The absolute path of the scan folder, from the value of `--data`: the folder or its transforms.json."""
    data = Path(data).expanduser().absolute()
    return data.parent if data.name == "transforms.json" else data


_remembered: dict[tuple[Path, int], dict[IntrinsicsChange, LoadedScan]] = {}


def load_scan(data: Path, intrinsics_change: IntrinsicsChange = UNCHANGED) -> LoadedScan:
    """Read a scan with all of its pixels. The last one is cached while its transforms.json is unchanged.

    nerfstudio makes several dataparsers in one command; the pixels are read once. Raises UserError for a folder that
    cannot be used, or for a change that leads to impossible intrinsics.
    """
    root = scan_root(data)
    scan = read_scan(root)
    key = (root, (root / "transforms.json").stat().st_mtime_ns)
    if key not in _remembered:
        _remembered.clear()
        samples = build_samples(scan)
        _remembered[key] = {UNCHANGED: LoadedScan(scan, samples, normalisation(scan, samples))}
    loaded = _remembered[key]
    if intrinsics_change not in loaded:
        changed = scan.with_intrinsics_change(intrinsics_change)
        _require_possible(changed)
        samples = loaded[UNCHANGED].samples
        loaded[intrinsics_change] = LoadedScan(changed, samples, normalisation(changed, samples))
    return loaded[intrinsics_change]


def _require_possible(scan: Scan) -> None:
    """Raises UserError if the intrinsics of a device are impossible."""
    for device in {*(frame.camera for frame in scan.frames), scan.projector}:
        for key, problem in device_problems(device):
            raise UserError(
                f"intrinsics_change {scan.intrinsics_change.values}: {key} {problem.problem}\n"
                "    cause:  percent or pixels were given\n"
                "    remedy: give shares of the focal length, for example 0.01 for one per cent of it"
            )


sl_data = DataParserSpecification(config=SLDataParserConfig(), description="A scan with a moving pattern projector")
