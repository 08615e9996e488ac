"""The link between nerfstudio's commands and the model: reproducible steps, held-out evaluation, refined poses."""

import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
import tyro
import xatlas
from jaxtyping import Float, Int
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils import comms
from torch import Tensor
from torch.nn import functional as F
from torchvision.utils import save_image

from sl_nerfstudio.console import command, next_steps, paragraph, short_path, track
from sl_nerfstudio.dataparser.datamanager import SLDataManager
from sl_nerfstudio.dataparser.dataparser import require_same_scan
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.texture import MANY_CHARTS, draw_triangles, laid_out
from sl_nerfstudio.model.loop import SLTrainer
from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.run_files import (
    INTERRUPTION,
    SCAN_KEY,
    SETTINGS_KEY,
    as_tensor,
    as_text,
    watch_step,
    whole_command,
)
from sl_nerfstudio.model.viewer import SceneView
from sl_nerfstudio.parallel import compiled_range, torch_on_one_thread

# `ns-export` without a GPU: what takes hours there in nerfstudio, in a second.
#
# For its default `--texture-method nerf`, nerfstudio compares every pixel of the texture with every triangle of the
# mesh: with its defaults (2048 x 2048 pixels, 50,000 triangles) hours without a GPU. Here each triangle is drawn into
# the texture. nerfstudio offers no way to choose another function, so it is replaced, when `ns-export` opens a run.

_OUTSIDE = 10.0  # scene units: rays of pixels without a triangle start here and lead away from the scene

Unwrapped = tuple[Float[Tensor, "faces 3 2"], Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]


def unwrap_mesh_with_xatlas(
    vertices: Float[Tensor, "vertices 3"],
    faces: Int[Tensor, "faces 3"],
    vertex_normals: Float[Tensor, "vertices 3"],
    num_pixels_per_side: int = 1024,
    num_faces_per_barycentric_chunk: int = 10,
) -> Unwrapped:
    """Stand-in for nerfstudio's function of this name (exporter/texture_utils.py, 1.1.5): same arguments, same result.

    Returns the texture coordinates of every face's corners, and origin and unit direction (against the normal) of the
    ray of every texture pixel. Pixels that no triangle covers get a ray that misses the scene; nerfstudio gives them
    the ray of some triangle far away. The last argument has no meaning here.
    """
    v, f, n = (x.detach().cpu().numpy() for x in (vertices, faces, vertex_normals))
    area = 0.5 * np.linalg.norm(np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]]), axis=1).sum()
    charts = laid_out(v, f, n, float(area) / MANY_CHARTS, xatlas.PackOptions())
    corner_uv = charts.uv[charts.corners]
    triangle, weights = draw_triangles(corner_uv.astype(np.float64), num_pixels_per_side)
    origins = np.full((*triangle.shape, 3), _OUTSIDE, np.float32)
    directions = np.ones_like(origins)
    _write_rays(len(triangle), triangle, weights, f, v, n, origins, directions)
    rays = [torch.from_numpy(x).to(vertices.device) for x in (origins, directions)]
    return torch.from_numpy(corner_uv).to(vertices.device), rays[0], F.normalize(rays[1], dim=-1)


@compiled_range
def _write_rays(first, last, triangle, weights, faces, vertices, normals, origins, directions):
    """Fill origins and directions (h, w, 3) of the pixels that a triangle covers, in the rows of a range."""
    for row in range(first, last):
        for column in range(triangle.shape[1]):
            face = triangle[row, column]
            if face < 0:
                continue
            a, b, c = faces[face]
            x, y, z = weights[row, column]
            for k in range(3):
                origins[row, column, k] = x * vertices[a, k] + y * vertices[b, k] + z * vertices[c, k]
                directions[row, column, k] = -(x * normals[a, k] + y * normals[b, k] + z * normals[c, k])


def quicken_exporters() -> None:
    """Let `ns-export` find a texture's rays by drawing triangles; does nothing in other commands.

    Torch, and open3d's Poisson reconstruction, get one thread: theirs wait for each other in loops. Beside other work,
    20,000 points at depth 6 took more than 30 s with four threads instead of 0.5, and the rays of 22 frames 27 s.
    """
    exporter: Any = sys.modules.get("nerfstudio.scripts.exporter")
    if exporter is None:
        return
    torch_on_one_thread()
    exporter.texture_utils.unwrap_mesh_with_xatlas = unwrap_mesh_with_xatlas
    meshes = exporter.o3d.geometry.TriangleMesh
    poisson = meshes.create_from_point_cloud_poisson
    if not isinstance(poisson, partial):
        meshes.create_from_point_cloud_poisson = partial(poisson, n_threads=1)


