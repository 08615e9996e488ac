"""Batches of rays with their measurements, directly from the table of pixels."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Float, Float32, Int, Shaped, UInt8
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.dataparser.dataparser import (
    PixelBatch,
    PixelSamples,
    SLDataParser,
    SLDataParserConfig,
    held_out_pixels,
)
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.geometry.triangulation import pixel_rays
from sl_nerfstudio.scan import Frame, Scan

# Whole frames in nerfstudio's form, for evaluation, rendering and the viewer. Each is read when it is needed.


class SLDataset(InputDataset):
    """Frames of a scan, at the resolution of `cameras`.

    Besides `image` (RGB, [0, 1]) an item holds, each as (h, w, channels): `pattern` in [0, 1], `coords` in pattern
    pixels (NaN where not decoded), and the flags `mask`, `decoded` and `held_out`.
    """

    @property
    def scan(self) -> Scan:
        """The scan behind the data set."""
        return self.metadata["sl_scan"]

    def get_numpy_image(self, image_idx: int) -> UInt8[ndarray, "h w 3"]:
        """The captured image as 8-bit RGB, from any bit depth and number of channels in the file."""
        return (self._image(image_idx) * 255 + 0.5).astype(np.uint8)

    def get_image_float32(self, image_idx: int) -> Float[Tensor, "h w 3"]:
        """The captured image in [0, 1] with the file's full bit depth."""
        return torch.from_numpy(self._image(image_idx))

    def get_metadata(self, data: dict) -> dict[str, Tensor]:
        """The data of the pixels other than their colour."""
        index = data["image_idx"]
        frame = self.scan.frames[index]
        coords = frame.read_coords()
        mask = all_finite(coords) if frame.mask_path is None else frame.read_mask()
        images = {
            "coords": coords,
            "pattern": frame.read_pattern()[..., None],
            "mask": mask[..., None],
            "decoded": (all_finite(coords) & mask)[..., None],
            "held_out": (held_out_pixels(index, *mask.shape) & mask)[..., None],
        }
        return {name: torch.from_numpy(self._resized(index, image)) for name, image in images.items()}

    def _image(self, index: int) -> Float32[ndarray, "h w 3"]:
        return self._resized(index, _rgb(self.scan.frames[index]))

    def _resized(self, index: int, image: Shaped[ndarray, "h w c"]) -> Shaped[ndarray, "h2 w2 c"]:
        """An image at the camera's resolution, by nearest pixel: coordinates must not be averaged across edges."""
        h, w = int(self.cameras.height[index]), int(self.cameras.width[index])
        rows, columns = _nearest(h, image.shape[0]), _nearest(w, image.shape[1])
        return np.ascontiguousarray(image[rows[:, None], columns[None, :]])


def _nearest(size: int, source: int) -> ndarray:
    return ((np.arange(size) + 0.5) * source / size).astype(np.int64)


def _rgb(frame: Frame) -> Float32[ndarray, "h w 3"]:
    stored = frame.read_image()
    image = stored.astype(np.float32) / np.iinfo(stored.dtype).max
    if image.ndim == 2:
        image = image[..., None]
    return image.repeat(3, -1) if image.shape[-1] == 1 else image


# Random pixels for a step of training or evaluation.

_STRIDE = 1_000_003  # a prime, so that seeds of neighbouring runs do not share the batches of neighbouring steps


