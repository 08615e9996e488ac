"""Settings of the model; the docstring of each field is its help on the command line."""

from dataclasses import dataclass, field
from typing import Literal

from nerfstudio.models.base_model import ModelConfig

from sl_nerfstudio.bundle_adjustment.adjust import AdjustmentSettings
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.field.sdf_field import FieldConfig
from sl_nerfstudio.model.pose_refinement import PriorConfig
from sl_nerfstudio.rendering.schedule import AnnealingConfig


@dataclass
class LossConfig:
    """Weights of the losses. Lengths are in scene units (the object's radius is 0.8)."""

    coordinates: float = 0.1
    """Weight of the rendered coordinates' L1 error, converted to a length by the scan's median depth sensitivity."""
    coordinates_per_pixel: float | None = None
    """If set, the weight of the coordinates' L1 error in pattern pixels, in place of `coordinates`."""
    pattern: float = 0.005
    """Weight of the pattern term, 1 - cosine of rendered and captured intensities."""
    eikonal: float = 0.1
    """Weight of the Eikonal term, the mean squared departure of the field's slope from one."""
    surface: float = 1.0
    """Weight of the direct term |f| at triangulated points."""
    free_space: float = 1.0
    """Weight of the sign terms: positive in front of a triangulated point, negative just behind it."""


@dataclass
class SamplingConfig:
    """Where the field is evaluated in a training step."""

    strategy: Literal["surface", "uniform"] = "surface"
    """`surface`: around the crossing found in a cached coarse grid; `uniform`: along the whole ray."""
    samples: int = 16
    """Samples a ray for volume rendering."""
    half_width: float = 4.0
    """Half the interval sampled around the surface, in units of 1 / kappa (plus one cell of the cached grid)."""
    render_rays: int = 256
    """Rays of a batch that are volume rendered; all of the batch's decoded rays serve the direct terms."""
    eikonal_points: int = 1024
    """Random points of the scene at which the Eikonal term is evaluated, besides the surface points."""


@dataclass
class SLModelConfig(ModelConfig):
    """A signed distance field seen as projector coordinates and pattern intensity, with the poses of both devices."""

    _target: type = field(default_factory=lambda: _model_class())
    enable_collider: bool = False
    """Must stay off: the scene is a unit sphere and rays are cut to it."""
    eval_num_rays_per_chunk: int = 8192
    """Rays rendered at once outside training."""
    schedule_iterations: int = 1000
    """Steps over which annealing proceeds; filled in by the trainer with the length of the run."""
    refine_poses: RefinePoses = "free"
    """What is refined: `free` (camera and projector of every frame), `rigid-rig` (frames, and one relative pose for
    all of them), `known-rig` (frames only), `static-projector` (frames, and a projector that never moves), `off`."""
    adjust_poses: bool = True
    """Adjust all poses jointly, by second-order steps on the decoded coordinates, before the first training step."""
    refine_intrinsics: bool = False
    """Where the captures contradict focal lengths and principal points, change those before training, if that makes
    held-out pixels agree better; the scan folder stays as it is."""
    pose_parameters: Literal["rig", "independent"] = "rig"
    """`rig`: a frame moves as a whole and its projector against its camera; `independent`: each device by itself."""
    train_poses: bool = False
    """Let the rendering losses go on moving the poses during training (learning rates of camera_opt, projector_opt)."""
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
    """Size of the joint adjustment."""

    @property
    def sdf_field(self) -> FieldConfig:
        """`sdf` under the name that `ns-export marching-cubes` looks for."""
        return self.sdf


def _model_class() -> type:
    from sl_nerfstudio.model.model import SLModel

    return SLModel
