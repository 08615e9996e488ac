"""config.yml of a run, read without running anything from it: only the settings of this package's runs are made.

nerfstudio writes config.yml with YAML tags that name Python classes, and its own loader calls whatever they
name. Here a tag may name a class of `_expected()`, a path or an enumeration's value; anything else is refused.
"""

import enum
import types
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path, PosixPath
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

import yaml

from sl_nerfstudio.dataparser.datamanager import SLDataManagerConfig
from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.model.config import SLModelConfig
from sl_nerfstudio.model.optimisers import DecaySchedulerConfig, FusedAdamOptimizerConfig, RowAdamOptimizerConfig
from sl_nerfstudio.model.pipeline import SLPipelineConfig
from sl_nerfstudio.model.trainer import SLTrainerConfig

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
        config = yaml.load(path.read_text(encoding="utf-8"), Loader=_Loader)
    except _NotExpected as error:
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

    def __init__(self, node: yaml.Node, problem: str) -> None:
        self.line, self.problem = node.start_mark.line + 1, problem


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


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, which knows plain values only, and the classes above."""

    def flatten_mapping(self, node: yaml.MappingNode) -> None:
        """Refuse merge keys (`<<`): ns-train writes none, and nested ones grow without bound."""
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                raise _NotExpected(key, "`<<` is not a setting")

    def settings(self, name: str, node: yaml.Node) -> Any:
        """An instance of an expected class, with exactly its fields and with values of their types."""
        if name not in _expected().settings or not isinstance(node, yaml.MappingNode):
            raise _NotExpected(node, f"{name} is not a class of settings that is expected here")
        kind = type(_expected().settings[name])
        values = self.construct_mapping(node, deep=True)
        names, hints = [field.name for field in fields(kind)], _hints(name)
        for key, item in node.value:
            if key.value not in names:
                raise _NotExpected(key, f"{kind.__name__} has no setting {key.value!r}")
            if not _fits(values[key.value], hints[key.value]):
                raise _NotExpected(item, f"{values[key.value]!r:.100} is no value for {kind.__name__}.{key.value}")
        missing = [name for name in names if name not in values]
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
        if name not in _expected().targets:
            raise _NotExpected(node, f"{name} is not a class that is expected here")
        return _expected().targets[name]

    def other(self, tag: str, node: yaml.Node) -> Any:
        """Any other tag for Python."""
        raise _NotExpected(node, f"{tag} is not a part of a training's settings")


_Loader.add_constructor(
    f"{_PYTHON}tuple", lambda loader, node: tuple(loader.construct_sequence(cast(Any, node), deep=True))
)
_Loader.add_multi_constructor(f"{_PYTHON}object:", _Loader.settings)
_Loader.add_multi_constructor(f"{_PYTHON}object/apply:", _Loader.called)
_Loader.add_multi_constructor(f"{_PYTHON}name:", _Loader.named)
_Loader.add_multi_constructor("", _Loader.other)


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
