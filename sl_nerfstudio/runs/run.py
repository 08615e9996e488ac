"""A trained run: its config.yml, read without running anything from it, its checkpoint, and its model."""

import enum
import json
import types
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from itertools import product
from pathlib import Path, PosixPath
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
import yaml

from sl_nerfstudio.dataparser.datamanager import SLDataManagerConfig
from sl_nerfstudio.dataparser.dataparser import load_scan, scan_fingerprint, scan_root
from sl_nerfstudio.errors import UserError, first_line, last_line
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.model.model import SLModelConfig
from sl_nerfstudio.model.optimisers import DecaySchedulerConfig, FusedAdamOptimizerConfig, RowAdamOptimizerConfig
from sl_nerfstudio.model.outputs import TrainedModel
from sl_nerfstudio.model.pipeline import SLPipeline, SLPipelineConfig, require_together
from sl_nerfstudio.model.run_files import (
    POSE_OPTIMIZERS,
    Checkpoint,
    checkpoints_in,
    read_checkpoint,
    settings_fingerprint,
)
from sl_nerfstudio.model.trainer import SLTrainerConfig
from sl_nerfstudio.parallel import DeviceName, usable_device
from sl_nerfstudio.scan import read_scan

# config.yml of a run, read without running anything from it: only the settings of this package's runs are made.
#
# nerfstudio writes config.yml with YAML tags that name Python classes, and its own loader calls whatever they
# name. Here a tag may name a class of `_expected()`, a path or an enumeration's value; anything else is refused.

_MOST_BYTES = 1 << 20  # a configuration has some ten thousand
_PYTHON = "tag:yaml.org,2002:python/"


def read_config(path: Path) -> SLTrainerConfig:
    """The settings of a run. Raises UserError, with the line, for anything else and for names that are not settings."""
    if not path.is_file():
        raise UserError(
            f"--load-config {path}: no such file\n"
            "    cause:  the path is mistyped, or the training never started\n"
            "    remedy: give the config.yml that ns-train prints at the end: outputs/SCAN/sl-neus/DATE/config.yml"
        )
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it has {path.stat().st_size / 1e6:.0f} MB")
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=_ConfigLoader)
    except _NotExpected as error:
        if error.earlier:
            raise UserError(
                f"{path}, line {error.line}: this run was trained by an earlier version of this package\n"
                f"    cause:  {error.problem}\n"
                "    remedy: train again with this version, which reads the scan folder as before, or open it with "
                "the one that trained it"
            ) from error
        raise UserError(
            f"{path}, line {error.line}: {error.problem}\n"
            "    cause:  it is not a run of sl-neus or sl-neus-paper, is of another version of this package, or "
            "was edited, perhaps to run code here\n"
            "    remedy: give an untouched config.yml of ns-train sl-neus; use ns-export for other methods, if you "
            "trust where the file comes from"
        ) from error
    except (yaml.YAMLError, ValueError, LookupError, TypeError, AttributeError, RecursionError, OSError) as error:
        raise UserError(
            f"{path}{_line(error)}: cannot be read as a training configuration ({_reason(error)})\n"
            "    cause:  the file is damaged, or something else\n"
            "    remedy: give an untouched config.yml that ns-train wrote"
        ) from error
    if not isinstance(config, SLTrainerConfig):
        raise UserError(f"{path}: is not a training configuration\n    remedy: give the config.yml that ns-train wrote")
    return config


def _line(error: Exception) -> str:
    mark = getattr(error, "problem_mark", None)
    return "" if mark is None else f", line {mark.line + 1}"