class SLPixelSampler:
    """Draws `num_rays_per_batch` pixels; nerfstudio's exporters set that number from outside.

    The batch of a step depends only on the seed and the step, so that a resumed run continues like an uninterrupted
    one. A second call for the same step (as by `ns-export pointcloud`) draws other pixels.
    """

    def __init__(self, samples: PixelSamples, num_rays_per_batch: int, held_out: bool) -> None:
        """The seed is torch's, which nerfstudio sets from `--machine.seed` and the rank of the process."""
        self.samples = samples
        self.num_rays_per_batch = num_rays_per_batch
        self.held_out = held_out
        self.generator = torch.Generator(samples.device)
        self._seed = torch.initial_seed() + int(held_out)
        self._step: int | None = None

    def begin(self, step: int) -> None:
        """Seed the draws of a step, unless that was done."""
        if step != self._step:
            self._step = step
            self._seed_draws(step)

    def sample(self, step: int) -> PixelBatch:
        """Pixels for a step."""
        self.begin(step)
        return self.samples.at(self._draw())

    def choose(self, step: int) -> Int[Tensor, "n"]:
        """Pixels for a step: indices of the table, or on a GPU of those not held out (`PixelSamples.training`)."""
        self.begin(step)
        if self.samples.device.type == "cpu":
            return self._draw()
        return self.samples.randint(len(self.samples.training), self.num_rays_per_batch, self.generator)

    def _seed_draws(self, step: int) -> None:
        self.generator.manual_seed((self._seed * _STRIDE + step) % 2**63)

    def _draw(self) -> Int[Tensor, "n"]:
        if self.samples.device.type == "cpu" or self.held_out:
            return self.samples.draw(self.num_rays_per_batch, self.generator, self.held_out)
        return self.samples.draw_without_waiting(self.num_rays_per_batch, self.generator)


class CopiedPixelSampler(SLPixelSampler):
    """Draws training pixels from a table that stays in the host's memory: what the GPU sees is one batch of it.

    While a step runs, the pixels of the next one are drawn and copied. They are those of `SLPixelSampler`, always in
    the same memory of the GPU, so that a CUDA graph can read them; a second call for a step has the same ones.
    """

    def __init__(self, table: PixelSamples, num_rays_per_batch: int, device: torch.device | str) -> None:
        super().__init__(table, num_rays_per_batch, held_out=False)
        self._table = table
        self._copies = torch.cuda.Stream(device)
        rows = torch.zeros(num_rays_per_batch, table.records.shape[1], dtype=torch.uint8, device=device)
        none = torch.zeros(0, dtype=torch.long, device=device)
        self._arriving, self._arriving_step = torch.zeros_like(rows), -1
        self.samples = PixelSamples(rows, none, none)
        self._all = torch.arange(num_rays_per_batch, device=device)

    def begin(self, step: int) -> None:
        """Make the pixels of a step those that the GPU sees, and copy those of the next one beside it."""
        if step == self._step:
            return
        if step != self._arriving_step:
            self._copy(step)
        steps = torch.cuda.current_stream(self.samples.device)
        steps.wait_stream(self._copies)
        self.samples.records.copy_(self._arriving)
        self._copies.wait_stream(steps)
        self._copy(step + 1)
        self._step = step

    def choose(self, step: int) -> Int[Tensor, "n"]:
        """All pixels that the GPU sees, which are those of the step."""
        self.begin(step)
        return self._all

    def _draw(self) -> Int[Tensor, "n"]:
        return self._all

    def _copy(self, step: int) -> None:
        self._seed_draws(step)
        index = self._table.draw(len(self._all), self.generator)
        # torch reuses pinned memory only after the copy from it
        rows = torch.empty(self._arriving.shape, dtype=torch.uint8, device="cpu", pin_memory=True)
        torch.index_select(self._table.records, 0, index, out=rows)
        with torch.cuda.stream(self._copies):
            self._arriving.copy_(rows, non_blocking=True)
        self._arriving_step = step


# Rays of camera pixels in the normalised scene.


