"""The flags of a command: read by tyro, explained by --help as wide as the terminal, and files that must be there."""

import ast
import dataclasses
import difflib
import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from sl_nerfstudio.errors import UserError

T = TypeVar("T")
Groups = Mapping[str, Sequence[str]]
"""Titles of groups of flags, with the names of their fields."""


def parse(kind: type[T], command: str, inputs: Mapping[str, str] | None = None, groups: Groups | None = None) -> T:
    """Read the command line into a dataclass, whose fields are the flags and whose docstrings explain them.

    `inputs`: fields with paths that must exist, and what they should be. With --help, prints the help and exits. Raises
    UserError for paths that lead nowhere, before anything slow is imported.
    """
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(help_text(kind, command, groups or {}, shutil.get_terminal_size().columns))
        raise SystemExit(0)
    import tyro

    found = tyro.cli(kind, prog=command, config=(tyro.conf.OmitArgPrefixes,))
    names = {flag.field: flag.words.partition(" ")[0] for flag in flags_of(kind)}  # of positional ones, what they are
    require_paths({names[name]: (getattr(found, name), remedy) for name, remedy in (inputs or {}).items()})
    return found


def flag_name(field: str) -> str:
    """The flag of a field."""
    return "--" + field.replace("_", "-")


def given_flags(config: Any, without: Collection[str] = ()) -> list[str]:
    """The flags that give a configuration, for a command to copy, but for the fields `without`."""
    words: list[str] = []
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in without or (field.default is not dataclasses.MISSING and value == field.default):
            continue
        words.append(flag_name(field.name))
        if not isinstance(value, bool):
            words += map(str, value if isinstance(value, tuple) else (value,))
    return words


# --help: required flags first, then groups; lines are as wide as the terminal.

_WIDEST = 120
_COLUMN = 26  # at which explanations begin
_VALUES = {Path: "PATH", int: "INT", float: "FLOAT", str: "TEXT"}


@dataclass(frozen=True)
class Flag:
    """A flag as --help shows it."""

    field: str
    words: str  # its name and its value
    text: str
    required: bool


def help_text(kind: type, command: str, groups: Groups, columns: int) -> str:
    """Explain a command and all of its flags in lines of at most `columns`; flags that no group names come last."""
    width, flags = min(columns, _WIDEST), list(flags_of(kind))
    required = [flag for flag in flags if flag.required]
    optional = {flag.field: flag for flag in flags if not flag.required}
    usage = " ".join(["usage:", command, *(flag.words for flag in required), "[flags]"])
    parts = [textwrap.fill(usage, width, subsequent_indent=" " * 10, break_on_hyphens=False)]
    paragraphs = inspect.cleandoc(kind.__doc__ or "").split("\n\n")
    parts += [textwrap.fill(" ".join(text.split()), width, break_on_hyphens=False) for text in paragraphs]
    sections = {"required": required}
    sections |= {title: [optional.pop(name) for name in names] for title, names in groups.items()}
    rest = [*optional.values(), Flag("help", "-h, --help", "show this text", False)]
    sections["others" if groups else "flags"] = rest
    for title, found in sections.items():
        if found:
            parts.append("\n".join([f"{title}:", *(_explained(flag, width) for flag in found)]))
    return "\n\n".join(parts)


def _explained(flag: Flag, width: int) -> str:
    head = f"  {flag.words}"
    lines = textwrap.wrap(flag.text, max(width - _COLUMN, 20), break_on_hyphens=False)
    if len(head) < _COLUMN:
        return "\n".join([f"{head:<{_COLUMN}}{lines[0]}", *(" " * _COLUMN + line for line in lines[1:])])
    words = flag.words if len(head) <= width else flag.words.replace(",", ", ")  # many choices
    heads = textwrap.wrap(words, width - 2, subsequent_indent="    ", break_on_hyphens=False)
    return "\n".join([*(f"  {line}" for line in heads), *(" " * _COLUMN + line for line in lines)])