def _reason(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return "nested too deeply"
    words = getattr(error, "problem", None) or first_line(error)
    return str(words)[:200]


class _NotExpected(Exception):
    """A tag, a setting or a value that no configuration of this package has."""

    def __init__(self, node: yaml.Node, problem: str, earlier: bool = False) -> None:
        """`earlier`: it is a class or a setting that this package no longer has."""
        self.line, self.problem, self.earlier = node.start_mark.line + 1, problem, earlier


@dataclass(frozen=True)
class _Expected:
    """What may be named, by "module.name"."""

    settings: Mapping[str, Any]  # an instance with its defaults
    targets: Mapping[str, type]  # what settings are for: models, optimisers, loggers
    enums: Mapping[str, type[enum.Enum]]


@cache
def _expected() -> _Expected:
    """Everything that occurs in a configuration with every kind of setting."""
    groups = (FusedAdamOptimizerConfig(), RowAdamOptimizerConfig(), DecaySchedulerConfig())
    pipeline = SLPipelineConfig(datamanager=SLDataManagerConfig(), model=SLModelConfig())
    whole = SLTrainerConfig(pipeline=pipeline, optimizers={str(i): group for i, group in enumerate(groups)})
    found = list(_parts(whole))
    return _Expected(
        {_name(type(part)): part for part in found if is_dataclass(part) and not isinstance(part, type)},
        {_name(part): part for part in found if isinstance(part, type)},
        {_name(type(part)): type(part) for part in found if isinstance(part, enum.Enum)},
    )


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__name__}"


def _is_ours(name: str) -> bool:
    return name.startswith(f"{__name__.partition('.')[0]}.")


def _parts(value: Any) -> Iterator[Any]:
    yield value
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, dict | types.MappingProxyType):
        for item in value.values():
            yield from _parts(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _parts(item)


class _ConfigLoader(yaml.SafeLoader):
    """PyYAML's safe loader, which knows plain values only, and the classes above."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse merge keys (`<<`): ns-train writes none, and nested ones grow without bound."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise _NotExpected(key, "`<<` is not a setting")

    def settings(self, name: str, node: yaml.Node) -> Any:
        """An instance of an expected class, with exactly its fields and with values of their types."""
        if _is_ours(name) and name not in _expected().settings:
            raise _NotExpected(node, f"there is no class {name} of settings any more", earlier=True)
        if name not in _expected().settings or not isinstance(node, yaml.MappingNode):
            raise _NotExpected(node, f"{name} is not a class of settings that is expected here")
        kind = type(_expected().settings[name])
        values = self.construct_mapping(node, deep=True)
        names, hints = [field.name for field in fields(kind)], _hints(name)
        for key, item in node.value:
            if key.value not in names:
                raise _NotExpected(key, f"{kind.__name__} has no setting {key.value!r}", earlier=_is_ours(name))
            if not _fits(values[key.value], hints[key.value]):
                raise _NotExpected(item, f"{values[key.value]!r:.100} is no value for {kind.__name__}.{key.value}")
        missing = [name for name in names if name not in values and name not in POSE_OPTIMIZERS]
        if missing:
            raise _NotExpected(node, f"{kind.__name__} lacks the setting {missing[0]!r}")
        made = object.__new__(kind)
        made.__dict__.update(values)
        return made

    def called(self, name: str, node: yaml.Node) -> Any:
        """A path, or the value of an enumeration."""
        given = self.construct_sequence(node, deep=True) if isinstance(node, yaml.SequenceNode) else None
        if given is not None and all(isinstance(part, str) for part in given):
            if name in ("pathlib.PosixPath", "pathlib._local.PosixPath"):
                return PosixPath(*given)
            if name in _expected().enums and len(given) == 1:
                return _expected().enums[name](given[0])
        raise _NotExpected(node, f"{name} is not a part of a training's settings")

    def named(self, name: str, node: yaml.Node) -> type:
        """One of the classes that settings are for."""
        if _is_ours(name) and name not in _expected().targets:
            raise _NotExpected(node, f"there is no class {name} any more", earlier=True)
        if name not in _expected().targets:
            raise _NotExpected(node, f"{name} is not a class that is expected here")
        return _expected().targets[name]

    def other(self, tag: str, node: yaml.Node) -> Any:
        """Any other tag for Python."""
        raise _NotExpected(node, f"{tag} is not a part of a training's settings")


_ConfigLoader.add_constructor(
    f"{_PYTHON}tuple", lambda loader, node: tuple(loader.construct_sequence(cast(Any, node), deep=True))
)
_ConfigLoader.add_multi_constructor(f"{_PYTHON}object:", _ConfigLoader.settings)
_ConfigLoader.add_multi_constructor(f"{_PYTHON}object/apply:", _ConfigLoader.called)
_ConfigLoader.add_multi_constructor(f"{_PYTHON}name:", _ConfigLoader.named)
_ConfigLoader.add_multi_constructor("", _ConfigLoader.other)


@cache
def _hints(name: str) -> dict[str, Any]:
    """Types of a class's fields; for `_target`, the one class that belongs there."""
    default = _expected().settings[name]
    found = get_type_hints(type(default))
    return {**found, "_target": Literal[default._target]} if "_target" in found else found


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value has a type; unknown kinds of types are not checked."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in arguments)
    if origin is Literal:
        return any(value == part and type(value) is type(part) for part in arguments)
    if origin is dict:
        return isinstance(value, dict) and all(_fits(item, arguments[1]) for item in value.values())
    if origin is tuple:
        each = [arguments[0]] * len(value) if isinstance(value, tuple) and Ellipsis in arguments else arguments
        return isinstance(value, tuple) and len(value) == len(each) and all(map(_fits, value, each))
    if hint is Any:
        return True
    if hint is None:
        return value is None
    if hint is float:
        return isinstance(value, float | int) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, hint) if isinstance(hint, type) and origin is None else True


