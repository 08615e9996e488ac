"""Libraries are imported without what this package never uses, they still ask for it, and whoever needs it gets it."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from sl_nerfstudio.late_imports import _LEFT_OUT, begin_imports, compiler_on_demand, end_imports

LOAD = """
import sys
from pathlib import Path
from sl_nerfstudio.cli.run import load_run
try:
    load_run(Path("nothing.yml"), None)
except Exception as error:
    print(type(error).__name__, "torchvision.ops" in sys.modules, "torch._dynamo" in sys.modules)
from torchvision.ops.roi_align import is_compile_supported
print(is_compile_supported("meta"), "torch._dynamo" in sys.modules)
"""
OPEN3D = """
import sys
from sl_nerfstudio.late_imports import open3d
left_out = {left_out}
print(sorted({{"dash", "sklearn", "pandas", "plotly", *left_out}} & set(sys.modules)))
print(all(hasattr(open3d, part) for part in ("t", "geometry", "io", "core", "visualization")))
import open3d.visualization.draw_plotly
print("dash" in sys.modules)
"""
# What the libraries ask for at import; where they no longer do, the patch has become useless.
PLAIN = """
import sys
import {library}
print([name for name in {names} if name in sys.modules])
"""

JUDGING = """
import sys
import sl_nerfstudio.evaluation.evaluate
import sl_nerfstudio.evaluation.report.scan_report
print("nerfstudio" in sys.modules)
"""


def printed(code: str, folder: Path) -> list[str]:
    command = [sys.executable, "-W", "ignore", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder).stdout.splitlines()


@pytest.mark.slow
def test_loading_a_run_does_not_import_the_compiler_until_somebody_asks(tmp_path):
    assert printed(LOAD, tmp_path) == ["UserError True False", "False True"]


@pytest.mark.slow
def test_open3d_comes_without_its_web_viewer_until_somebody_asks(tmp_path):
    assert printed(OPEN3D.format(left_out=list(_LEFT_OUT)), tmp_path)[-3:] == ["[]", "True", "True"]


@pytest.mark.slow
def test_a_scan_is_judged_without_nerfstudio(tmp_path):
    assert printed(JUDGING, tmp_path) == ["False"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("library", "names"), [("torchvision", ["torch._dynamo"]), ("open3d", ["dash", "sklearn", "pandas", *_LEFT_OUT])]
)
def test_the_libraries_themselves_still_import_what_is_left_out(tmp_path, library, names):
    assert printed(PLAIN.format(library=library, names=names), tmp_path)[-1] == str(names)


def test_a_function_is_compiled_when_it_is_called_first(monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda model, **settings: asked.append(settings) or model)
    with compiler_on_demand():

        @torch.compile(dynamic=True)
        def twice(x: float) -> float:
            """Doubles."""
            return 2 * x

    assert not asked
    assert [twice(2.0), twice(3.0)] == [4.0, 6.0]
    assert asked == [{"dynamic": True}]
    assert twice.__doc__ == "Doubles."


COMMAND = """
import sys
sys.argv = {command}
import pytest
import torch
real = torch.compile
import nerfstudio.scripts.train
weight = torch.nn.Parameter(torch.ones(3))
optimizer = torch.optim.Adam([weight], fused=True)
optimizer.zero_grad()
weight.sum().backward()
optimizer.step()
torch.manual_seed(0)
print("torch._dynamo.eval_frame" in sys.modules, torch.compile is real, round(float(weight[0]), 6))
print(torch._dynamo.config.suppress_errors, "torch._dynamo.eval_frame" in sys.modules)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("command", "compiler"), [("/bin/ns-train sl-neus", False), ("ns-train splatfacto", True)])
def test_commands_of_this_package_go_without_the_compiler_until_somebody_asks(tmp_path, command, compiler):
    found = printed(COMMAND.format(command=command.split()), tmp_path)
    assert found[-2:] == [f"{compiler} True 0.999", "False True"]


@pytest.mark.parametrize(
    ("command", "compiler"),
    [
        (["/bin/ns-train", "sl-neus"], False),
        (["ns-train", "sl-neus-paper"], False),
        (["ns-train", "splatfacto"], True),
        (["ns-export", "poisson", "--load-config", "ours.yml"], False),
        (["ns-viewer", "--load-config=ours.yml"], False),
        (["ns-viewer", "--load-config", "other.yml"], True),
        (["ns-viewer", "--load-config", "missing.yml"], True),
        (["ns-viewer", "--load-config"], True),
        (["pytest", "--load-config", "ours.yml"], True),
    ],
)
def test_they_are_those_that_train_or_load_a_method_of_this_package(tmp_path, monkeypatch, command, compiler):
    """Seen by what takes the place of `torch.compile` while nerfstudio is imported."""
    (tmp_path / "ours.yml").write_text("!!python/object:sl_nerfstudio.model.trainer.SLTrainerConfig\n")
    (tmp_path / "other.yml").write_text("!!python/object:nerfstudio.engine.trainer.TrainerConfig\n")
    monkeypatch.chdir(tmp_path)
    real = torch.compile
    begin_imports(command)
    try:
        assert (torch.compile is real) == compiler
    finally:
        end_imports()
    assert torch.compile is real