class SceneRays:
    """Makes rays from one pose for each frame, on the device that holds the poses.

    They equal those of nerfstudio's `Cameras.generate_rays`, without the work for camera types that cannot occur here.
    """

    def __init__(self, scan: Scan, T_scene_camera: Float[Tensor, "n 4 4"], refined: bool = False) -> None:
        """`refined` marks the rays, so that the model does not correct them again."""
        self._cameras = Intrinsics.of([frame.camera for frame in scan.frames]).to(T_scene_camera.device)
        self._T_scene_camera = T_scene_camera
        self._refined = refined

    def __call__(self, frame: Int[Tensor, "n"], uv: Float[Tensor, "n 2"]) -> RayBundle:
        """Rays through pixels `uv` of the given frames."""
        cameras = self._cameras[frame]
        origins, directions = pixel_rays(cameras, self._T_scene_camera[frame], uv)
        view = frame[:, None]
        metadata = {"sl_view": view, "sl_uv": uv, "directions_norm": torch.ones_like(origins[:, :1])}
        if self._refined:
            metadata["sl_refined"] = torch.ones_like(view, dtype=torch.bool)
        return RayBundle(
            origins=origins,
            directions=directions,
            pixel_area=1 / cameras.params[:, :2].prod(-1, keepdim=True),
            camera_indices=view,
            metadata=metadata,
        )


Batch = dict[str, Tensor]
_BYTES_PER_PIXEL = 24  # of the table, with the index of pixels that are not held out


@dataclass
class SLDataManagerConfig(VanillaDataManagerConfig):
    """Masked pixels of all frames, drawn uniformly; a few per cent are held out for evaluation."""

    _target: type = field(default_factory=lambda: SLDataManager)
    dataparser: AnnotatedDataParserUnion = field(default_factory=SLDataParserConfig)
    """Must be `sl-data`: other data sets have no projector."""
    train_num_rays_per_batch: int = 1024
    """Pixels in a training step."""
    eval_num_rays_per_batch: int = 1024
    """Held-out pixels in an evaluation during training."""
    images_on_gpu: bool = True
    """Keep the table of all pixels on the GPU (24 bytes per pixel) if half of its free memory is enough; otherwise, or
    if off, each batch is copied there beside the step before."""

    # nerfstudio's own settings for choosing images and pixels, which have no meaning here.
    masks_on_gpu: tyro.conf.Suppress[bool] = False
    train_num_images_to_sample_from: tyro.conf.Suppress[int] = -1
    train_num_times_to_repeat_images: tyro.conf.Suppress[int] = -1
    eval_num_images_to_sample_from: tyro.conf.Suppress[int] = -1
    eval_num_times_to_repeat_images: tyro.conf.Suppress[int] = -1
    eval_image_indices: tyro.conf.Suppress[tuple[int, ...] | None] = None
    collate_fn: tyro.conf.Suppress[Any] = None
    camera_res_scale_factor: tyro.conf.Suppress[float] = 1.0
    patch_size: tyro.conf.Suppress[int] = 1
    pixel_sampler: tyro.conf.Suppress[PixelSamplerConfig] = field(default_factory=PixelSamplerConfig)


