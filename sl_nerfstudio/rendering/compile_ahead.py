"""The loops of a training step, compiled by another process while this one reads the scan and adjusts the poses.

Machine code is kept on disk, so this is done once. It takes a quarter of a minute, and half of that Python's lock: a
thread of this process would gain little.
"""

import subprocess
import sys
from contextlib import suppress

import torch

from sl_nerfstudio.field.kernels import fused
from sl_nerfstudio.field.kernels.simd import needs_compiling
from sl_nerfstudio.field.row_adam import RowAdam
from sl_nerfstudio.field.sdf_field import FieldConfig, SDFField
from sl_nerfstudio.field.table_gradient import TableGradient
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.rendering.compiled_measuring import measured
from sl_nerfstudio.rendering.compiled_rendering import comes_below, first_crossings, render_rays
from sl_nerfstudio.threads import threads

_LONGEST = 120  # seconds that `finish` waits; what is missing then is compiled here, when it is used
_CODE = f"from {__name__} import compile_step; compile_step()"
_process: subprocess.Popen[bytes] | None = None


def start() -> None:
    """Begin, if there is anything to compile and more than one core for it."""
    global _process
    if threads() > 1 and needs_compiling(fused.pull_back_gradient):
        quiet = subprocess.DEVNULL
        with suppress(OSError):
            _process = subprocess.Popen([sys.executable, "-c", _CODE], stdin=quiet, stdout=quiet, stderr=quiet)


def finish() -> None:
    """Wait for the other process, rather than compile the same here."""
    global _process
    if _process is not None:
        with suppress(subprocess.TimeoutExpired):
            _process.wait(_LONGEST)
        _process = None


def compile_step() -> None:
    """Call every loop of a step, and of evaluation, with a tiny field."""
    torch.set_num_threads(1)
    field = SDFField(FieldConfig(levels=1, min_resolution=2, max_resolution=2, hidden=16, backend="numba"))
    table = field.encoding.table
    p = torch.zeros(8, 3)
    value, gradient = field.sdf_and_gradient(p)
    (field.sdf(p).sum() + value.sum() + gradient.sum()).backward()
    RowAdam([table]).step()
    TableGradient.of(table).clear()
    with torch.no_grad():
        rays, T, one = torch.ones(1, 3), torch.eye(4)[None], torch.ones(1)
        interval = torch.zeros(2, 2, 2), rays, rays, one, one, 2
        first_crossings(*interval)
        comes_below(*interval, one)
        device = Intrinsics.of(Device(w=2, h=2, fl_x=1.0, fl_y=1.0, cx=1.0, cy=1.0))
        measured((rays, rays), T, rays, one > 0, device, 1.0, 1.0, 1.0)
        render_rays(torch.ones(1, 2), torch.ones(1, 2), rays, rays, T, device, torch.ones(2, 2), 1.0)
