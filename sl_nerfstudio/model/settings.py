"""Settings of the model; the docstring of each field is its help on the command line."""

import sys
from dataclasses import dataclass, field
from typing import Literal

import torch
from nerfstudio.models.base_model import ModelConfig

from sl_nerfstudio.bundle_adjustment.parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.field.field import FieldConfig
from sl_nerfstudio.model.pose_refinement import PriorConfig
from sl_nerfstudio.rendering.losses import AnnealingConfig, LossConfig, SamplingConfig

RECOMMENDED_STEPS = {"sl-neus": 1000, "sl-neus-paper": 10_000}  # by method; the paper's is its own

PoseMethod = Literal["adjust", "render", "render-independently"]


@dataclass
class SLModelSettings(ModelConfig):
    """A signed distance field seen as projector coordinates and pattern intensity, with the poses of both devices."""

    enable_collider: bool = False
    """Must be off: the scene is a unit sphere, and rays are clipped to it."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside training."""
    schedule_iterations: int = 1000
    """Number of annealing steps; the trainer sets it to the length of the run."""
    refine_poses: RefinePoses = "free"
    """What is refined: `free` (camera and projector of every frame), `rigid-rig` (frames, and one relative pose for
    all of them), `known-rig` (frames only), `static-projector` (frames, and a projector that never moves), `off`."""
    pose_method: PoseMethod = "adjust"
    """How poses are refined: `adjust` (bundle adjustment before the first step), `render` (only the rendering losses),
    `render-independently` (the same, with each device independent of the others)."""
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
    """Uncertainty of the starting poses if the scan does not state it, and of the intrinsics."""
    adjustment: AdjustmentSettings = field(default_factory=AdjustmentSettings)
    """Settings of the bundle adjustment."""

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
    def renders_poses(self) -> bool:
        """Whether the rendering losses move poses."""
        return self.refine_poses != "off" and self.pose_method != "adjust"
