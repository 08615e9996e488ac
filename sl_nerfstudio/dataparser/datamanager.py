"""Batches of rays with their measurements, directly from the table of pixels."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import tyro
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader, RandIndicesEvalDataloader
from torch import Tensor

from sl_nerfstudio.dataparser.dataparser import SLDataParser, SLDataParserConfig
from sl_nerfstudio.dataparser.dataset import SLDataset
from sl_nerfstudio.dataparser.pixel_sampler import SLPixelSampler
from sl_nerfstudio.dataparser.samples import PixelBatch, PixelSamples
from sl_nerfstudio.dataparser.scene_rays import SceneRays
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.spacing import evenly_spaced

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
    if off, each batch is copied there, for which every step waits."""

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

    def __init__(self, config: SLDataManagerConfig, **kwargs: Any) -> None:
        if not isinstance(config.dataparser, SLDataParserConfig):
            raise UserError(
                f"{type(config.dataparser).__name__} does not describe a projector: this method trains on scan folders "
                "only. Leave the dataparser out, or name `sl-data`."
            )
        super().__init__(config, **kwargs)

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
        self.train_pixel_sampler = SLPixelSampler(self._samples, self.config.train_num_rays_per_batch, held_out=False)
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
        """At most `count` of one frame's held-out pixels, evenly spread; possibly none."""
        index = self._samples.held_out_of(frame)
        if len(index) > count:
            index = index[torch.from_numpy(evenly_spaced(len(index), count)).to(index.device)]
        return self._rays_and_batch(self._samples.at(index))

    def stand_at(self, T_scene_camera: Float[Tensor, "n 4 4"]) -> None:
        """Use refined poses for all cameras and rays, and mark them, so that the model does not correct them again.

        nerfstudio's exporters and viewer use the poses of the data sets' cameras without corrections.
        """
        T_scene_camera = T_scene_camera.detach().to(self.device, torch.float32)
        outputs = (self.train_dataparser_outputs, self.eval_dataset._dataparser_outputs)
        loaders = [getattr(self, name, None) for name in ("fixed_indices_eval_dataloader", "eval_dataloader")]
        for holder in (*outputs, self.train_dataset, self.eval_dataset, *filter(None, loaders)):
            _stand_at(holder.cameras, T_scene_camera)
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


def _stand_at(cameras: Cameras, T_scene_camera: Float[Tensor, "n 4 4"]) -> None:
    cameras.camera_to_worlds = T_scene_camera[:, :3].to(cameras.camera_to_worlds)
    cameras.metadata = {**(cameras.metadata or {}), "sl_refined": torch.ones_like(cameras.width, dtype=torch.bool)}
