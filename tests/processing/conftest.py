"""The toy pattern and decoder, known to sl-process for the length of a test, and one set of captures."""

import shutil
from dataclasses import replace

import pytest

from sl_nerfstudio.bundle_adjustment.registered_frames import RegisteredFramesSettings, adjust_registered
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.decoding.decoders import DECODERS
from sl_nerfstudio.pattern.files import LAYOUTS
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.frames import FrameJob, FrameStageResult, FrameWorker, clouds_of
from sl_nerfstudio.processing.scan_poses import ScanPoses, find_scan_poses
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import Registration
from tests.decoding.ramps_decoder import Ramps, RampsDecoder
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


@pytest.fixture
def copy(ramp_scan, tmp_path) -> RampScan:
    """Captures that a test may spoil."""
    return replace(ramp_scan, root=shutil.copytree(ramp_scan.root, tmp_path / "c"))


# All frames of these captures decoded, calibrated, registered and adjusted, once for all tests.


@pytest.fixture(scope="session")
def ramp_job(ramp_scan, tmp_path_factory) -> FrameJob:
    return ramp_scan.job(tmp_path_factory.mktemp("w"))


@pytest.fixture(scope="session")
def results(ramp_scan, ramp_job) -> list[FrameStageResult]:
    return list(map(FrameWorker(ramp_job), find_captures(ramp_scan.root / "images", True).frames))


@pytest.fixture(scope="session")
def registration(results) -> Registration:
    return register(clouds_of(results))


@pytest.fixture(scope="session")
def poses(results, registration) -> ScanPoses:
    clouds = clouds_of(results)
    return find_scan_poses(clouds, registration, adjust_registered(clouds, registration, SHORT), None, None)
