from pathlib import Path

import pytest

from tests.dataparser.tiny_scan import TinyScan


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of three frames that no test may change."""
    return TinyScan().write(tmp_path_factory.mktemp("scans") / "tiny")