# A finished training run, loaded for export on the GPU if there is one, else on the CPU.

_SAME_SCENE = 1e-3  # scene units: far above the rounding of float32, far below what is visible


@dataclass(frozen=True)
class TrainedRun:
    """A model with the settings it was trained under."""

    model: TrainedModel
    config: Any  # nerfstudio's TrainerConfig
    step: int


def load_run(config_path: Path | str, data: Path | None = None, device: DeviceName | None = None) -> TrainedRun:
    """Load the last checkpoint of the run that `config_path` (config.yml) describes.

    nerfstudio's own `eval_setup` fails with assertions or tracebacks if files were moved or truncated. Here a run whose
    folder was moved is found next to its config.yml, and `data` gives the scan folder if that was moved. By default
    the model is on the GPU if there is one that works.
    Raises UserError for anything missing, broken or made by another method.
    """
    path = config_file(Path(config_path))
    config: Any = read_config(path)
    checkpoint = read_checkpoint(last_checkpoint(config, path))
    if checkpoint.step < 0:
        raise UserError(
            f"{checkpoint.path}: holds adjusted poses, but no surface yet\n"
            "    cause:  the training was interrupted before its first step\n"
            f"    remedy: go on: ns-train {config.method_name} --load-config {path}"
        )
    require_settings(path, config)
    root = _scan_folder(config, data)
    if not (root / "transforms.json").is_file():
        cause = "the path is mistyped" if data else "the scan was moved, renamed or deleted after the training"
        raise UserError(
            f"{root}: has no transforms.json, so it is not the scan that the run was trained on\n"
            f"    cause:  {cause}\n    remedy: give its folder: --data FOLDER"
        )
    config.pipeline.datamanager.data = root
    device, _ = usable_device(device)
    parser = config.pipeline.datamanager.dataparser
    loaded = load_scan(root, parser.intrinsics_change, parser.length_factor)
    require_together(config.pipeline, checkpoint.weights, root, loaded.fingerprint)
    pipeline: Any = SLPipeline(config.pipeline, device, test_mode="inference")
    _require_same_keys(checkpoint.path, checkpoint.weights, pipeline.state_dict())
    try:
        pipeline.load_pipeline(checkpoint.weights, checkpoint.step)
    except RuntimeError as error:
        raise UserError(
            f"{checkpoint.path}: does not fit the settings in {path} ({last_line(error)})\n"
            "    cause:  another version of this package was used\n"
            "    remedy: use the version that trained it, or train again"
        ) from error
    pipeline.eval()
    _require_same_scene(path.absolute().parent / "dataparser_transforms.json", pipeline.model.S_scene_world)
    return TrainedRun(pipeline.model, config, checkpoint.step)


def config_file(path: Path) -> Path:
    """The config.yml of a run, given it or its folder."""
    return path / "config.yml" if path.is_dir() else path


