"""Kernels for GPUs compile for a GPU, without one, and nobody else imports Triton."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.dataparser.tiny_scan import TinyScan

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sl_nerfstudio"


@pytest.mark.slow
def test_all_kernels_compile_for_three_architectures_with_few_registers_and_hardly_a_spill(tmp_path: Path) -> None:
    scan, output = TinyScan(undecoded=0.2).write(tmp_path / "sphere"), tmp_path / "kernels.json"
    command = [sys.executable, "-m", "benchmarks.kernels", "--scan", scan, "--output", output]
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    subprocess.run(command, cwd=ROOT, env=environment | {"TRITON_CACHE_DIR": str(tmp_path / "cache")}, check=True)
    rows = json.loads(output.read_text())["rows"]
    names = {row["kernel"] for row in rows}
    for row in rows:
        assert row["registers"] <= 128 and row["spills"] <= 16, row
        if row["kernel"] in ("encode", "to_points", "row_adam") or (row["kernel"], row["architecture"]) == (
            "scatter",
            90,
        ):
            assert row["vectors"] >= 8, row  # rows of eight features are read, and on sm_90 added, as two vectors
    for architecture in (80, 89, 90):
        assert {row["kernel"] for row in rows if row["architecture"] == architecture} == names
    defined = {
        node.name
        for file in ("field/triton_backend.py", "rendering/triton_poses.py", "rendering/triton_kernels.py")
        for node in ast.parse((PACKAGE / file).read_text()).body
        if isinstance(node, ast.FunctionDef) and node.decorator_list and not node.name.startswith("_")
    }
    assert defined == names  # none is forgotten


def test_only_kernels_and_what_launches_them_import_triton() -> None:
    """Machines without it use plain torch, and its import takes half a second."""
    for path in PACKAGE.rglob("*.py"):
        if path.name.startswith("triton_") or path.name == "kernel_step.py":
            continue
        for node in ast.parse(path.read_text()).body:  # imports in functions are done when they are needed
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [name.name for name in node.names] if isinstance(node, ast.Import) else []
            assert not [name for name in names if "triton" in name or name.endswith("kernel_step")], path
