"""`ns-train sl-neus` and `ns-train sl-neus-paper`."""

import inspect
import sys
import warnings
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import yaml
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.plugins.types import MethodSpecification

from sl_nerfstudio.dataparser.datamanager import SLDataManagerConfig
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.late_imports import end_imports
from sl_nerfstudio.model.model import RECOMMENDED_STEPS, SLModelConfig, paper_model
from sl_nerfstudio.model.optimisers import default_optimizers
from sl_nerfstudio.model.pipeline import SLPipelineConfig
from sl_nerfstudio.model.run_files import quiet_nerfstudio
from sl_nerfstudio.model.trainer import SLTrainerConfig, default_device

# When nerfstudio has loaded this module, it asks for the call stack 26 times, and each time Python looks through all
# modules for the source of the import system's own frames: 6 s of every ns-* command. Here is where these belong.
for _name in ("importlib._bootstrap", "importlib._bootstrap_external"):
    inspect.modulesbyfile.setdefault(f"<frozen {_name}>", _name)
end_imports()

# nerfstudio loads a run's config.yml by itself, before anything of this package can look at it.
_excepthook = sys.excepthook


def _explain_other_versions(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Say in a sentence that a config.yml names what this version of the package has not; show other errors as usual.

    Python's hook for errors that nobody catches.
    """
    if not (isinstance(error, yaml.constructor.ConstructorError) and "sl_nerfstudio" in str(error)):
        _excepthook(kind, error, trace)
        return
    words = sys.argv[1:]
    named = [word for word, before in zip(words[1:], words, strict=False) if before == "--load-config"]
    line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
    print(
        f"error: {named[0] if named else 'config.yml'}{line}: trained by another version of sl_nerfstudio\n"
        f"    cause:  {error.problem}\n"
        "    remedy: train again with this version, which reads the scan folder as before, or open it with the one "
        "that trained it",
        file=sys.stderr,
    )


sys.excepthook = _explain_other_versions


def _trainer(method_name: str, model: SLModelConfig, rays: int) -> SLTrainerConfig:
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
        optimizers=default_optimizers(method_name),
    )


sl_neus = MethodSpecification(
    config=_trainer("sl-neus", SLModelConfig(), rays=4096),
    description="Surface and poses of a scan with a moving pattern projector; quick with or without a GPU. Usual: "
    "--data SCAN --output-dir DIR --timestamp NAME --max-num-iterations STEPS --pipeline.model.refine-poses "
    "{free,rigid-rig,known-rig,static-projector,off} --pipeline.model.refine-intrinsics True; all others can stay.",
)


sl_neus_paper = MethodSpecification(
    config=_trainer("sl-neus-paper", paper_model(), rays=2024),
    description="The method of Furukawa, Nishihara and Kawasaki (2025), for comparison; three details differ: xyz as "
    "input, a rounded ReLU, coordinates divided by the accumulated weight. Poses move as "
    "--pipeline.model.camera-optimizer.mode and --pipeline.model.projector-optimizer.mode say: {SE3,SO3xR3,off}.",
)


def train(
    scan: Path | str,
    output: Path | str,
    name: str = "run",
    steps: int | None = None,
    method: Literal["sl-neus", "sl-neus-paper"] = "sl-neus",
    **settings: Any,
) -> Path:
    """Train the surface of a scan, as `ns-train` does, with the GPU if there is one.

    Args:
        scan: the scan folder.
        output: the run is written to output/SCAN/METHOD/NAME.
        name: of the run; one of that name must not be there.
        steps: of the training; default: as many as the method recommends.
        method: `sl-neus`, or the paper's own.
        settings: fields of `SLModelConfig`, such as `refine_poses="rigid-rig"`.

    Returns the run's config.yml, which `load_run` takes. Raises UserError for a faulty scan, settings that do not
    exist, and a folder that is in use.
    """
    # which themselves load this module, for its list of methods
    from nerfstudio.scripts.train import train_loop

    from sl_nerfstudio.model.train import settings_of_run

    config = settings_of_run(method, Path(scan), Path(output), Path(scan).absolute().name, name, steps)
    config.pipeline.datamanager.data = config.data
    unknown = sorted(set(settings) - {field.name for field in fields(config.pipeline.model)})
    if unknown:
        raise UserError(
            f"train: {', '.join(unknown)}: there is no such setting\n    cause:  a typing error\n"
            "    remedy: settings are those that ns-train sl-neus --help lists as --pipeline.model"
        )
    for field, value in settings.items():
        setattr(config.pipeline.model, field, value)
    quiet_nerfstudio(True)
    config.begin()
    config.save_config()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # nerfstudio's own, about torch
        train_loop(0, 1, config)
    return config.get_base_dir() / "config.yml"
