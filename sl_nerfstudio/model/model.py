"""The nerfstudio model: a signed distance field, and the poses of the devices that saw it."""

import sys
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
import tyro
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.base_model import Model, ModelConfig
from numpy import ndarray
from torch import Tensor, nn

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.parameters import RefinePoses, SelfCalibration, constrained
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.field.field import CachedGrid, FieldConfig, SDFField
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, inverse, rotate
from sl_nerfstudio.model.messages import (
    contradiction_message,
    departed_message,
    modes_message,
    poses_message,
    unplaced_message,
)
from sl_nerfstudio.model.outputs import (
    History,
    MeasuredCoordinates,
    fit_metrics,
    measure_decoding,
    picture_outputs,
    ray_outputs,
    seen_by_rays,
)
from sl_nerfstudio.model.pose_refinement import PriorConfig, adjust_scan, scene_rig, sigmas_in_scan_units
from sl_nerfstudio.model.poses import NOT_STATED, FrameTransforms, PoseOptimizerConfig, PoseParameters, ProjectorMoves
from sl_nerfstudio.parallel import one_torch_thread
from sl_nerfstudio.rendering.direct_losses import (
    DecodingNoise,
    MeasuredRays,
    direct_losses,
    field_losses,
    random_points,
)
from sl_nerfstudio.rendering.losses import (
    AnnealingConfig,
    LossConfig,
    coordinate_loss,
    kappa_at,
    level_weights_at,
    pattern_loss,
    surface_width_at,
)
from sl_nerfstudio.rendering.renderer import Renderer, SamplingConfig
from sl_nerfstudio.review.verdict import departed_frames
from sl_nerfstudio.scan import Scan

RECOMMENDED_STEPS = {"sl-neus": 1000, "sl-neus-paper": 10_000}  # by method; the paper's is its own
_REFRESH_EVERY = 20  # steps between updates of the cached grid


@dataclass
class SLModelConfig(ModelConfig):
    """A signed distance field seen as projector coordinates and pattern intensity, with the poses of both devices."""

    _target: type = field(default_factory=lambda: SLModel)
    refine_poses: RefinePoses = "free"
    """What is refined: `free` (camera and projector of every frame), `rigid-rig` (frames, and one relative pose for
    all of them), `known-rig` (frames only), `static-projector` (frames, and a projector that never moves), `off`."""
    pose_method: Literal["adjust", "render", "render-independently"] = "adjust"
    """How poses are refined: `adjust` (bundle adjustment before the first step), `render` (only the rendering losses),
    `render-independently` (the same, with each device independent of the others)."""
    camera_optimizer: PoseOptimizerConfig = NOT_STATED
    """How the rendering losses move the cameras, if `pose_method` lets them."""
    projector_optimizer: PoseOptimizerConfig = NOT_STATED
    """The same for the projectors."""
    refine_intrinsics: bool = False
    """If the captures contradict focal lengths and principal points, change these before training, provided that
    held-out pixels then agree better; the scan folder is not changed."""
    warm_start: float = 0.15
    """Share of the run during which the field is only fitted to triangulated points, without rendering."""
    sdf: FieldConfig = field(default_factory=FieldConfig)
    """The signed distance field."""
    losses: LossConfig = field(default_factory=LossConfig)
    """Weights of the losses."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """Samples along rays."""
    annealing: AnnealingConfig = field(default_factory=AnnealingConfig)
    """Sharpness and level of detail over the run."""
    prior: PriorConfig = field(default_factory=PriorConfig)
    """Uncertainty of the intrinsics."""
    adjustment: AdjustmentSettings = field(default_factory=AdjustmentSettings)
    """Settings of the bundle adjustment."""
    schedule_iterations: tyro.conf.Suppress[int] = 1000
    """Number of annealing steps; the trainer sets it to the length of the run."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside training."""

    # nerfstudio's own settings that have no meaning here; the collider must be off, rays are clipped to a unit sphere.
    enable_collider: tyro.conf.Suppress[bool] = False
    collider_params: tyro.conf.Suppress[dict[str, float] | None] = None
    loss_coefficients: tyro.conf.Suppress[dict[str, float]] = field(default_factory=dict)
    prompt: tyro.conf.Suppress[str | None] = None

    @property
    def sdf_field(self) -> FieldConfig:
        """`sdf` under the name by which `ns-export marching-cubes` asks for it.

        Only that command does. Without a GPU it would end in a traceback: here it ends with a sentence and status 1.
        """
        if not torch.cuda.is_available():
            print(
                "error: ns-export marching-cubes needs a GPU with CUDA. `sl-export --load-config config.yml --output "
                "mesh.ply` does the same on any machine, in the scan's unit and cut to what was observed.",
                file=sys.stderr,
            )
            raise SystemExit(1)
        return self.sdf

    @property
    def adjusts_poses(self) -> bool:
        """Whether poses are adjusted together before the first step."""
        return self.refine_poses != "off" and self.pose_method == "adjust"

    @property
    def free_to_render(self) -> tuple[bool, bool]:
        """Whether rendering losses may move cameras, and projectors, if their optimisers are not off."""
        may = self.refine_poses != "off" and self.pose_method != "adjust"
        return may, may and self.refine_poses not in ("known-rig", "static-projector")

    @property
    def moved_by_rendering(self) -> tuple[bool, bool]:
        """Whether the rendering losses move cameras, and whether they move projectors."""
        camera, projector = self.free_to_render
        return camera and self.camera_optimizer.used != "off", projector and self.projector_optimizer.used != "off"

    @property
    def renders_poses(self) -> bool:
        """Whether the rendering losses move poses."""
        return any(self.moved_by_rendering)


