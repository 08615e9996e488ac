"""The layout: folders in the order of the data, no import cycles, nerfstudio only where it is allowed."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sl_nerfstudio"

# What CONTRIBUTING lists, in the order in which data passes through it: each imports only from itself and from before.
_TEXT = (ROOT / "CONTRIBUTING.md").read_text()
_LISTED = _TEXT[_TEXT.index("    sl_nerfstudio/\n") : _TEXT.index("    tests/ ")]
LAYERS = re.findall(r"^ {6}(\w+)(?:/|\.py) ", _LISTED, re.MULTILINE)
PLUGIN = {"dataparser", "model", "methods"}  # nerfstudio's import takes ten seconds
MODULES = sorted(PACKAGE.rglob("*.py"))


def imports(text: str, path: Path) -> Iterator[str]:
    """Absolute names of all modules that a file imports, anywhere in it and for any purpose, including types."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = path.relative_to(ROOT).with_suffix("").parts[: -node.level]
                base = ".".join((*package, *filter(None, [node.module])))
            for name in node.names:  # `from package import module` imports that module
                inner = f"{base}.{name.name}"
                yield inner if base.startswith("sl_nerfstudio") and file_of(inner) else base


def file_of(module: str) -> Path | None:
    """The file of a module of the package; None if there is no such module."""
    stem = ROOT.joinpath(*module.split("."))
    return next((f for f in (stem.with_suffix(".py"), stem / "__init__.py") if f.exists()), None)


def layer(path: Path) -> str:
    """The folder (or file) directly below the package that contains a file."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


@cache
def imported() -> dict[Path, set[str]]:
    """The names that each file of the package imports."""
    return {path: set(imports(path.read_text(), path)) for path in MODULES}


@cache
def neighbours() -> dict[Path, set[Path]]:
    """The files of the package that each of them imports."""
    return {
        path: {file for name in names if name.startswith("sl_nerfstudio") and (file := file_of(name))} - {path}
        for path, names in imported().items()
    }


def test_folders_import_only_from_those_before_them():
    assert sorted({layer(path) for path in MODULES} - {"__init__"}) == sorted(LAYERS)
    wrong = [
        f"{path.relative_to(PACKAGE)} imports {file.relative_to(PACKAGE)}"
        for path, files in neighbours().items()
        for file in files - {PACKAGE / "__init__.py"}
        if layer(path) != "__init__" and LAYERS.index(layer(file)) > LAYERS.index(layer(path))
    ]
    assert not wrong, wrong
    assert {
        layer(path) for path, names in imported().items() if "nerfstudio" in {n.split(".")[0] for n in names}
    } == PLUGIN


def test_no_files_import_each_other_in_a_cycle():
    """Depth first; a file that is reached again while its imports are still being followed closes a cycle."""
    done: set[Path] = set()

    def follow(path: Path, way: tuple[Path, ...]) -> None:
        circle = [str(p.relative_to(PACKAGE)) for p in way[way.index(path) :]] if path in way else []
        assert not circle, " -> ".join([*circle, circle[0]])
        if path not in done:
            for other in sorted(neighbours()[path]):
                follow(other, (*way, path))
            done.add(path)

    for module in MODULES:
        follow(module, ())
    assert done == set(MODULES)


def test_imports_for_types_inside_functions_and_relative_ones_count():
    text = (
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from sl_nerfstudio.scan import types\n"
        "def f():\n    import sl_nerfstudio.errors\n    from . import lie\n"
    )
    found = set(imports(text, PACKAGE / "geometry" / "some.py"))
    assert found == {"typing", "sl_nerfstudio.scan.types", "sl_nerfstudio.errors", "sl_nerfstudio.geometry.lie"}


def test_only_kernels_and_what_launches_them_import_triton() -> None:
    """Machines without it use plain torch, and its import takes half a second."""
    for path in MODULES:
        if path.name.startswith("triton_") or path.name == "kernel_step.py":
            continue
        for node in ast.parse(path.read_text()).body:  # imports in functions are done when they are needed
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [name.name for name in node.names] if isinstance(node, ast.Import) else []
            assert not [name for name in names if "triton" in name or name.endswith("kernel_step")], path
