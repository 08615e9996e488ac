import shutil
from pathlib import Path

import pytest
from sphere_scan import write_sphere


@pytest.fixture(scope="session")
def sphere_original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid scan, written once; not to be changed."""
    return write_sphere(tmp_path_factory.mktemp("sphere") / "scan")


@pytest.fixture
def sphere(sphere_original: Path, tmp_path: Path) -> Path:
    """A valid scan of this test's own."""
    return Path(shutil.copytree(sphere_original, tmp_path / "scan"))
