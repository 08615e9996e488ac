"""The benchmarks for GPUs run to their end without one."""

import json

import pytest

from benchmarks import gpu, launches
from benchmarks.common.training import settings

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
