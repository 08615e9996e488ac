"""Guarantees of the whole package: entry points, commands and their help, dependencies, no network; types."""

import ast
import dataclasses
import importlib
import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_layout import imported

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sl_nerfstudio"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SCRIPTS: dict[str, str] = PROJECT["scripts"]

# Dependencies whose import name differs from the name of the distribution.
IMPORTED_AS = {
    "opencv-python-headless": "cv2", "pillow": "PIL", "pygame-ce": "pygame", "pyyaml": "yaml",
    "lazy-loader": "lazy_loader", "pillow-heif": "pillow_heif", "scikit-image": "skimage",
}  # fmt: skip


def distribution_name(requirement: str) -> str:
    return re.split(r"[\[<>=!~;\s]", requirement)[0].lower()


# ------------------------------------------------------------------ metadata


@pytest.mark.parametrize("group", ["nerfstudio.method_configs", "nerfstudio.dataparser_configs"])
def test_entry_points_load_under_their_registered_names(group):
    declared = PROJECT["entry-points"][group]
    found = {e.name: e for e in importlib.metadata.entry_points(group=group) if e.value in declared.values()}
    assert found.keys() == declared.keys()
    for name, entry in found.items():
        specification = entry.load()
        assert len(specification.description) > 10
        if group == "nerfstudio.method_configs":
            assert specification.config.method_name == name


def test_constraints_are_plain_pins_that_satisfy_the_declared_ranges():
    from packaging.requirements import Requirement

    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    pins = dict(line.split("==") for line in lines)
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.]+", line) for line in lines)
    assert len(pins) == len(lines)
    extras = PROJECT["optional-dependencies"]
    for text in PROJECT["dependencies"] + extras["dev"] + extras["docs"] + extras["render"]:
        requirement = Requirement(text)
        assert requirement.specifier.contains(pins[requirement.name]), text


def test_exactly_one_opencv():
    wheels = {d.name for d in importlib.metadata.distributions() if "opencv" in d.name.lower()}
    assert wheels == {"opencv-python-headless"}


def test_imported_packages_are_the_declared_dependencies():
    standard = sys.stdlib_module_names | {"sl_nerfstudio", "triton"}  # which comes with torch, if at all
    used = {name.split(".")[0] for names in imported().values() for name in names} - standard
    extras = [text for name, texts in PROJECT["optional-dependencies"].items()
              if name not in ("dev", "docs", "render") for text in texts]  # fmt: skip
    declared = {distribution_name(text) for text in PROJECT["dependencies"] + extras}
    assert used == {IMPORTED_AS.get(name, name) for name in declared}


def test_no_url_and_no_machine_path_in_the_code():
    for path in [*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.html*"), ROOT / "Makefile", ROOT / "constraints.txt"]:
        text = path.read_text()
        assert not re.search(r"https?://(?!www\.w3\.org/)", text), path
        assert not re.search(r"(?<![\w.])/(home|root|work|tmp|mnt)/", text), path


# ------------------------------------------------------------------ commands


def test_every_setting_of_the_methods_is_explained():
    """`ns-train sl-neus --help` shows the text below each field; nerfstudio's own fields are not checked."""
    for name, cls in config_classes():
        source = ast.parse(Path(sys.modules[cls.__module__].__file__ or "").read_text())
        body = next(node for node in ast.walk(source) if isinstance(node, ast.ClassDef) and node.name == name).body
        for statement, following in zip(body, [*body[1:], None], strict=True):
            if not isinstance(statement, ast.AnnAssign) or "Suppress" in ast.unparse(statement.annotation):
                continue
            field = ast.unparse(statement.target)
            if any(field in base.__annotations__ for base in cls.__mro__ if base.__module__.startswith("nerfstudio")):
                continue
            explained = isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            assert field == "_target" or explained, f"{name}.{field} has no text below it"


def config_classes() -> list[tuple[str, type]]:
    """Every settings class of this package that the methods use."""
    from sl_nerfstudio import methods

    found: dict[str, type] = {}

    def visit(value: object) -> None:
        if not dataclasses.is_dataclass(value) or isinstance(value, type):
            return
        for cls in type(value).__mro__:
            if cls.__module__.startswith("sl_nerfstudio"):
                found[cls.__name__] = cls
        for field in dataclasses.fields(value):
            visit(getattr(value, field.name))

    for specification in (methods.sl_neus, methods.sl_neus_paper):
        visit(specification.config)
        for entry in specification.config.optimizers.values():
            visit(entry["optimizer"])
            visit(entry["scheduler"])
    assert {"SLModelConfig", "SLDataManagerConfig", "SLDataParserConfig"} <= found.keys()
    return sorted(found.items())


# ------------------------------------------------------------------ types


_CALLS = """
import tests.conftest
import torch
from sl_nerfstudio.geometry.lie import inverse
inverse(torch.eye(4).expand(3, 4, 4))
try:
    inverse(torch.eye(3))
except Exception as error:
    print(type(error).__module__.split(".")[0])
"""


@pytest.mark.slow
def test_a_wrong_shape_is_refused_only_where_types_are_checked():
    def error_of(**environment: str) -> str:
        done = subprocess.run(
            [sys.executable, "-c", _CALLS], cwd=ROOT, env=os.environ | environment, capture_output=True, text=True
        )
        return done.stdout.strip()

    assert error_of(SL_TYPE_CHECKS="1") == "jaxtyping"
    assert error_of(SL_TYPE_CHECKS="") != "jaxtyping"