def paper_model() -> SLModelConfig:
    """The paper's model: initial sphere, independent poses by Adam, all levels, uniform samples, no direct terms."""
    return SLModelConfig(
        pose_method="render-independently",
        warm_start=0.0,
        losses=LossConfig(0.0, 0.05, 0.01, surface=0.0, free_space=0.0, coordinates_per_pixel=1000 / 65535),
        sampling=SamplingConfig(render_rays=2024, eikonal_points=4096, strategy="uniform", samples=64),
        annealing=AnnealingConfig("linear", coarse_to_fine=False),
    )


class SLModel(Model):
    """See docs/method.md. Lengths are in scene units; `poses` and `S_scene_world` convert to the scan's units."""

    config: SLModelConfig
    step_now: Tensor
    kappa_now: Tensor
    surface_width_now: Tensor
    noise_px: Tensor
    px_per_length: Tensor
    camera_params: Tensor
    projector_params: Tensor
    pattern: Tensor
    intrinsics_change: Tensor

    def __init__(
        self, config: SLModelConfig, scene_box: SceneBox, num_train_data: int, metadata: dict[str, Any], **kwargs: Any
    ) -> None:
        self.scan: Scan = metadata["sl_scan"]
        self.S_scene_world: Similarity = metadata["sl_S_scene_world"]
        super().__init__(config, scene_box, num_train_data, **kwargs)

    def populate_modules(self) -> None:
        """Create the field, the poses and the buffers that describe the devices."""
        super().populate_modules()
        self.field = SDFField(self.config.sdf)
        self.cache = CachedGrid()
        self._cache_is_old = False  # True after a checkpoint was loaded for inspection
        rig = scene_rig(self.scan, self.S_scene_world)
        self.device_poses = pose_parameters(self.config, rig.T_world_camera, rig.T_world_projector)
        self.measured = MeasuredCoordinates(self.scan)
        self._projector = Intrinsics.of(self.scan.projector)
        self._cameras = Intrinsics.of([frame.camera for frame in self.scan.frames])
        self.register_buffer("camera_params", self._cameras.params, persistent=False)
        self.register_buffer("projector_params", self._projector.params, persistent=False)
        self.register_buffer("pattern", torch.from_numpy(self.scan.read_pattern()).float(), persistent=False)
        # a checkpoint must hold more than weights: the step, for annealing; the decoding noise, measured once; and the
        # change of the intrinsics, so that a resumed run has the same devices
        self.register_buffer("step_now", torch.zeros((), dtype=torch.int64))
        self.register_buffer("noise_px", torch.ones(()))
        self.register_buffer("px_per_length", torch.tensor(float("nan")))
        change = torch.tensor(self.scan.intrinsics_change.values, dtype=torch.float64)
        self.register_buffer("intrinsics_change", change)
        # read by every step, on its device: the host sets them and need not wait
        self.register_buffer("kappa_now", torch.zeros((), dtype=torch.float64), persistent=False)  # per scene unit
        self.register_buffer("surface_width_now", torch.zeros((), dtype=torch.float64), persistent=False)
        self._set_scalars(0)
        self.register_load_state_dict_post_hook(_read_step)
        self.history_table = History(("loss", "coordinate_px", "pattern_cosine", "eikonal", "surface"))
        self.viewed_frame = 0

    # ---- for other parts of the package

    def poses_scene(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """Current poses of cameras and projectors in the scene."""
        with torch.no_grad():
            return self.device_poses()

    def poses(self) -> DevicePoses:
        """Current poses of all devices in the scan's world and units."""
        S = self.S_scene_world.inverse()
        camera, projector = self.poses_scene()
        return DevicePoses(S.poses(camera.cpu().numpy()), S.poses(projector.cpu().numpy()))

    def pose_sigma(self) -> Float[ndarray, "frames 4"] | None:
        """1 sigma per frame (see pose_refinement.sigmas_in_scan_units), or None if it was not estimated."""
        sigma = self.device_poses.sigma
        return None if bool(sigma.isnan().any()) else sigmas_in_scan_units(sigma, self.S_scene_world)

    @property
    def step(self) -> int:
        """The step of the training."""
        return self._step

    @property
    def cell(self) -> float:
        """Length of the field's finest cells, in the scan's unit; the scene's box is two scene units wide."""
        return 2 / self.config.sdf.max_resolution / self.S_scene_world.scale

    def joint_covariance(self) -> JointCovariance | None:
        """Covariance of all poses and the intrinsics in the scan's world and units; None if it was not estimated."""
        found = self.device_poses.joint_covariance()
        return None if found is None else found.mapped(self.S_scene_world.inverse())

    def unplaced(self) -> list[bool]:
        """Of each frame, whether it does not agree with the others, so that neither its poses nor their sigma hold."""
        return self.device_poses.unplaced.tolist()

    def self_calibration(self) -> SelfCalibration | None:
        """How well the intrinsics agree with the captures; None if poses were not adjusted."""
        return self.device_poses.self_calibration()

    def history(self) -> dict[str, list[float]]:
        """Convergence curves of the run, with the steps under `step`."""
        return self.history_table.curves()

    @torch.no_grad()
    def sdf(self, p_scene: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance in scene units."""
        return self.field.sdf(p_scene)

    @property
    def projector(self) -> Intrinsics:
        """The projector's intrinsics, batch ()."""
        return replace(self._projector, params=self.projector_params)

    @property
    def cameras(self) -> Intrinsics:
        """The cameras' intrinsics, batch (frames)."""
        return replace(self._cameras, params=self.camera_params)

    # ---- training

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """`table` and `mlp` of the field, and those poses that the rendering losses move."""
        steps = {"camera_opt": self.device_poses.camera_step, "projector_opt": self.device_poses.projector_step}
        return {
            "table": [self.field.encoding.table],
            "mlp": list(self.field.mlp.parameters()),
            **{name: [step] for name, step in steps.items() if step.requires_grad},
        }

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Annealing before every step; the trainer itself adjusts the poses before the first one."""
        return [TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.anneal)]

    def adjust_poses(self, samples: Any) -> str:
        """Before the first step: all poses together, if the settings say so. Returns what was found, in words."""
        said: list[str] = []
        c, rig = self.config, scene_rig(self.scan, self.S_scene_world)
        if c.adjusts_poses and len(self.scan.frames) > 1:
            found = adjust_scan(self.scan, self.S_scene_world, samples, c.refine_poses, c.prior, c.adjustment)
            rig = found.rig
            self.device_poses.note(found.sigma, found.factor, found.intrinsics, found.unplaced)
            cameras = [frame.camera for frame in self.scan.frames]
            names = [frame.name for frame in self.scan.frames]
            said += [poses_message(found), unplaced_message([names[k] for k in found.unplaced])]
            said.append(modes_message(found.modes, names))
            if found.intrinsics is not None:
                said.append(contradiction_message(found.intrinsics, cameras, self.scan.projector))
        if c.renders_poses:
            rig = constrained(c.refine_poses, rig)
        self.device_poses.rebase(rig.T_world_camera, rig.T_world_projector)
        said.append(departed_message(departed_frames(self.scan, self.poses())))
        return "\n".join(filter(None, said))

    def measure_noise(self, samples: Any) -> None:
        """Before the first step: how well the coordinates agree at the adjusted poses."""
        camera, projector = self.poses_scene()
        noise = measure_decoding(self.scan, samples, camera.cpu(), projector.cpu())
        self.noise_px.fill_(noise.px)
        self.px_per_length.fill_(noise.px_per_length)

    def anneal(self, step: int) -> None:
        """Set sharpness and level of detail for a step; called before each step, and when a checkpoint is loaded."""
        c = self.config
        self._set_step(step)
        uses_cache = self.training and c.sampling.strategy == "surface" and self._renders(step)
        if uses_cache and (not self.cache.is_filled or step % _REFRESH_EVERY == 0):
            self.cache.refresh(self.field)
        if self.training:  # training continues with the saved cache, so that a resumed run equals an uninterrupted one
            self._cache_is_old = False

    def _set_step(self, step: int) -> None:
        c = self.config
        self.step_now.fill_(step)
        self._set_scalars(step)
        self.field.encoding.set_level_weights(level_weights_at(c.annealing, c.sdf.levels, step, c.schedule_iterations))

    def _set_scalars(self, step: int) -> None:
        """What steps read on their device, and what the host knows of it."""
        c = self.config
        self._step = step
        self.kappa_now.fill_(kappa_at(c.annealing.kappa, step, c.schedule_iterations))
        if c.losses.direct:
            self.surface_width_now.fill_(surface_width_at(step, c.schedule_iterations))

    def update_to_step(self, step: int) -> None:
        """Called by nerfstudio before weights are loaded: sets the levels to those of the checkpoint's step."""
        self._set_step(max(step, 0))  # -1: the poses are adjusted, no step has been taken
        self._cache_is_old = True

    @property
    def operations_of_step(self) -> tuple[Any, ...]:
        """Equal for steps that do the same operations: all that changes otherwise is in tensors."""
        return self.renders_now, self.field.encoding.active

    @property
    def renders_now(self) -> bool:
        """Whether the current step renders rays; before, the field is only fitted to triangulated points."""
        return self._renders(self._step)

    @property
    def has_kernels(self) -> bool:
        """Whether there are kernels for a whole step: not for triangulated points from which poses learn."""
        return self.field.backend == "triton" and not (self.device_poses.move and self.config.losses.direct)

    def _renders(self, step: int) -> bool:
        return step >= self.config.warm_start * self.config.schedule_iterations

    @property
    def renderer(self) -> Renderer:
        """The field lit by the projector, at its current sharpness; outside training with an up-to-date cached grid."""
        if not self.training and (self._cache_is_old or not self.cache.is_filled):
            self.cache.refresh(self.field)
            self._cache_is_old = False
        return Renderer(self.field, self.cache, self.projector, self.pattern, self.config.sampling, self.kappa_now)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Rendered outputs of rays; in training, those that the losses need."""
        if not self.training:
            return self._eval_outputs(ray_bundle)
        views = ray_bundle.metadata["sl_view"][:, 0]
        now = self.device_poses.transforms()
        origins, directions = _corrected(ray_bundle, views, now)
        outputs: dict[str, Any] = {"origins": origins, "directions": directions}
        if self.config.losses.direct:
            outputs["T_scene_projector"] = now.T_scene_projector[views]
        if self.renders_now:
            s = self.config.sampling
            n = min(s.render_rays, len(origins))
            T_projector_scene = now.T_projector_scene[views[:n]]
            outputs["rendered"] = self.renderer.render(
                origins[:n], directions[:n], T_projector_scene, s.samples, jitter=True
            )
        return outputs

    @torch.no_grad()
    @one_torch_thread()
    def _eval_outputs(self, bundle: RayBundle) -> dict[str, Tensor]:
        origins, directions, views = self.corrected_rays(bundle)
        T_camera, T_projector = self.poses_scene()
        ends = None
        if bundle.nears is not None and bundle.fars is not None:  # of a texture, or cropped
            ends = (bundle.nears[:, 0], bundle.fars[:, 0])
        outputs = ray_outputs(self.renderer, origins, directions, T_projector.float(), views, ends)
        if "sl_uv" not in (bundle.metadata or {}):  # batches of single pixels hold their measured coordinates
            depth = torch.where(outputs["accumulation"] > 0.5, outputs["depth"], 0.0)
            measured = self.measured.at(origins + depth * directions, views, inverse(T_camera).float())
            outputs = picture_outputs(outputs, measured)
        return outputs

    def corrected_rays(self, bundle: RayBundle) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"], Tensor]:
        """Origins, directions and frame numbers of rays, at their refined poses.

        Rays of a free viewpoint are not part of a frame: they are unchanged, and use the projector chosen in the
        viewer.
        """
        metadata = bundle.metadata or {}
        if "sl_view" not in metadata:
            view = torch.full_like(bundle.origins[:, 0], self.viewed_frame, dtype=torch.long)
            return bundle.origins, bundle.directions, view
        views = metadata["sl_view"][:, 0].long()
        if "sl_refined" in metadata:
            return bundle.origins, bundle.directions, views
        with torch.no_grad():
            return *_corrected(bundle, views, self.device_poses.transforms()), views

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """The weighted losses of a training step; in evaluation, the terms that need only rendered outputs."""
        losses: dict[str, Tensor] = {}
        seen = seen_by_rays(outputs)
        if seen is not None:
            coordinates, pattern, lit = seen
            n = len(pattern)
            error = coordinate_loss(coordinates, batch["coords"][:n], batch["decoded"][:n, 0] & lit)
            losses["coordinates"] = self._per_pixel * error
            losses["pattern"] = self.config.losses.pattern * pattern_loss(pattern, batch["pattern"][:n, 0])
        return losses | self._field_losses(outputs, batch) if "origins" in outputs else losses

    def _field_losses(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """The terms that need no rendering."""
        c = self.config
        points = random_points(c.sampling.eikonal_points, batch["coords"].device)
        if not c.losses.direct:
            return field_losses(self.field, points, c.losses)
        rays = MeasuredRays(outputs["origins"], outputs["directions"], outputs["T_scene_projector"], batch["coords"])
        noise = DecodingNoise(self.noise_px, self.px_per_length)
        if points.device.type == "cpu":  # fewer rays take less time; a GPU would have to tell the host how many
            rays = rays.chosen(batch["decoded"][:, 0])
        return direct_losses(self.field, rays, self.projector, noise, points, c.losses, self.surface_width_now)

    @property
    def _per_pixel(self) -> Tensor | float:
        w = self.config.losses
        return w.coordinates / self.px_per_length if w.coordinates_per_pixel is None else w.coordinates_per_pixel

    def remember(self, loss: Tensor, terms: dict[str, Tensor], metrics: dict[str, Tensor]) -> None:
        """After each step: put its figures into the history, if it is their turn."""
        if self._step % self.history_table.every:
            return
        w = self.config.losses
        values = {"loss": loss, "eikonal": terms["eikonal"] / max(w.eikonal, 1e-12), **metrics}
        if "surface" in terms:
            values["surface"] = terms["surface"] / max(w.surface, 1e-12)
        self.history_table.add(self._step, values)

    # ---- evaluation

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Median coordinate residual (pattern pixels) and pattern cosine of a batch."""
        return fit_metrics(outputs, batch)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colour with the accumulation as opacity: exporters keep opaque pixels."""
        return torch.cat([outputs[output_name], outputs["accumulation"]], -1)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Captured and rendered image side by side, [H, 2 W, 3], and the images of the other outputs."""
        h, w = outputs["rgb"].shape[:2]
        captured = batch["image"].to(outputs["rgb"].device)[:h, :w, :3]
        images = {
            "img": torch.cat([captured, outputs["rgb"]], 1),
            "coordinates": outputs["coordinates"],
            "normals": outputs["normals"],
            "pattern": outputs["pattern"].expand(-1, -1, 3),
        }
        return {"accumulation_mean": float(outputs["accumulation"].mean())}, images


def pose_parameters(
    config: SLModelConfig, T_scene_camera: Float[Tensor, "frames 4 4"], T_scene_projector: Float[Tensor, "frames 4 4"]
) -> PoseParameters:
    """The parameters for what is free (`refine_poses`) and how it is refined (`pose_method`)."""
    free, independent = config.refine_poses, config.pose_method == "render-independently"
    modes = config.camera_optimizer.used, config.projector_optimizer.used
    moves: ProjectorMoves = "relative pose"
    if free == "static-projector":
        moves = "nothing"
    elif independent and free not in ("known-rig", "rigid-rig"):
        moves = "nothing" if modes[1] == "off" else "own pose"
    return PoseParameters(
        T_scene_camera,
        T_scene_projector,
        refine=config.renders_poses,
        refine_projector=free not in ("known-rig", "static-projector"),
        shared_projector=free == "rigid-rig",
        about_scene=free == "static-projector" or not independent,
        projector_moves_by=moves,
        modes=modes,
    )


def _read_step(model: SLModel, _: object) -> None:
    """After a checkpoint was loaded."""
    model._set_scalars(int(model.step_now))


def _corrected(bundle: RayBundle, views: Tensor, now: FrameTransforms) -> tuple[Tensor, Tensor]:
    """Move rays from the starting pose, at which they were made, to the current one."""
    directions = rotate(now.correction[views], bundle.directions)
    return now.T_scene_camera[views, :3, 3], directions / directions.norm(dim=-1, keepdim=True)
