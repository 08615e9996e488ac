"""An export loads a run, and training imports nerfstudio, without torch's compiler; what needs it still works."""

import subprocess
import sys

import pytest
import torch

from sl_nerfstudio.late_imports import (
    begin_imports,
    compiler_on_demand,
    end_imports,
    shapes_without_symbols,
)

CODE = """
import sys
from sl_nerfstudio.runs.run import load_run
from pathlib import Path
try:
    load_run(Path("nothing.yml"))
except Exception as error:
    print(type(error).__name__, "torchvision.ops" in sys.modules, "torch._dynamo" in sys.modules)
from torchvision.ops.roi_align import is_compile_supported
print(is_compile_supported("meta"), "torch._dynamo" in sys.modules)
"""


def test_loading_a_run_does_not_import_the_compiler(tmp_path):
    command = [sys.executable, "-c", CODE]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.splitlines() == ["UserError True False", "False True"]


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


def test_shapes_are_broadcast_as_torch_does_it():
    real = torch.broadcast_shapes
    for shapes in (((),), ((3, 1), (4,)), ((2, 1, 5), (7, 1), ()), (torch.Size([1]), [6, 1]), (3, (2, 1))):
        with shapes_without_symbols():
            found = torch.broadcast_shapes(*shapes)
        assert isinstance(found, torch.Size) and found == real(*shapes)
    with pytest.raises(RuntimeError, match="shape"), shapes_without_symbols():
        torch.broadcast_shapes((2,), (3,))
    assert torch.broadcast_shapes is real


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


@pytest.mark.parametrize(("command", "compiler"), [("/bin/ns-train sl-neus", False), ("ns-train splatfacto", True)])
def test_commands_of_this_package_go_without_the_compiler_until_somebody_asks(tmp_path, command, compiler):
    code = [sys.executable, "-W", "ignore", "-c", COMMAND.format(command=command.split())]
    done = subprocess.run(code, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.splitlines()[-2:] == [f"{compiler} True 0.999", "False True"]


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
