import warnings
from pathlib import Path

import pytest

from tests.dataparser.tiny_scan import TinyScan

with warnings.catch_warnings():  # warnings are errors, but these are nerfstudio's own
    warnings.simplefilter("ignore")
    import nerfstudio.data.datamanagers.full_images_datamanager
    import nerfstudio.engine.trainer  # noqa: F401


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of three frames that no test may change."""
    return TinyScan().write(tmp_path_factory.mktemp("scans") / "tiny")