def flags_of(kind: type) -> Iterator[Flag]:
    """The flags of a dataclass, those of a dataclass inside it among them."""
    import tyro

    hints, texts = get_type_hints(kind, include_extras=True), _docstrings(kind)
    for field in dataclasses.fields(kind):
        hint, default = hints[field.name], field.default
        bare = get_args(hint)[0] if get_origin(hint) is Annotated else hint
        if dataclasses.is_dataclass(bare):
            yield from flags_of(bare)  # type: ignore[arg-type]
            continue
        positional = tyro.conf.Positional in getattr(hint, "__metadata__", ())
        required = positional or default in (dataclasses.MISSING, tyro.MISSING)
        text = texts[field.name]
        if not (required or default is None or isinstance(default, bool) or default == () or "default:" in text):
            said = " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
            text += f" (default: {said})"
        name = flag_name(f"no_{field.name}" if default is True else field.name)
        values = "" if bare is bool else _values(hint)
        yield Flag(field.name, values if positional else f"{name} {values}".strip(), text, required)


def _docstrings(kind: type) -> dict[str, str]:
    """The strings below the fields of a class, each as one line."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    found = {}
    for field, text in pairwise(tree.body[0].body):  # type: ignore[attr-defined]
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            found[field.target.id] = " ".join(str(text.value.value).split())  # type: ignore[union-attr]
    return found


def _values(hint: Any) -> str:
    """What is to be typed for a type; a flag that is left out needs no word for None."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        named = [found for extra in inner[1:] if (found := getattr(extra, "metavar", None))]
        return named[0] if named else _values(inner[0])
    if origin is Literal:
        return f"{{{','.join(map(str, inner))}}}"
    if origin in (Union, UnionType):
        return "|".join(_values(one) for one in inner if one is not type(None))
    if origin is tuple:
        return f"{_values(inner[0])} .." if inner[-1] is Ellipsis else " ".join(map(_values, inner))
    return _VALUES[hint]


# Paths that lead nowhere, named before the imports that take seconds.

SCAN = "give the folder that holds transforms.json"
CONFIG = "give the config.yml that ns-train prints at the end: outputs/SCAN/sl-neus/DATE/config.yml"
PHOTOGRAPHS = {
    "pattern": "give the pattern.json that sl-pattern wrote, or the projector's resolution, as 1024x768",
    "intrinsics": "give the file with the intrinsics; sl-calibrate makes one",
    "masks": "give the folder with one mask for each frame",
    "color": "give the folder with the photographs without the pattern",
}
"""What those flags should be that go with photographs."""


def require_paths(paths: Mapping[str, tuple[Path | None, str]]) -> None:
    """Raise UserError that names every path that does not exist, by its flag, with what is there instead.

    Each path comes with what it should be. A pattern that is a resolution (1024x768) is no path.
    """
    faults = [
        _missing(flag, path, remedy)
        for flag, (path, remedy) in paths.items()
        if path is not None and not os.path.exists(path) and not re.fullmatch(r"\d+[xX×]\d+", str(path))
    ]
    if faults:
        raise UserError("\n".join(faults))


def _missing(flag: str, path: Path, remedy: str) -> str:
    known = path.absolute()
    while not os.path.isdir(known.parent):  # Path.is_dir raises for a name that is too long
        known = known.parent
    try:
        names = os.listdir(known.parent)
    except OSError:
        names = []
    alike = difflib.get_close_matches(known.name, [name for name in names if not name.startswith(".")], 1, 0.7)
    cause = "a typing error" + ("" if path.is_absolute() else f", or another folder than {Path.cwd()}")
    if alike:
        cause = f"a typing error: {known.parent / alike[0]} is there"
    problem = "there is no such file or folder" + ("" if known == path.absolute() else f", and no {known}")
    return f"{flag} {path}: {problem}\n    cause:  {cause}\n    remedy: {remedy}"
