"""One faceted scan for all tests that only read it: exact coordinates, exact poses, truth."""

from pathlib import Path

import pytest

from sl_nerfstudio.scan import Scan, read_scan

from .faceted_scan import MADE


@pytest.fixture(scope="session")
def clean_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its folder."""
    return MADE.write(tmp_path_factory.mktemp("faceted") / "scan")


@pytest.fixture(scope="session")
def scan(clean_scan: Path) -> Scan:
    """The same, read."""
    return read_scan(clean_scan)