_WELL_DECODED = 0.8  # share of the pixels with the pattern; above it, decoding again changed poses by less than a half
_HELD_OUT_PIXELS = 4096  # of one frame, at most: enough for a median to two digits


@dataclass
class SLPipelineConfig(VanillaPipelineConfig):
    """The pixels of a scan, and the model that is fitted to them."""

    _target: type = field(default_factory=lambda: SLPipeline)
    scan_fingerprint: tyro.conf.Suppress[str | None] = None
    """Which scan the run was trained on, set when the run begins."""
    settings_fingerprint: tyro.conf.Suppress[str | None] = None
    """With which settings, likewise; the checkpoints of a run have the same two."""

    def setup(self, **kwargs: Any) -> "SLPipeline":
        """The pipeline, for nerfstudio's commands: faults are messages, and a signal is no traceback."""
        if kwargs.get("test_mode", "val") != "val":
            INTERRUPTION.install()
            quicken_exporters()
        with faults_as_messages():
            return SLPipeline(self, **kwargs)


class SLPipeline(VanillaPipeline):
    """nerfstudio's pipeline with six differences.

    - The random numbers of a training step depend only on the seed and the step: a resumed run continues as an
      uninterrupted one would.
    - Evaluation uses held-out pixels of every frame, not whole images that were used for training.
    - After a checkpoint is loaded for viewing or export, cameras are at their refined poses.
    - The viewer shows the scan (viewer.py), and at the end of training the next commands are printed.
    - On a GPU, kernels compute the losses of a step (kernel_step.py).
    - Several processes average their gradients without DistributedDataParallel (loop.py).
    """

    config: SLPipelineConfig
    datamanager: SLDataManager

    def __init__(
        self, config: SLPipelineConfig, device: str | torch.device, world_size: int = 1, **kwargs: Any
    ) -> None:
        super().__init__(config, str(device), world_size=1, **kwargs)
        self.world_size = world_size
        self._seed = torch.initial_seed()
        self.register_buffer(SCAN_KEY, as_tensor(config.scan_fingerprint))
        self.register_buffer(SETTINGS_KEY, as_tensor(config.settings_fingerprint))
        self.scene_view = SceneView(self._sl_model)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """The model's callbacks, with those of this pipeline before and after them."""
        before, after = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        trainer = cast(SLTrainer, training_callback_attributes.trainer)
        return [
            TrainingCallback([before], trainer.begin_step),
            TrainingCallback([before], self._seed_step),
            *super().get_training_callbacks(training_callback_attributes),
            TrainingCallback([after], self._update_viewer),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], self._say_what_next, kwargs={"trainer": trainer}),
        ]

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of a step; by kernels without outputs, where there are kernels for all of it."""
        sampler, model = self.datamanager.train_pixel_sampler, self._sl_model
        if not model.has_kernels:
            return super().get_train_loss_dict(step)
        from sl_nerfstudio.model.kernel_step import kernel_step  # imports Triton

        self.datamanager.train_count += 1
        return {}, *kernel_step(model, sampler.samples, sampler.choose(step), model.renders_now)

    @property
    def _sl_model(self) -> SLModel:
        return cast(SLModel, self.model)

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load weights; unless training continues (`test_mode` "val"), move the cameras to their refined poses.

        Weights of another run, or of another scan, end the command with a message.
        """
        if self.test_mode != "val":
            loaded = self.datamanager.dataparser.loaded
            with faults_as_messages():
                require_together(self.config, loaded_state, loaded.scan.root, loaded.fingerprint)
        super().load_pipeline(loaded_state, step)
        self.get_buffer(SCAN_KEY).copy_(as_tensor(self.config.scan_fingerprint))
        self.get_buffer(SETTINGS_KEY).copy_(as_tensor(self.config.settings_fingerprint))
        if self.test_mode != "val":
            self.datamanager.stand_at(self._sl_model.poses_scene()[0])

    @torch.no_grad()
    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, float]:
        """Means over the frames of the metrics of their held-out pixels, all finite; `ns-eval` writes them.

        With `output_path`, whole frames are also rendered and saved there.
        """
        self.eval()
        frames = range(len(self.datamanager.train_dataset))
        per_frame = [self._held_out_metrics(frame) for frame in track(frames, "Evaluating")]
        if output_path is not None:
            self._save_images(output_path)
        self.train()
        return mean_over_frames(per_frame, get_std)

    def _held_out_metrics(self, frame: int) -> dict[str, float]:
        rays, batch = self.datamanager.held_out_batch(frame, _HELD_OUT_PIXELS)
        if len(rays) == 0:
            return {}
        size = self.model.config.eval_num_rays_per_chunk
        chunks = [self.model(rays[first : first + size]) for first in range(0, len(rays), size)]
        outputs = {name: torch.cat([chunk[name] for chunk in chunks]) for name in chunks[0]}
        return {name: float(value) for name, value in self.model.get_metrics_dict(outputs, batch).items()}

    def _save_images(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        names = [frame.name for frame in self.datamanager.dataparser.loaded.scan.frames]
        loader = zip(names, self.datamanager.fixed_indices_eval_dataloader, strict=True)
        for name, (camera, batch) in track(loader, "Rendering", len(names)):
            outputs = self.model.get_outputs_for_camera(camera)
            for key, image in self.model.get_image_metrics_and_images(outputs, batch)[1].items():
                save_image(image.permute(2, 0, 1).cpu(), folder / f"{name}_{key}.png")

    def _seed_step(self, step: int) -> None:
        seed = (self._seed * 1_000_003 + step) % 2**63
        if torch.device(self.device).type == "cpu":
            torch.default_generator.manual_seed(seed)  # without a note, for each step, to seed a GPU if one is used
        else:
            torch.manual_seed(seed)

    def _update_viewer(self, step: int) -> None:
        self.scene_view.update()
        watch_step(self._sl_model)

    def _say_what_next(self, step: int, trainer: Any) -> None:
        if comms.is_main_process() and not whole_command():
            decoded = self.datamanager.samples.decoded_share
            config = trainer.config.get_base_dir() / "config.yml"
            print(what_next(config, self.datamanager.get_datapath(), decoded), flush=True)


@contextmanager
def faults_as_messages() -> Iterator[None]:
    """In a command of nerfstudio: an error that a user can fix is printed, and ends the process with status 1."""
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def require_together(config: SLPipelineConfig, weights: Mapping[str, Any], root: Path, scan: str) -> None:
    """Raise UserError unless config.yml, the checkpoint's weights and the scan in `root` are of one run.

    `scan` is the fingerprint of the scan that is there.
    """
    trained_on, settings = as_text(weights.get(SCAN_KEY)), as_text(weights.get(SETTINGS_KEY))
    if (trained_on, settings) != (config.scan_fingerprint, config.settings_fingerprint):
        other = "the scan" if settings == config.settings_fingerprint else "the settings"
        raise UserError(
            f"config.yml and the checkpoint of this run do not belong together: {other} they name are not the same\n"
            "    cause:  one of them was exchanged, edited or written by another version of this package\n"
            "    remedy: put back the file that belongs there, or train again under another name"
        )
    require_same_scan(root, scan, config.scan_fingerprint, "this run")


_REDECODED = "redecoding.json"  # in scans of sl-redecode


def what_next(config: Path, scan: Path, decoded: float) -> str:
    """Where the result is, and the commands to continue with; `decoded` is a share of the pixels with the pattern."""
    settings, data, poses = short_path(config), short_path(scan), "refined/transforms.json"
    steps = [
        command("ns-viewer", "--load-config", settings, "--viewer.websocket-host", "127.0.0.1"),
        command("sl-export", "--load-config", settings, "--output", "mesh.ply", "--poses", "refined"),
        command("sl-eval", "--mesh", "mesh.ply", "--data", data, "--poses", poses, "--report", "report.html"),
    ]
    parts = [paragraph("result", f"{settings.parent}")]
    if decoded < _WELL_DECODED and not (scan / _REDECODED).exists():  # a second time adds little
        share = f"{decoded:.0%} of the pixels with the pattern"
        again = command("sl-redecode", "--load-config", settings, "--output", data.with_name(f"{data.name}-again"))
        parts.append(paragraph("decoded", f"{share}; this surface shows how to decode more, which helps the poses:"))
        parts.append(again)
    return "\n".join([*parts, next_steps(steps)])


def mean_over_frames(per_frame: list[dict[str, float]], with_std: bool) -> dict[str, float]:
    """Mean, and on request `<name>_std`, of each metric over the frames that have a finite value of it.

    The standard deviation of a single value is 0; nerfstudio's would be NaN, which JSON does not allow.
    """
    result: dict[str, float] = {}
    for name in dict.fromkeys(name for metrics in per_frame for name in metrics):
        values = [metrics[name] for metrics in per_frame if math.isfinite(metrics.get(name, math.nan))]
        if not values:
            continue
        mean = sum(values) / len(values)
        result[name] = mean
        if with_std:
            result[f"{name}_std"] = math.sqrt(sum((v - mean) ** 2 for v in values) / max(len(values) - 1, 1))
    return result
