"""Tiny runs on the pretended GPU."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.common.training import Training, settings
from sl_nerfstudio.field.field import CachedGrid
from sl_nerfstudio.model.trainer import SLTrainerConfig
from tests.dataparser.tiny_scan import TinyScan
from tests.model.training.small_runs import own_signals
from tests.test_ns_commands import _fresh_writers  # noqa: F401 (nerfstudio's log writers are global)

STEPS = 20


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return TinyScan(undecoded=0.2).write(tmp_path_factory.mktemp("scans") / "sphere")


@pytest.fixture(autouse=True)
def _own_signals() -> Iterator[None]:
    with own_signals():
        yield


@pytest.fixture()
def begin(tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Training]:
    """Begins a run with few pixels and a small field; the second of two levels begins at step 1, rendering at 3."""

    monkeypatch.setattr("sl_nerfstudio.model.model.CachedGrid", partial(CachedGrid, 24))
    monkeypatch.setattr("sl_nerfstudio.rendering.losses.LEVELS_AT_START", 1)

    def begun(method: str, change: Callable[[SLTrainerConfig], Any] | None = None, **more: Any) -> Training:
        config = settings(method, tiny_root, tmp_path, more.pop("device", "cuda"), STEPS)
        config.cuda_graph = False
        config.pipeline.datamanager.train_num_rays_per_batch = 32
        model: Any = config.pipeline.model
        model.warm_start = 0.15 if method == "sl-neus" else 0.0
        sdf, sampling = model.sdf, model.sampling
        sdf.backend, sdf.log2_table_size, sdf.max_resolution, sdf.hidden, sdf.levels = "torch", 10, 32, 16, 2
        sampling.render_rays, sampling.samples, sampling.eikonal_points = 16, 8, 16
        if change is not None:
            change(config)
        torch.manual_seed(0)
        return Training(config, **more)

    return begun
