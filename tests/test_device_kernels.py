"""Kernels for GPUs: all of them compile for a GPU, without one, and nobody else imports Warp."""

import ast
import importlib
import re
from pathlib import Path

import pytest
import torch
import warp

from sl_nerfstudio.field.device_kernels import obstacle

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sl_nerfstudio"
KERNELS = [PACKAGE / name for name in ("field/warp_kernels.py", "rendering/warp_kernels.py", "model/warp_step.py")]
USERS = {PACKAGE / name for name in ("field/warp_backend.py", "rendering/warp_step.py", "model/warp_step.py")}


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: module_of(path).removeprefix("sl_nerfstudio."))
def test_kernels_compile_for_gpus(path: Path, tmp_path: Path) -> None:
    module = importlib.import_module(module_of(path))
    if warp.get_module(module.__name__).kernels:
        (file,) = warp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
        assert file.suffix == ".ptx" and file.stat().st_size > 5_000


def test_only_kernels_and_what_launches_them_import_warp() -> None:
    """Its import takes half a second, and it is an extra."""
    for path in set(PACKAGE.rglob("*.py")) - USERS - set(KERNELS) - {PACKAGE / "field/device_kernels.py"}:
        for node in ast.parse(path.read_text()).body:  # imports in functions are done when they are needed
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [name.name for name in node.names] if isinstance(node, ast.Import) else []
            launching = {module_of(user) for user in USERS} | {"sl_nerfstudio.field.device_kernels"}
            assert not [name for name in names if name.split(".")[0] == "warp" or name in launching], path
            assert not [name for name in names if ".warp_kernels" in name], path


def test_a_driver_that_warp_cannot_use_is_said_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warp, "is_cuda_available", lambda: False)
    assert re.search("no driver for cuda .*R580 or newer.*[+]cu12", obstacle(torch.device("cuda")) or "")
    assert obstacle(torch.device("cpu")) is None
