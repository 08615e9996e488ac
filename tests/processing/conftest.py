"""The toy pattern and decoder, known to sl-process for the length of a test, and one set of captures."""

import pytest

from sl_nerfstudio.bundle_adjustment.registered_frames import RegisteredFramesSettings
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.decoding.decoders import DECODERS
from sl_nerfstudio.pattern.files import LAYOUTS
from tests.decoding.ramps_decoder import RampsDecoder
from tests.pattern.ramps import Ramps
from tests.processing.ramp_scan import RampScan, make_ramp_scan

# For tests of what is made of an adjustment: rough, and without the question whether there are other minima.
SHORT = RegisteredFramesSettings(
    adjustment=AdjustmentSettings(anchors_per_frame=200, max_iterations=16, other_minima=False)
)


def register_ramps(patch: pytest.MonkeyPatch) -> None:
    """The two entries that a new decoder needs."""
    patch.setitem(LAYOUTS, Ramps.kind, Ramps)
    patch.setitem(DECODERS, RampsDecoder.name, RampsDecoder)


@pytest.fixture
def ramps_registered(monkeypatch):
    """For one test."""
    register_ramps(monkeypatch)


@pytest.fixture(scope="session")
def ramp_scan(tmp_path_factory) -> RampScan:
    """Captures that no test may change."""
    return make_ramp_scan(tmp_path_factory.mktemp("ramps"))
