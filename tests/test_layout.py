"""The layout: folders in the order of the data, no import cycles, small files, nerfstudio only where it is allowed."""

import ast
import importlib.util
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sl_nerfstudio"

# Folders in the order in which data passes through them: each imports only from itself and from those before it.
LAYERS = (
    "errors", "console", "progress", "control_groups", "cores", "memory", "threads", "side_by_side", "compiled",
    "late_compiler", "device_kernels", "files", "geometry", "scan", "pattern", "synthesis", "decoding", "capture",
    "calibration", "relative_pose", "matching", "registration", "bundle_adjustment", "verdict", "object_separation",
    "processing", "field", "rendering", "meshing", "dataparser", "model", "runs", "redecoding", "evaluation", "cli",
    "methods", "__main__",
)  # fmt: skip
PLUGIN = {"dataparser", "model", "methods"}  # nerfstudio's import takes ten seconds
MOST_LINES, MOST_FILES = 400, 20
MODULES = sorted(PACKAGE.rglob("*.py"))
FOLDERS = sorted({path.parent for folder in (PACKAGE, ROOT / "tests", ROOT / "benchmarks", ROOT / "training")
                  for path in folder.rglob("*.py")})  # fmt: skip

each_module = pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))


@cache
def imports(path: Path) -> tuple[str, ...]:
    """Absolute names of all modules that a file imports, anywhere in it and for any purpose, including types."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
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


def neighbours(path: Path) -> set[Path]:
    """Files of the package that a file imports."""
    return {file for name in imports(path) if (file := file_of(name)) and name.startswith("sl_nerfstudio")} - {path}


def test_every_folder_has_its_place_in_the_order():
    assert {layer(path) for path in MODULES} - {"__init__"} == set(LAYERS)


@each_module
def test_folders_import_only_from_those_before_them(path):
    own = layer(path)
    for file in neighbours(path) - {PACKAGE / "__init__.py"}:
        assert own == "__init__" or LAYERS.index(layer(file)) <= LAYERS.index(own), f"{own} must not import {file}"


def test_no_files_import_each_other_in_a_cycle():
    """Depth first; a file that is reached again while its imports are still being followed closes a cycle."""
    done: set[Path] = set()

    def follow(path: Path, way: tuple[Path, ...]) -> None:
        circle = [str(p.relative_to(PACKAGE)) for p in way[way.index(path) :]] if path in way else []
        assert not circle, " -> ".join([*circle, circle[0]])
        if path not in done:
            for other in sorted(neighbours(path)):
                follow(other, (*way, path))
            done.add(path)

    for module in MODULES:
        follow(module, ())
    assert done == set(MODULES)


def test_only_the_plugin_side_imports_nerfstudio():
    users = {layer(path) for path in MODULES if any(name.split(".")[0] == "nerfstudio" for name in imports(path))}
    assert users == PLUGIN


@each_module
def test_files_are_small(path):
    assert len(path.read_text().splitlines()) <= MOST_LINES


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_folders_are_small(folder):
    assert len(list(folder.glob("*.py"))) <= MOST_FILES


@pytest.mark.parametrize(
    "path", sorted(PACKAGE.rglob("__init__.py")), ids=lambda path: str(path.parent.relative_to(ROOT))
)
def test_every_folder_says_what_comes_in_and_goes_out(path):
    """About three sentences: what the folder is for, what goes in, what comes out."""
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    assert path.parent == PACKAGE or (text.count(".") >= 3 and "In:" in text and "Out:" in text), text


def test_this_test_finds_what_it_looks_for(tmp_path):
    """Imports for types, inside functions and relative ones count."""
    file = ROOT / "sl_nerfstudio" / "geometry" / "se3.py"
    assert file_of("sl_nerfstudio.geometry.se3") == file and file_of("sl_nerfstudio.nowhere") is None
    assert importlib.util.find_spec("sl_nerfstudio.geometry.se3").origin == str(file)
    text = (
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from sl_nerfstudio.scan import types\n"
        "def f():\n    import sl_nerfstudio.errors\n"
    )
    path = tmp_path / "some.py"
    path.write_text(text)
    assert set(imports(path)) == {"typing", "sl_nerfstudio.scan.types", "sl_nerfstudio.errors"}
