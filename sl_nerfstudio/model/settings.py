"""Settings of the model; the docstring of each field is its help on the command line."""

from dataclasses import dataclass, field
from typing import Literal

from nerfstudio.models.base_model import ModelConfig

from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.field.sdf_field import FieldConfig
from sl_nerfstudio.model.pose_refinement import PriorConfig
from sl_nerfstudio.rendering.schedule import AnnealingConfig
from sl_nerfstudio.rendering.settings import LossConfig, SamplingConfig

PoseMethod = Literal["adjust", "adjust-and-render", "render", "render-independently"]


@dataclass
class SLModelSettings(ModelConfig):
    """A signed distance field seen as projector coordinates and pattern intensity, with the poses of both devices."""

    enable_collider: bool = False
    """Must stay off: the scene is a unit sphere and rays are cut to it."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside training."""
    schedule_iterations: int = 1000
    """Steps over which annealing proceeds; filled in by the trainer with the length of the run."""
    refine_poses: RefinePoses = "free"
    """What is refined: `free` (camera and projector of every frame), `rigid-rig` (frames, and one relative pose for
    all of them), `known-rig` (frames only), `static-projector` (frames, and a projector that never moves), `off`."""
    pose_method: PoseMethod = "adjust"
    """How poses are refined: `adjust` (bundle adjustment before the first step), `adjust-and-render` (the rendering
    losses go on moving them), `render` (rendering losses alone), `render-independently` (the same, each device by
    itself)."""
    refine_intrinsics: bool = False
    """Where the captures contradict focal lengths and principal points, change those before training, if that makes
    held-out pixels agree better; the scan folder stays as it is."""
    warm_start: float = 0.15
    """Share of the run in which the field is fitted to triangulated points before anything is rendered."""
    sdf: FieldConfig = field(default_factory=FieldConfig)
    """The signed distance field."""
    losses: LossConfig = field(default_factory=LossConfig)
    """Weights of the losses."""
    sampling: SamplingConfig = field(default_factory=SamplingConfig)
    """Samples along rays."""
    annealing: AnnealingConfig = field(default_factory=AnnealingConfig)
    """Sharpness and detail over the run."""
    prior: PriorConfig = field(default_factory=PriorConfig)
    """Uncertainty of the starting poses where the scan does not state it."""
    adjustment: AdjustmentSettings = field(default_factory=AdjustmentSettings)
    """Size of the bundle adjustment."""

    @property
    def sdf_field(self) -> FieldConfig:
        """`sdf` under the name that `ns-export marching-cubes` looks for."""
        return self.sdf

    @property
    def adjusts_poses(self) -> bool:
        """Whether poses are adjusted together before the first step."""
        return self.refine_poses != "off" and self.pose_method in ("adjust", "adjust-and-render")

    @property
    def renders_poses(self) -> bool:
        """Whether the rendering losses move poses."""
        return self.refine_poses != "off" and self.pose_method != "adjust"
