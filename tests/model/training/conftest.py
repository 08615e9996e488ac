"""One tiny scan and one finished run for the tests of this folder."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.dataparser.tiny_scan import TinyScan
from tests.model.training.small_runs import folder_of, own_signals, settings, train
from tests.test_ns_commands import _fresh_writers  # noqa: F401 (nerfstudio's log writers are global)


@pytest.fixture(scope="session")
def scan_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return TinyScan(undecoded=0.05).write(tmp_path_factory.mktemp("scans") / "sphere")


@pytest.fixture(scope="session")
def finished(scan_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of 12 steps, which nobody interrupted."""
    output = tmp_path_factory.mktemp("finished")
    with own_signals():
        train(settings(scan_root, output))
    return folder_of(output)


@pytest.fixture()
def copy(finished: Path, tmp_path: Path) -> Path:
    """The finished run, to be spoilt."""
    return Path(shutil.copytree(finished, tmp_path / "copy"))


@pytest.fixture(autouse=True)
def _own_signals() -> Iterator[None]:
    with own_signals():
        yield
