"""One faceted scan for all tests that only read it."""

from pathlib import Path

import pytest

from .faceted_scan import FacetedScan


@pytest.fixture(scope="session")
def clean_scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Exact coordinates, exact poses, truth."""
    return FacetedScan().write(tmp_path_factory.mktemp("faceted") / "scan")
