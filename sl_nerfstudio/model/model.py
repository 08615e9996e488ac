"""The nerfstudio model: a signed distance field, and the poses of the devices that saw it."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models.base_model import Model
from nerfstudio.viewer.viewer_elements import ViewerSlider
from numpy import ndarray
from torch import Tensor, nn

from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.field.cached_grid import CachedGrid
from sl_nerfstudio.field.sdf_field import SDFField
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import DeviceKind, Intrinsics, project
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.model import outputs as pictures
from sl_nerfstudio.model.config import SLModelConfig
from sl_nerfstudio.model.history import History
from sl_nerfstudio.model.pose_parameters import IndependentPoseParameters, RigPoseParameters, StaticProjectorParameters
from sl_nerfstudio.model.pose_refinement import adjust_scan, scene_rig, sigmas_in_scan_units
from sl_nerfstudio.rendering.direct_losses import direct_losses, measure
from sl_nerfstudio.rendering.losses import coordinate_loss, pattern_loss
from sl_nerfstudio.rendering.ray_samples import first_crossing, sphere_interval, uniform_samples
from sl_nerfstudio.rendering.schedule import kappa_at, level_weights_at
from sl_nerfstudio.rendering.volume_rendering import Rendered, render
from sl_nerfstudio.scan import Scan, read_scan

_REFRESH_EVERY = 20  # steps between updates of the cached grid
_EVAL_SAMPLES = 24
_SHADOW_SAMPLES = 32
_POSE_PARAMETERS = {"rig": RigPoseParameters, "independent": IndependentPoseParameters}


class SLModel(Model):
    """See docs/method.md. Lengths inside are scene units; `poses` and `S_scene_world` lead back to the scan's."""

    config: SLModelConfig
    step_now: Tensor
    noise_px: Tensor
    px_per_length: Tensor
    projector_params: Tensor
    pattern: Tensor

    def __init__(
        self, config: SLModelConfig, scene_box: SceneBox, num_train_data: int, metadata: dict[str, Any], **kwargs: Any
    ) -> None:
        self.scan: Scan = metadata["sl_scan"]
        self.S_scene_world: Similarity = metadata["sl_S_scene_world"]
        super().__init__(config, scene_box, num_train_data, **kwargs)

    def populate_modules(self) -> None:
        """Make field, poses and what is known of the devices."""
        super().populate_modules()
        c = self.config
        self.field = SDFField(c.sdf)
        self.cache = CachedGrid()
        self._cache_is_old = False  # after a checkpoint was loaded to be looked at: as old as the last refresh
        rig = scene_rig(self.scan, self.S_scene_world)
        moves = c.train_poses and c.refine_poses != "off"
        make = (
            StaticProjectorParameters if c.refine_poses == "static-projector" else _POSE_PARAMETERS[c.pose_parameters]
        )
        self.device_poses = make(
            rig.T_world_camera,
            rig.T_world_projector,
            refine_camera=moves,
            refine_projector=moves and c.refine_poses not in ("known-rig", "static-projector"),
            shared_projector=c.refine_poses == "rigid-rig",
        )
        projector = Intrinsics.of(self.scan.projector)
        self._projector_kind: DeviceKind = projector.model
        self._projector_distorted = projector.distorted
        self.register_buffer("projector_params", projector.params, persistent=False)
        self.register_buffer("pattern", torch.from_numpy(self.scan.read_pattern()).float(), persistent=False)
        # what a checkpoint must know besides weights: the step, for annealing; the decoding noise, found once
        self.register_buffer("step_now", torch.zeros((), dtype=torch.int64))
        self.register_buffer("noise_px", torch.ones(()))
        self.register_buffer("px_per_length", torch.tensor(float("nan")))
        self.history_table = History(("loss", "coordinate_px", "pattern_cosine", "eikonal", "surface"))
        self.projector_of_frame = ViewerSlider("Projector of frame", 0, 0, max(len(self.scan.frames) - 1, 1), 1)

    # ---- what other parts of the package ask for

    def poses_scene(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """Present poses of cameras and projectors in the scene."""
        with torch.no_grad():
            return self.device_poses()

    def poses(self) -> DevicePoses:
        """Current poses of all devices in the scan's world and units."""
        S = self.S_scene_world.inverse()
        camera, projector = self.poses_scene()
        return DevicePoses(S.poses(camera.cpu().numpy()), S.poses(projector.cpu().numpy()))

    def pose_sigma(self) -> Float[ndarray, "frames 4"] | None:
        """Posterior 1 sigma per frame (see refinement.sigmas_in_scan_units), or None where it was not estimated."""
        sigma = self.device_poses.sigma
        return None if bool(sigma.isnan().any()) else sigmas_in_scan_units(sigma, self.S_scene_world)

    def intrinsics_doubt(self) -> str:
        """What the captures say against the intrinsics; "" if nothing, or if poses were not adjusted."""
        poses = self.device_poses
        doubt = SelfCalibration(poses.intrinsics_change.cpu(), poses.intrinsics_covariance.cpu())
        return doubt.said([frame.camera for frame in self.scan.frames], self.scan.projector)

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
        return Intrinsics(self.projector_params, self._projector_kind, self._projector_distorted)

    # ---- training

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """`table` and `mlp` of the field, and the poses."""
        return {
            "table": [self.field.encoding.table],
            "mlp": list(self.field.mlp.parameters()),
            "camera_opt": [self.device_poses.camera_step],
            "projector_opt": [self.device_poses.projector_step],
        }

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Joint adjustment before the first step, annealing before every step."""
        pipeline = training_callback_attributes.pipeline
        assert pipeline is not None
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]

        def prepare(step: int) -> None:
            if step == 0:
                self.start(pipeline.datamanager.samples)

        return [TrainingCallback(before, prepare), TrainingCallback(before, self.anneal)]

    def start(self, samples: Any) -> None:
        """Before the first step: refine the poses, and measure the noise of the decoding."""
        c = self.config
        if c.adjust_poses and c.refine_poses != "off" and len(self.scan.frames) > 1:
            found = adjust_scan(self.scan, self.S_scene_world, samples, c.refine_poses, c.prior, c.adjustment)
            self.device_poses.rebase(found.T_scene_camera, found.T_scene_projector)
            self.device_poses.sigma.copy_(found.sigma)
            if found.intrinsics is not None:
                self.device_poses.intrinsics_change.copy_(found.intrinsics.change)
                self.device_poses.intrinsics_covariance.copy_(found.intrinsics.covariance)
            print("\n".join(text for text in (found.message(), self.intrinsics_doubt()) if text), flush=True)
        camera, projector = self.poses_scene()
        noise, px_per_length = measure(self.scan, samples, camera.cpu(), projector.cpu())
        self.noise_px.fill_(noise)
        self.px_per_length.fill_(px_per_length)

    def anneal(self, step: int) -> None:
        """Set sharpness and detail of a step; called before each, and when a checkpoint is loaded."""
        self.step_now.fill_(step)
        c = self.config
        self.field.set_level_weights(level_weights_at(c.annealing, c.sdf.levels, step, c.schedule_iterations))
        uses_cache = self.training and c.sampling.strategy == "surface" and self._renders(step)
        if uses_cache and (not self.cache.filled or step % _REFRESH_EVERY == 0):
            self.cache.refresh(self.field)
        if self.training:  # training goes on: with the cache as it was, or the resumed run would be another one
            self._cache_is_old = False

    def update_to_step(self, step: int) -> None:
        """Called by nerfstudio before weights are loaded: the levels must be those of that step."""
        self.anneal(step)
        self._cache_is_old = True

    def _renders(self, step: int) -> bool:
        return step >= self.config.warm_start * self.config.schedule_iterations

    @property
    def kappa(self) -> float:
        """Present sharpness, per scene unit."""
        return kappa_at(self.config.annealing, int(self.step_now), self.config.schedule_iterations)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Rendered outputs of rays; in training those that the losses need."""
        if not self.training:
            return pictures.outputs(self, ray_bundle)
        views = ray_bundle.metadata["sl_view"][:, 0]
        T_camera, T_projector = self.device_poses()
        origins, directions = self._corrected(ray_bundle, views, T_camera)
        T_projector_scene = inverse(T_projector).float()[views]
        outputs: dict[str, Any] = {
            "origins": origins,
            "directions": directions,
            "T_scene_projector": T_projector.float()[views],
        }
        if self._renders(int(self.step_now)):
            n = min(self.config.sampling.render_rays, len(origins))
            outputs["rendered"] = self.render_rays(origins[:n], directions[:n], T_projector_scene[:n], jitter=True)
        return outputs

    def corrected_rays(self, bundle: RayBundle) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"], Tensor]:
        """Origins, directions and frame numbers of rays, at their refined poses.

        Rays of a free viewpoint belong to no frame: they are left alone, and see by the projector chosen in the viewer.
        """
        metadata = bundle.metadata or {}
        if "sl_view" not in metadata:
            view = torch.full_like(bundle.origins[:, 0], int(self.projector_of_frame.value), dtype=torch.long)
            return bundle.origins, bundle.directions, view
        views = metadata["sl_view"][:, 0].long()
        if "sl_refined" in metadata:
            return bundle.origins, bundle.directions, views
        return *self._corrected(bundle, views, self.poses_scene()[0]), views

    def _corrected(self, bundle: RayBundle, views: Tensor, T_camera: Tensor) -> tuple[Tensor, Tensor]:
        """From the starting pose, in which the rays come, to the present one."""
        correction = (T_camera @ inverse(self.device_poses.start_camera)).float()[views]
        directions = rotate(correction, bundle.directions)
        return T_camera[:, :3, 3].float()[views], directions / directions.norm(dim=-1, keepdim=True)

    @torch.no_grad()
    def is_lit(
        self, p: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], projector_centre: Float[Tensor, "n 3"]
    ) -> Bool[Tensor, "n"]:
        """Whether surface points see the projector: nothing between, and the surface faces it."""
        to_projector = torch.nn.functional.normalize(projector_centre - p, dim=-1)
        start = p + 2 * self.cache.cell * normal
        _, far, _ = sphere_interval(start, to_projector)
        t = uniform_samples(torch.zeros_like(far), far, _SHADOW_SAMPLES, jitter=False)
        between = self.cache.look_up((start[:, None] + t[..., None] * to_projector[:, None]).reshape(-1, 3))
        return (between.reshape(t.shape).amin(-1) > 0) & ((normal * to_projector).sum(-1) > 0)

    def measured_coordinates(self, p: Float[Tensor, "n 3"], views: Int[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """What was decoded at the pixels where frames `views` see scene points; NaN where nothing was."""
        result = torch.full_like(p[:, :2], float("nan"))
        T_camera_scene = inverse(self.poses_scene()[0]).float()
        for view in views.unique().tolist():
            mine = views == view
            frame = self.scan.frames[view]
            uv, in_front = project(Intrinsics.of(frame.camera).to(p.device), transform(T_camera_scene[view], p[mine]))
            inside = in_front & (uv >= 0).all(-1) & (uv < uv.new_tensor([frame.camera.w, frame.camera.h])).all(-1)
            pixel = torch.where(inside[:, None], uv, 0.0).long()
            decoded = _decoded(self.scan, view).to(p.device)[pixel[:, 1], pixel[:, 0]]
            result[mine] = torch.where(inside[:, None], decoded, float("nan"))
        return result

    def render_rays(self, origins: Tensor, directions: Tensor, T_projector_scene: Tensor, jitter: bool) -> Rendered:
        """Volume render rays as projector coordinates and pattern."""
        t = self._sample(origins, directions, jitter)
        p = origins[:, None] + t[..., None] * directions[:, None]
        sdf = self.field.sdf(p.reshape(-1, 3)).reshape(t.shape)
        return render(sdf, t, origins, directions, T_projector_scene, self.projector, self.pattern, self.kappa)

    @torch.no_grad()
    def _sample(self, origins: Tensor, directions: Tensor, jitter: bool) -> Tensor:
        s = self.config.sampling
        near, far, _ = sphere_interval(origins, directions)
        count = s.samples if jitter else max(s.samples, _EVAL_SAMPLES)
        if s.strategy == "uniform":
            return uniform_samples(near, far, count, jitter)
        if not self.training and (self._cache_is_old or not self.cache.filled):
            self.cache.refresh(self.field)
            self._cache_is_old = False
        t, found = first_crossing(self.cache.look_up, origins, directions, near, far)
        half = s.half_width / self.kappa + self.cache.cell
        low, high = torch.where(found, t - half, near), torch.where(found, t + half, far)
        return uniform_samples(low, high, count, jitter)

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """The weighted losses of a training step; in evaluation the terms that rendered outputs have."""
        w = self.config.losses
        losses: dict[str, Tensor] = {}
        if "origins" not in outputs:
            coordinates = torch.cat([outputs["coordinate_x"], outputs["coordinate_y"]], -1)
            counts = batch["decoded"][:, 0] & (outputs["accumulation"][:, 0] > 0.5)
            losses["coordinates"] = self._per_pixel * coordinate_loss(coordinates, batch["coords"], counts)
            losses["pattern"] = w.pattern * pattern_loss(outputs["pattern"][:, 0], batch["pattern"][:, 0])
            return losses
        if "rendered" in outputs:
            rendered: Rendered = outputs["rendered"]
            n = len(rendered.depth)
            counts = batch["decoded"][:n, 0] & (rendered.lit > 0.5)
            error = coordinate_loss(rendered.coordinates, batch["coords"][:n], counts)
            losses["coordinates"] = self._per_pixel * error
            losses["pattern"] = w.pattern * pattern_loss(rendered.pattern, batch["pattern"][:n, 0])
        losses |= direct_losses(self, outputs, batch)
        if int(self.step_now) % self.history_table.every == 0:
            self._remember(outputs, batch, losses)
        return losses

    @property
    def _per_pixel(self) -> Tensor | float:
        w = self.config.losses
        return w.coordinates / self.px_per_length if w.coordinates_per_pixel is None else w.coordinates_per_pixel

    @torch.no_grad()
    def _remember(self, outputs: dict[str, Any], batch: dict[str, Tensor], losses: dict[str, Tensor]) -> None:
        values = {"loss": float(torch.stack([v.detach() for v in losses.values()]).sum())}
        values["eikonal"] = float(losses["eikonal"]) / max(self.config.losses.eikonal, 1e-12)
        if "surface" in losses:
            values["surface"] = float(losses["surface"]) / max(self.config.losses.surface, 1e-12)
        values |= {k: float(v) for k, v in pictures.fit_metrics(outputs, batch).items()}
        self.history_table.add(int(self.step_now), values)

    # ---- evaluation

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Median coordinate residual in pixels and pattern cosine of some pixels."""
        return pictures.fit_metrics(outputs, batch)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colour with the accumulation as opacity: exporters keep what is opaque."""
        return torch.cat([outputs[output_name], outputs["accumulation"]], -1)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Rendered beside captured, for one whole frame."""
        return pictures.image_metrics_and_images(outputs, batch)


@lru_cache(maxsize=2)
def _decoded_image(root: Path, view: int) -> Float[Tensor, "h w 2"]:
    return torch.from_numpy(read_scan(root).frames[view].read_coords())


def _decoded(scan: Scan, view: int) -> Float[Tensor, "h w 2"]:
    return _decoded_image(scan.root, view)


def paper_model() -> SLModelConfig:
    """The paper's: sphere start, independent poses trained by Adam, all levels, uniform samples, no direct terms."""
    c = SLModelConfig(adjust_poses=False, train_poses=True, pose_parameters="independent", warm_start=0.0)
    losses = replace(
        c.losses,
        coordinates=0.0,
        coordinates_per_pixel=1000 / 65535,
        pattern=0.05,
        eikonal=0.01,
        surface=0.0,
        free_space=0.0,
    )
    sampling = replace(c.sampling, strategy="uniform", samples=64, render_rays=2024, eikonal_points=4096)
    annealing = replace(c.annealing, kappa_start=32.0, kappa_end=200.0, kappa_growth="linear", coarse_to_fine=False)
    return replace(c, losses=losses, sampling=sampling, annealing=annealing)
