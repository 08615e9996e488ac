"""`ns-train sl-neus` and `ns-train sl-neus-paper`."""

import inspect
from typing import Any

from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.plugins.types import MethodSpecification

from sl_nerfstudio.dataparser.datamanager import SLDataManagerConfig
from sl_nerfstudio.late_imports import end_imports
from sl_nerfstudio.model.model import RECOMMENDED_STEPS, SLModelConfig, paper_model
from sl_nerfstudio.model.optimisers import DecaySchedulerConfig, FusedAdamOptimizerConfig, RowAdamOptimizerConfig
from sl_nerfstudio.model.pipeline import SLPipelineConfig
from sl_nerfstudio.model.trainer import SLTrainerConfig, default_device

# When nerfstudio has loaded this module, it asks for the call stack 26 times, and each time Python looks through all
# modules for the source of the import system's own frames: 6 s of every ns-* command. Here is where these belong.
for _name in ("importlib._bootstrap", "importlib._bootstrap_external"):
    inspect.modulesbyfile.setdefault(f"<frozen {_name}>", _name)
end_imports()


def _trainer(method_name: str, model: SLModelConfig, rays: int, optimizers: dict[str, Any]) -> SLTrainerConfig:
    """A run that trains, saves, prints where the result is, and returns; meanwhile evaluated on held-out pixels."""
    return SLTrainerConfig(
        method_name=method_name,
        max_num_iterations=RECOMMENDED_STEPS[method_name],
        machine=MachineConfig(device_type=default_device()),
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False), profiler="none"),
        viewer=ViewerConfig(websocket_host="127.0.0.1"),  # nerfstudio listens on all networks
        vis="tensorboard",
        steps_per_save=1000,
        steps_per_eval_batch=100,
        steps_per_eval_image=0,  # whole frames take seconds to minutes without a GPU: ns-eval renders them on request
        steps_per_eval_all_images=0,
        pipeline=SLPipelineConfig(datamanager=SLDataManagerConfig(train_num_rays_per_batch=rays), model=model),
        optimizers=optimizers,
    )


def _group(optimizer: Any, scheduler: DecaySchedulerConfig) -> dict[str, Any]:
    return {"optimizer": optimizer, "scheduler": scheduler}


sl_neus = MethodSpecification(
    config=_trainer(
        "sl-neus",
        SLModelConfig(),
        rays=4096,
        optimizers={
            "table": _group(RowAdamOptimizerConfig(lr=1e-3), DecaySchedulerConfig(final=0.002)),
            "mlp": _group(FusedAdamOptimizerConfig(lr=1e-3, eps=1e-15), DecaySchedulerConfig(final=0.002)),
            "camera_opt": _group(FusedAdamOptimizerConfig(lr=1e-4, eps=1e-15), DecaySchedulerConfig(final=0.01)),
            "projector_opt": _group(FusedAdamOptimizerConfig(lr=1e-4, eps=1e-15), DecaySchedulerConfig(final=0.01)),
        },
    ),
    description="Surface and poses of a scan with a moving pattern projector; quick with or without a GPU.",
)


def _paper_group(lr: float) -> dict[str, Any]:
    """Down to 5e-12 at step 8,000, as in the paper."""
    decay = DecaySchedulerConfig(shape="exponential", final=5e-12 / lr, max_steps=8000)
    return _group(FusedAdamOptimizerConfig(lr=lr, eps=1e-15), decay)


sl_neus_paper = MethodSpecification(
    config=_trainer(
        "sl-neus-paper",
        paper_model(),
        rays=2024,
        optimizers={
            "table": _paper_group(5e-4),
            "mlp": _paper_group(5e-4),
            "camera_opt": _paper_group(1e-3),
            "projector_opt": _paper_group(1e-3),
        },
    ),
    description="The method of Furukawa, Nishihara and Kawasaki (2025), for comparison; three details differ: xyz as "
    "input, a rounded ReLU, coordinates divided by the accumulated weight.",
)
