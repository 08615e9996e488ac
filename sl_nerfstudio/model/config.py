"""The configuration from which nerfstudio creates the model, and that of the paper's method."""

from dataclasses import dataclass, field, replace

from sl_nerfstudio.model.model import SLModel
from sl_nerfstudio.model.settings import SLModelSettings


@dataclass
class SLModelConfig(SLModelSettings):
    """A signed distance field seen as projector coordinates and pattern intensity, with the poses of both devices."""

    _target: type = field(default_factory=lambda: SLModel)


def paper_model() -> SLModelConfig:
    """The paper's model: initial sphere, independent poses by Adam, all levels, uniform samples, no direct terms."""
    c = SLModelConfig(pose_method="render-independently", warm_start=0.0)
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
