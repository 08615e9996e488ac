"""`sl-data`: a scan folder as nerfstudio's dataparser. Must not import datamanagers, trainer or methods."""

import hashlib
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float, Float16, Float32, Int, Int16, Int32, Int64, Shaped, UInt8, UInt64
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from numpy import ndarray
from scipy.spatial import KDTree
from torch import Tensor

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import UNCHANGED, Device, Intrinsics, IntrinsicsChange
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.numerics import all_finite, evenly_spaced
from sl_nerfstudio.geometry.triangulation import triangulate, upright
from sl_nerfstudio.late_imports import begin_imports
from sl_nerfstudio.parallel import read_at_random, read_in_order
from sl_nerfstudio.scan import FileError, Frame, Scan, read_scan
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.types import device_problems
from sl_nerfstudio.storage import GrowingArray, largest_in_memory

# Which pixels are never used for training: small blocks, chosen by a hash of frame and block.

BLOCK = 8  # pixels; larger than the neighbourhood that bilinear look-up or interpolated coordinates share
FRACTION = 0.02
_SEED = 0x5EED


def block_hash(frame: int, height: int, width: int) -> Float[ndarray, "rows columns"]:
    """A number in [0, 1) for every block of one frame, the same on every machine and in every run."""
    rows = np.arange(-(-height // BLOCK), dtype=np.uint64)[:, None]
    columns = np.arange(-(-width // BLOCK), dtype=np.uint64)[None, :]
    key = np.uint64(_SEED) + (np.uint64(frame) << np.uint64(40)) + (rows << np.uint64(20)) + columns
    return (_mix(key) >> np.uint64(11)).astype(np.float64) / 2.0**53


def held_out_pixels(frame: int, height: int, width: int) -> Bool[ndarray, "height width"]:
    """True where a pixel of frame number `frame` is excluded from training; about FRACTION of all."""
    return spread(block_hash(frame, height, width) < FRACTION, height, width)


def spread(blocks: Shaped[ndarray, "rows columns"], height: int, width: int) -> Shaped[ndarray, "height width"]:
    """Values of blocks at their pixels."""
    return blocks.repeat(BLOCK, 0)[:height].repeat(BLOCK, 1)[:, :width]


def _mix(key: UInt64[ndarray, "..."]) -> UInt64[ndarray, "..."]:
    """SplitMix64's finaliser (Steele et al., OOPSLA 2014): every bit of the key affects every bit of the result."""
    with np.errstate(over="ignore"):
        key = key * np.uint64(0x9E3779B97F4A7C15)
        key = (key ^ (key >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        key = (key ^ (key >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return key ^ (key >> np.uint64(31))


# Which scan a run was trained on: a hash that its config.yml and its checkpoints carry.


def scan_fingerprint(scan: Scan) -> str:
    """SHA-256 (hexadecimal) of transforms.json and of every frame's coordinates and mask, in the order of the frames.

    Neither the folder's place nor the times of its files have a part in it. Raises UserError for unreadable files.
    """
    whole = hashlib.sha256()
    paths = [path for frame in scan.frames for path in (*frame.coords_paths, frame.mask_path) if path is not None]
    for path in (scan.root / TRANSFORMS, *paths):
        try:
            content = path.read_bytes()
        except OSError as error:
            raise FileError(
                path, f"cannot be read ({error.strerror})", "it was removed meanwhile", "restore the file"
            ) from error
        whole.update(hashlib.sha256(content).digest())
    return whole.hexdigest()


def require_same_scan(root: Path, actual: str, stated: str | None, of_what: str) -> None:
    """Raise UserError if the scan in `root` is not the one that a file (`of_what`) was made from."""
    if actual != stated:
        raise UserError(
            f"{root}: does not belong to {of_what}, which was trained on another scan\n"
            "    cause:  the scan was changed, processed again or exchanged since the training "
            f"(its {TRANSFORMS}, coordinates or masks)\n"
            "    remedy: give the unchanged scan with --data FOLDER, or train again under another name"
        )


# Every masked pixel of a scan in one compact table, and random draws from it.

_FIELDS = [("frame", "i4"), ("coords", "f4", 2), ("row", "i2"), ("column", "i2"), ("pattern", "f2"), ("held_out", "?")]
_RECORD = np.dtype([*_FIELDS, ("", "V1")])  # a pixel's fields lie together: a table in a file is read once for them
_AT_ONCE = 2**24  # pixels: bounds memory


@dataclass(frozen=True)
class PixelBatch:
    """Pixels selected from PixelSamples, in the types that computations need."""

    frame: Int[Tensor, "n"]
    row: Int[Tensor, "n"]
    column: Int[Tensor, "n"]
    coords: Float[Tensor, "n 2"]  # pattern pixels; NaN where not decoded
    pattern: Float[Tensor, "n"]  # [0, 1]
    held_out: Bool[Tensor, "n"]  # never used for training

    def to(self, device: torch.device | str) -> "PixelBatch":
        """Copy the pixels to another device."""
        return PixelBatch(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    @property
    def uv(self) -> Float[Tensor, "n 2"]:
        """Camera pixel coordinates (x, y) of the pixels' centres."""
        return torch.stack([self.column, self.row], -1).to(self.coords.dtype) + 0.5

    @property
    def decoded(self) -> Bool[Tensor, "n"]:
        """Whether the pixel's projector coordinates are known."""
        return self.coords[:, 0].isfinite()


@dataclass(frozen=True)
class PixelSamples:
    """Every masked pixel of every frame, one frame after the other; 20 bytes per pixel."""

    records: UInt8[Tensor, "n 20"]
    first: Int[Tensor, "frames_and_one"]  # frame i holds rows first[i] to first[i + 1] - 1
    held_out_index: Int[Tensor, "m"]  # rows that are never used for training, in order
    in_file: bool = False  # whether records are mapped from a file

    def __len__(self) -> int:
        return len(self.records)

    @property
    def frame(self) -> Int32[Tensor, "n"]:
        """Number of each pixel's frame."""
        return self._column("frame", torch.int32)[:, 0]

    @property
    def row(self) -> Int16[Tensor, "n"]:
        """Row in its image."""
        return self._column("row", torch.int16)[:, 0]

    @property
    def column(self) -> Int16[Tensor, "n"]:
        """Column in its image."""
        return self._column("column", torch.int16)[:, 0]

    @property
    def coords(self) -> Float32[Tensor, "n 2"]:
        """Pattern pixels; NaN where not decoded."""
        return self._column("coords", torch.float32)

    @property
    def pattern(self) -> Float16[Tensor, "n"]:
        """Intensity, [0, 1]; 11 bits are enough for a normalised one."""
        return self._column("pattern", torch.float16)[:, 0]

    @property
    def held_out(self) -> Bool[Tensor, "n"]:
        """Whether a pixel is never used for training."""
        return self._column("held_out", torch.bool)[:, 0]

    def _column(self, name: str, kind: torch.dtype) -> Shaped[Tensor, "n k"]:
        """One field of all records, without a copy."""
        part, first = _RECORD.fields[name][:2]  # type: ignore[index]
        return self.records[:, first : first + part.itemsize].view(kind)

    @property
    def decoded_share(self) -> float:
        """Share of the pixels whose coordinates are known."""
        self._announce(read_in_order)
        return sum(int(part.isfinite().sum()) for part in self.coords[:, 0].split(_AT_ONCE)) / len(self)

    def _announce(self, reading: Callable[[int, int], None]) -> None:
        """Tell the system how the records will be read next; this matters if they are in a file."""
        if self.in_file:
            reading(self.records.data_ptr(), self.records.nbytes)

    @property
    def device(self) -> torch.device:
        """The device that holds the table."""
        return self.records.device

    def to(self, device: torch.device | str) -> "PixelSamples":
        """Copy the table to another device."""
        if torch.device(device) == self.device:
            return self
        return PixelSamples(self.records.to(device), self.first.to(device), self.held_out_index.to(device))

    def in_order(self) -> Iterator[PixelBatch]:
        """All pixels of each frame."""
        self._announce(read_in_order)
        for first, last in pairwise(self.first.tolist()):
            yield self.at(slice(first, last))

    def draw(self, count: int, generator: torch.Generator | None = None, held_out: bool = False) -> Int[Tensor, "n"]:
        """Indices of `count` pixels, uniformly and with replacement, from those for training or from those held out.

        The time does not depend on the size of the table. `generator` must be on the table's device.
        """
        self._announce(read_at_random)
        if held_out:
            return self.held_out_index[self.randint(len(self.held_out_index), count, generator)]
        index = self.randint(len(self), count, generator)
        while True:  # rejection sampling: a few per cent are held out, so two or three rounds
            again = self.held_out[index].nonzero()[:, 0]
            if len(again) == 0:
                return index
            index[again] = self.randint(len(self), len(again), generator)

    @cached_property
    def training(self) -> Int[Tensor, "n_training"]:
        """Indices of all pixels that are not held out; 4 bytes per pixel."""
        return (~self.held_out).nonzero()[:, 0].to(torch.int32)

    def draw_without_waiting(self, count: int, generator: torch.Generator | None = None) -> Int[Tensor, "n"]:
        """Like `draw` for training, but in a fixed number of operations, so that the host need not wait for a GPU."""
        return self.training[self.randint(len(self.training), count, generator)].long()

    def held_out_of(self, frame: int, most: int) -> PixelBatch:
        """At most so many of one frame's held-out pixels, evenly spread."""
        lower, upper = torch.searchsorted(self.held_out_index, self.first[frame : frame + 2])
        index = self.held_out_index[lower:upper]
        return self.at(index[torch.from_numpy(evenly_spaced(len(index), min(len(index), most))).to(self.device)])

    def some_of(self, frame: int, most: int) -> PixelBatch:
        """At most so many of one frame's pixels, evenly spread."""
        first, last = self.first[frame : frame + 2].tolist()
        return self.at(first + torch.from_numpy(evenly_spaced(last - first, min(last - first, most))))

    def at(self, index: Int[Tensor, "n"] | slice) -> PixelBatch:
        """The pixels with these indices."""
        some = replace(self, records=self.records[index])
        return PixelBatch(
            frame=some.frame.long(),
            row=some.row.long(),
            column=some.column.long(),
            coords=some.coords.contiguous(),
            pattern=some.pattern.float(),
            held_out=some.held_out,
        )

    def randint(self, high: int, count: int, generator: torch.Generator | None) -> Int[Tensor, "n"]:
        """Random numbers below `high`, on the table's device."""
        return torch.randint(high, (count,), generator=generator, device=self.device)


def build_samples(scan: Scan, show_progress: bool = True) -> PixelSamples:
    """Read all frames of a scan, one in memory at a time. A table that is too large for memory is kept in a file.

    Raises UserError if the whole scan has too few masked pixels to train with some and test with others.
    """
    frames: Iterable[Frame] = track(scan.frames, "Reading frames") if show_progress else scan.frames
    table, first, held_out = GrowingArray(largest_in_memory()), [0], [np.zeros(0, dtype=np.int64)]
    for number, frame in enumerate(frames):
        pixels = _frame_pixels(number, frame)
        held_out.append(first[-1] + np.flatnonzero(pixels["held_out"]))
        first.append(first[-1] + len(pixels))
        table.append(pixels.view(np.uint8).reshape(-1, _RECORD.itemsize))
    records, index = table.whole(), np.concatenate(held_out)
    if len(index) == 0:
        index = _hold_one_block_out(scan, records.view(_RECORD)[:, 0])
    if len(records) in (0, len(index)):
        raise UserError(
            f"{scan.root}: only {len(records)} masked pixels in {len(scan.frames)} frames, too few to train on. "
            "Check masks/ (255 where the pattern falls on the object) or coords/ (NaN only where decoding failed)."
        )
    in_file = isinstance(records, np.memmap)
    return PixelSamples(torch.from_numpy(records), torch.tensor(first), torch.from_numpy(index), in_file)


def _frame_pixels(number: int, frame: Frame) -> Shaped[ndarray, "n"]:
    """The records of one frame."""
    coords = frame.read_coords()
    mask = all_finite(coords) if frame.mask_path is None else frame.read_mask()
    row, column = mask.nonzero()
    out = np.zeros(len(row), dtype=_RECORD)
    out["frame"], out["row"], out["column"], out["coords"] = number, row, column, coords[mask]
    out["pattern"], out["held_out"] = frame.read_pattern()[mask], held_out_pixels(number, *mask.shape)[mask]
    return out


def _hold_one_block_out(scan: Scan, records: Shaped[ndarray, "n"]) -> Int64[ndarray, "m"]:
    """Hold out the occupied block with the smallest hash, in scans so small that the hash alone holds nothing out."""
    value = np.empty(len(records))
    for number, frame in enumerate(scan.frames):
        own = records["frame"] == number
        pixels = spread(block_hash(number, frame.camera.h, frame.camera.w), frame.camera.h, frame.camera.w)
        value[own] = pixels[records["row"][own], records["column"][own]]
    records["held_out"] = value == value.min(initial=np.inf)
    return np.flatnonzero(records["held_out"])


# From the scan's world to the scene of the field: the object is at the origin, inside the unit sphere.
#
# The map depends only on the triangulated points and on the cameras' orientations. If the world of a scan is
# rotated, shifted or scaled, the normalised scene stays the same except for rounding.

OBJECT_RADIUS = 0.8  # of the scene's unit sphere; the rest allows for poses that are still wrong
_POINTS_PER_FRAME = 1000
_FEWEST_POINTS = 16
_NEIGHBOURS = 8
_LONELY = 4.0  # times the median distance to the neighbours: beyond it a decoding counts as wrong
_INSIDE = 0.99  # share of the points inside the object's sphere


def normalisation(scan: Scan, samples: PixelSamples) -> Similarity:
    """`S_scene_world`, with scene axes that `upright` derives from the cameras.

    Raises UserError if hardly any pixel can be triangulated.
    """
    points, tried = triangulated_points(scan, samples)
    if len(points) < _FEWEST_POINTS:
        raise UserError(
            f"{scan.root / 'transforms.json'}: only {len(points)} of {tried} pixels have a camera ray and a projector "
            "ray that meet in front of both devices. The poses are probably world-to-device instead of "
            "device-to-world, or in OpenCV axes (multiply them by diag(1, -1, -1, 1) from the right), or coords/ has "
            "x and y swapped. sl-process finds poses and coordinates from the photographs."
        )
    centre, radius = enclosing_sphere(without_lonely(points))
    scale = OBJECT_RADIUS / radius
    R = upright(scan.poses.T_world_camera)
    return Similarity(scale, R, -scale * R @ centre)


def triangulated_points(scan: Scan, samples: PixelSamples) -> tuple[Float[ndarray, "n 3"], int]:
    """World points of up to 1000 decoded pixels of each frame, and how many pixels were tried."""
    points, tried = [], 0
    for number, frame in enumerate(scan.frames):
        pixels = samples.some_of(number, _POINTS_PER_FRAME)
        decoded = pixels.decoded
        count = int(decoded.sum())
        tried += count
        found = triangulate(
            Intrinsics.of(frame.camera, torch.float64),
            torch.from_numpy(frame.T_world_camera).expand(count, 4, 4),
            pixels.uv[decoded].double(),
            Intrinsics.of(scan.projector, torch.float64),
            torch.from_numpy(frame.T_world_projector).expand(count, 4, 4),
            pixels.coords[decoded].double(),
        )
        good = found.p_world.isfinite().all(-1) & (found.depth_camera > 0) & (found.depth_projector > 0)
        points.append(found.p_world[good].numpy())
    return np.concatenate(points), tried


def without_lonely(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """Points whose neighbours are about as close as those of most points: wrong decodings scatter along their rays."""
    distance, _ = KDTree(points).query(points, k=_NEIGHBOURS + 1)
    distance = distance[:, -1]
    return points[distance <= _LONELY * np.median(distance)]


def enclosing_sphere(points: Float[ndarray, "n 3"], rounds: int = 300) -> tuple[Float[ndarray, "3"], float]:
    """Centre and radius of a nearly smallest sphere around 99 % of the points.

    Badoiu and Clarkson's iteration (SODA 2003) with the farthest point replaced by the one at the 99 % quantile.
    The result does not depend on the axes.
    """
    centre = points.mean(0)
    last = int(_INSIDE * (len(points) - 1))
    for i in range(rounds):
        distance = np.linalg.norm(points - centre, axis=1)
        far = np.argpartition(distance, last)[last]
        centre = centre + (points[far] - centre) / (i + 2)
    return centre, float(np.quantile(np.linalg.norm(points - centre, axis=1), _INSIDE))


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
    length_factor: tyro.conf.Suppress[float] = 1.0
    """What the scan's lengths are multiplied by, so that a length that it got after the training holds at the poses of
    the run."""


@dataclass(frozen=True)
class LoadedScan:
    """A scan with the table of its pixels and its normalisation."""

    scan: Scan
    samples: PixelSamples
    S_scene_world: Similarity

    @cached_property
    def fingerprint(self) -> str:
        """Identity of the scan, independent of its folder; see `scan_fingerprint`."""
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
        root = scan_root(self.config.data)
        if not (root / "transforms.json").is_file():
            raise UserError(
                f"{root}: has no transforms.json, so the scan is not there\n"
                "    cause:  the scan of a run was moved, renamed or deleted after the training; ns-eval, ns-render "
                "and ns-viewer look for it where config.yml says\n"
                f"    remedy: put it back, or a link to it: ln -s NEW-PLACE {shlex.quote(str(root))}; sl-eval and "
                "sl-export have --data for its new place"
            )
        return load_scan(root, self.config.intrinsics_change, self.config.length_factor)

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


_remembered: dict[tuple[Path, int], dict[tuple[IntrinsicsChange, float], LoadedScan]] = {}
_AS_IT_IS = (UNCHANGED, 1.0)


def load_scan(data: Path, intrinsics_change: IntrinsicsChange = UNCHANGED, length_factor: float = 1.0) -> LoadedScan:
    """Read a scan with all of its pixels. The last one is cached while its transforms.json is unchanged.

    nerfstudio makes several dataparsers in one command; the pixels are read once. Raises UserError for a folder that
    cannot be used, or for a change that leads to impossible intrinsics. The scene does not depend on `length_factor`.
    """
    root = scan_root(data)
    scan = read_scan(root)
    key = (root, (root / "transforms.json").stat().st_mtime_ns)
    if key not in _remembered:
        _remembered.clear()
        samples = build_samples(scan)
        _remembered[key] = {_AS_IT_IS: LoadedScan(scan, samples, normalisation(scan, samples))}
    loaded, wanted = _remembered[key], (intrinsics_change, length_factor)
    if wanted not in loaded:
        changed = scan.with_intrinsics_change(intrinsics_change) if intrinsics_change else scan
        _require_possible(changed)
        changed, samples = changed.scaled(length_factor), loaded[_AS_IT_IS].samples
        loaded[wanted] = LoadedScan(changed, samples, normalisation(changed, samples))
    return loaded[wanted]


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
