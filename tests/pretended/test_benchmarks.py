"""The benchmarks for GPUs run to their end without one."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import gpu, launches
from benchmarks.common.training import settings

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely


@pytest.mark.slow
def test_launches_and_waits_of_a_step_are_counted(tiny_root, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(launches, "_COUNTED", 2)
    output = tmp_path / "launches.json"
    config = launches.Config(tiny_root, ("paper",), ("triton",), rays=16, output=output)
    (row,) = launches.main(config)
    assert row.waits == 0 and 0 < row.of_triton < row.launches <= row.most < 100
    assert row.with_graph < 20 and row.between < 5
    assert json.loads(output.read_text())["rows"][0]["launches"] == row.launches == sum(row.by_name.values())
    assert "triton encode" in capsys.readouterr().out


@pytest.mark.slow
def test_everything_about_a_gpu_can_be_tried_on_the_cpu(tiny_root, tmp_path, monkeypatch):
    """With a smaller field, on a scan without a truth."""

    def small(*arguments):
        config = settings(*arguments)
        config.pipeline.datamanager.train_num_rays_per_batch = 16
        config.pipeline.model.sampling.eikonal_points = 16
        return config

    monkeypatch.chdir(tmp_path)
    for name, stand_in in {
        "settings": small,
        "encoding_times": lambda *_: 1 / 0,
        "rmse": lambda *_: {"rmse_mm": 0.1},
    }.items():
        monkeypatch.setattr(gpu, name, stand_in)
    only = ("kernels", "step paper numba", "surface paper cpu", "encoding lean nerfstudio", "resume default")
    config = gpu.Config("cpu", tiny_root, steps=1, compared_steps=1, only=only)
    found = gpu.main(config)
    assert max(found["kernels"]["numba"]) < 1e-4
    assert found["step paper numba"]["loop_ms"] > 0 and found["surface paper cpu"]["rmse_mm"] == 0.1
    assert found["resume default"] == {"steps": 1, "resumed": 0.0, "in_one_go": 0.0}
    assert found["encoding lean nerfstudio torch"]["error"] == "division by zero"  # the others are still measured
    assert json.loads((tmp_path / config.output).read_text()) == found
    names = set(gpu.parts(gpu.Config(), tmp_path))  # on a GPU
    assert {"step paper triton graph", "step default torch", "surface default cuda", "surface default cpu"} <= names
    assert "surface paper 10000 steps" in names and "encoding paper nerfstudio torch" in names


@pytest.mark.slow
def test_all_kernels_compile_for_three_architectures_with_few_registers_and_hardly_a_spill(tiny_root, tmp_path):
    output = tmp_path / "kernels.json"
    command = [sys.executable, "-m", "benchmarks.kernels", "--scan", tiny_root, "--output", output]
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    subprocess.run(command, cwd=ROOT, env=environment | {"TRITON_CACHE_DIR": str(tmp_path / "cache")}, check=True)
    rows = json.loads(output.read_text())["rows"]
    names = {row["kernel"] for row in rows}
    for row in rows:
        assert row["registers"] <= 128 and row["spills"] <= 16, row
        added = row["kernel"] == "scatter" and row["architecture"] == 90
        if added or row["kernel"] in ("encode", "to_points", "row_adam"):
            assert row["vectors"] >= 8, row  # rows of eight features are read, and on sm_90 added, as two vectors
    for architecture in (80, 89, 90):
        assert {row["kernel"] for row in rows if row["architecture"] == architecture} == names
    defined = {
        node.name
        for file in ("field/triton_backend.py", "rendering/triton_poses.py", "rendering/triton_kernels.py")
        for node in ast.parse((ROOT / "sl_nerfstudio" / file).read_text()).body
        if isinstance(node, ast.FunctionDef) and node.decorator_list and not node.name.startswith("_")
    }
    assert defined == names  # none is forgotten
