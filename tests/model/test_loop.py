"""What another process compiles is what a step calls."""

import os
import subprocess
import sys

import pytest

from sl_nerfstudio.model import loop
from sl_nerfstudio.model.loop import finish, start

STEP = """
import torch
from sl_nerfstudio.field.numba_backend import evaluate_fused, pull_back_fused, pull_back_gradient_fused
from sl_nerfstudio.field.numba_grid import adam, clear, scatter_level
from sl_nerfstudio.field.optimiser import RowAdam
from sl_nerfstudio.field.field import FieldConfig, SDFField

field = SDFField(FieldConfig(log2_table_size=10))
optimizer = RowAdam([field.encoding.table])
p = torch.rand(300, 3)
for _ in range(2):
    optimizer.zero_grad()
    value, gradient = field.sdf_and_gradient(p)
    (field.sdf(p).square().sum() + value.sum() + gradient.norm()).backward()
    optimizer.step()
kernels = evaluate_fused, pull_back_fused, pull_back_gradient_fused, scatter_level, adam, clear
print([sum(kernel.stats.cache_misses.values()) for kernel in kernels])
print([sum(kernel.stats.cache_hits.values()) for kernel in kernels])
"""


@pytest.mark.slow
def test_a_step_finds_all_its_loops_compiled(tmp_path, monkeypatch):
    """In a folder of its own, so that nothing is compiled before."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for code in (loop._CODE, STEP):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ)
    assert done.stdout.splitlines() == ["[0, 0, 0, 0, 0, 0]", "[1, 1, 1, 1, 1, 1]"]


@pytest.mark.parametrize(("cores", "missing", "expected"), [(4, True, 1), (1, True, 0), (4, False, 0)])
def test_another_process_is_started_only_where_it_helps(monkeypatch, cores, missing, expected):
    started, waited = [], []

    class Process:
        def __init__(self, command, **_):
            started.append(command)

        def wait(self, seconds):
            waited.append(seconds)
            raise subprocess.TimeoutExpired("compile_step", seconds)

    monkeypatch.setattr(loop, "threads", lambda: cores)
    monkeypatch.setattr(loop, "needs_compiling", lambda _: missing)
    monkeypatch.setattr(subprocess, "Popen", Process)
    start()
    finish()
    finish()
    assert len(started) == len(waited) == expected
