"""The toy pattern and decoder, known to sl-process for the length of a test, and one set of captures."""

import pytest

from sl_nerfstudio.decoding.decoders import DECODERS
from sl_nerfstudio.pattern.files import LAYOUTS
from tests.decoding.ramps_decoder import RampsDecoder
from tests.pattern.ramps import Ramps
from tests.processing.ramp_scan import RampScan, make_ramp_scan


@pytest.fixture
def ramps_registered(monkeypatch):
    """The two entries that a new decoder needs."""
    monkeypatch.setitem(LAYOUTS, Ramps.kind, Ramps)
    monkeypatch.setitem(DECODERS, RampsDecoder.name, RampsDecoder)


@pytest.fixture(scope="session")
def ramp_scan(tmp_path_factory) -> RampScan:
    """Captures that no test may change."""
    return make_ramp_scan(tmp_path_factory.mktemp("ramps"))