def require_settings(path: Path, config: Any) -> None:
    """Raise UserError if settings in config.yml that decide the result were edited after the run began."""
    if settings_fingerprint(config) != config.pipeline.settings_fingerprint:
        raise UserError(
            f"{path}: its settings are not those that the run was started with\n"
            "    cause:  the file was edited, or written by another version of this package\n"
            "    remedy: put back the original file, or train again with the settings that you want"
        )


def last_checkpoint(config: Any, path: Path) -> Path:
    """The last checkpoint next to config.yml, or where the settings put it if there is none. Raises UserError."""
    folders = [path.absolute().parent / config.relative_model_dir, config.get_checkpoint_dir()]
    for folder in folders:
        found = checkpoints_in(folder)
        if found:
            return found[-1]
    raise UserError(
        f"{folders[0]}: no checkpoint step-*.ckpt\n"
        "    cause:  the training was interrupted before its first checkpoint, or its folder was moved\n"
        "    remedy: train again, or put nerfstudio_models/ back next to config.yml"
    )


def _scan_folder(config: Any, data: Path | None = None) -> Path:
    return scan_root(data or config.pipeline.datamanager.data or config.pipeline.datamanager.dataparser.data)


def _require_same_keys(path: Path, stored: Iterable[str], wanted: Iterable[str]) -> None:
    """Raise UserError if weights are missing: nerfstudio would silently keep their initial values."""
    missing = {_plain(key) for key in wanted} - {_plain(key) for key in stored}
    if missing:
        raise UserError(
            f"{path}: lacks {len(missing)} of the model's weights, such as {min(missing)}\n"
            "    cause:  it was written by another version of this package, or with other settings\n"
            "    remedy: use the version that trained it, or train again"
        )


def _require_same_scene(path: Path, S_scene_world: Similarity) -> None:
    """Raise UserError if the scan now gives another scene frame than the one nerfstudio stored in training."""
    try:
        stated = json.loads(path.read_text(encoding="utf-8"))
        trained = stated["scale"] * np.array(stated["transform"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError):
        return  # without that file there is nothing to compare with
    corners = S_scene_world.inverse().points(np.array(list(product((-1.0, 1.0), repeat=3))))
    moved = corners @ trained[:, :3].T + trained[:, 3] - S_scene_world.points(corners)
    if np.abs(moved).max() > _SAME_SCENE:
        raise UserError(
            f"{path}: the scan has another place in the scene than in the training "
            f"(off by {np.abs(moved).max():.2g} of the scene's radius)\n"
            "    cause:  the file was edited, or another version of this package made the run\n"
            "    remedy: put back the file, use the version that trained it, or train again"
        )


def _plain(key: str) -> str:
    return key.replace("module.", "")  # added by training on several GPUs


@dataclass(frozen=True)
class RunCheck:
    """A run without faults."""

    folder: Path
    config: Any  # SLTrainerConfig
    last: Checkpoint
    checkpoints: int
    scan: Path
    has_scan: bool  # False: the scan is not on this machine, and was not compared


def check_run(path: Path) -> RunCheck:
    """Check the config.yml at `path` or in that folder, its checkpoints, and that they and the scan belong together.

    Raises UserError, with everything that is wrong once config.yml could be read.
    """
    file = config_file(path)
    config: Any = read_config(file)
    saved = checkpoints_in(last_checkpoint(config, file).parent)
    faults: list[str] = []
    good: list[Checkpoint] = []
    for checkpoint in saved:
        try:
            good.append(read_checkpoint(checkpoint))
        except UserError as error:
            faults.append(str(error))
    scan = _scan_folder(config)
    there = (scan / "transforms.json").is_file()
    fingerprint = scan_fingerprint(read_scan(scan)) if there else config.pipeline.scan_fingerprint
    named = ""
    try:
        require_settings(file, config)
        for checkpoint in good:
            named = f"{checkpoint.path}: "
            require_together(config.pipeline, checkpoint.weights, scan, fingerprint)
    except UserError as error:
        faults.append(f"{named}{error}")
    if faults:
        raise UserError("\n".join(faults))
    return RunCheck(file.absolute().parent, config, good[-1], len(saved), scan, there)