class SLDataManager(VanillaDataManager[SLDataset]):
    """Draws pixels, makes their rays from the starting poses, and provides whole frames for evaluation.

    A batch holds `indices` [n, 3] (frame, row, column), `coords` [n, 2] (pattern pixels, NaN where not decoded),
    `decoded` [n, 1], `pattern` [n, 1], `image` [n, 3] (the pattern, grey) and `mask` [n, 1]. The rays' metadata hold
    `sl_view` [n, 1] (frame) and `sl_uv` [n, 2] (camera pixel coordinates); after `stand_at` also the flag `sl_refined`.
    """

    config: SLDataManagerConfig
    dataparser: SLDataParser
    train_pixel_sampler: SLPixelSampler
    eval_pixel_sampler: SLPixelSampler

    @property
    def samples(self) -> PixelSamples:
        """All masked pixels of the scan."""
        return self.dataparser.loaded.samples

    def create_train_dataset(self) -> SLDataset:
        """All frames."""
        return SLDataset(self.train_dataparser_outputs)

    def create_eval_dataset(self) -> SLDataset:
        """All frames again: poses are refined frame by frame, so only pixels can be held out."""
        return SLDataset(self.dataparser.get_dataparser_outputs(split=self.test_split))

    def setup_train(self) -> None:
        """Prepare the drawing of training batches."""
        self._samples = self.samples.to(self.device) if self._table_on_gpu() else self.samples
        count, device = self.config.train_num_rays_per_batch, torch.device(self.device)
        # nerfstudio's exporters set the number of pixels from outside, and ask for many batches of one step
        if self.test_mode == "val" and self._samples.device.type != device.type:
            self.train_pixel_sampler = CopiedPixelSampler(self._samples, count, device)
        else:
            self.train_pixel_sampler = SLPixelSampler(self._samples, count, held_out=False)
        loaded = self.dataparser.loaded
        poses = torch.from_numpy(loaded.S_scene_world.poses(loaded.scan.poses.T_world_camera)).float()
        self.scene_rays = SceneRays(loaded.scan, poses.to(self.device))

    def _table_on_gpu(self) -> bool:
        if not self.config.images_on_gpu or torch.device(self.device).type != "cuda":
            return False
        return _BYTES_PER_PIXEL * len(self.samples) < 0.5 * torch.cuda.mem_get_info(self.device)[0]

    def setup_eval(self) -> None:
        """Prepare the drawing of evaluation batches and whole frames."""
        self.eval_pixel_sampler = SLPixelSampler(self._samples, self.config.eval_num_rays_per_batch, held_out=True)
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(self.eval_dataset, device=self.device)
        self.eval_dataloader = RandIndicesEvalDataloader(self.eval_dataset, device=self.device)

    def next_train(self, step: int) -> tuple[RayBundle, Batch]:
        """Pixels to train on; the choice depends only on the seed and on `step`."""
        self.train_count += 1
        return self._rays_and_batch(self.train_pixel_sampler.sample(step))

    def next_eval(self, step: int) -> tuple[RayBundle, Batch]:
        """Held-out pixels of all frames."""
        self.eval_count += 1
        return self._rays_and_batch(self.eval_pixel_sampler.sample(step))

    def held_out_batch(self, frame: int, count: int) -> tuple[RayBundle, Batch]:
        """Return up to `count` of one frame's held-out pixels, evenly spread; possibly none."""
        return self._rays_and_batch(self._samples.held_out_of(frame, count))

    def stand_at(self, T_scene_camera: Float[Tensor, "n 4 4"]) -> None:
        """Use refined poses for all cameras and rays, and mark them, so that the model does not correct them again.

        nerfstudio's exporters and viewer use the poses of the data sets' cameras without corrections.
        """
        T_scene_camera = T_scene_camera.detach().to(self.device, torch.float32)
        outputs = (self.train_dataparser_outputs, self.eval_dataset._dataparser_outputs)
        loaders = [getattr(self, name, None) for name in ("fixed_indices_eval_dataloader", "eval_dataloader")]
        for holder in (*outputs, self.train_dataset, self.eval_dataset, *filter(None, loaders)):
            cameras = holder.cameras
            cameras.camera_to_worlds = T_scene_camera[:, :3].to(cameras.camera_to_worlds)
            refined = torch.ones_like(cameras.width, dtype=torch.bool)
            cameras.metadata = {**(cameras.metadata or {}), "sl_refined": refined}
        if hasattr(self, "scene_rays"):
            self.scene_rays = SceneRays(self.dataparser.loaded.scan, T_scene_camera, refined=True)

    def get_datapath(self) -> Path:
        """The scan folder."""
        return self.dataparser.loaded.scan.root

    def _rays_and_batch(self, pixels: PixelBatch) -> tuple[RayBundle, Batch]:
        pixels = pixels.to(self.device)
        pattern = pixels.pattern[:, None]
        batch = {
            "indices": torch.stack([pixels.frame, pixels.row, pixels.column], -1),
            "coords": pixels.coords,
            "decoded": pixels.decoded[:, None],
            "pattern": pattern,
            "image": pattern.expand(-1, 3),
            "mask": torch.ones_like(pattern, dtype=torch.bool),
        }
        return self.scene_rays(pixels.frame, pixels.uv), batch
