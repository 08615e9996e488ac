"""What the report says about the intrinsics of a run."""

from dataclasses import asdict
from typing import Any

import pytest

from sl_nerfstudio.evaluation.report.scan_report import intrinsics_hint
from sl_nerfstudio.geometry.devices import UNCHANGED, DeviceChange, IntrinsicsChange
from sl_nerfstudio.scan import Scan, read_scan
from tests.dataparser.tiny_scan import TinyScan

BETTER = IntrinsicsChange(DeviceChange(0.02, 0.0, 0.0), DeviceChange(0.0, -0.01, 0.0))
SIGMA = IntrinsicsChange.of([0.001] * 6)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return read_scan(TinyScan(frames=2).write(tmp_path_factory.mktemp("scans") / "scan"))


def record(change: IntrinsicsChange, contradicts: bool | None) -> dict[str, Any]:
    found = {"change": asdict(BETTER), "sigma": asdict(SIGMA), "chi_square": 87.4, "contradicts": contradicts}
    return {"intrinsics": {"change": asdict(change), "self_calibration": None if contradicts is None else found}}


@pytest.mark.parametrize("training", [None, {}, record(UNCHANGED, None), record(UNCHANGED, False)])
def test_nothing_is_said_where_nothing_is_known_or_wrong(scan: Scan, training: dict[str, Any] | None) -> None:
    assert intrinsics_hint(training, scan) == ""


def test_a_contradiction_is_given_in_percent_and_pixels(scan: Scan) -> None:
    text = intrinsics_hint(record(UNCHANGED, True), scan)
    assert "chi square 87" in text and "--pipeline.model.refine-intrinsics True" in text
    assert "camera: focal length +2.00 ± 0.10 %, principal point (+0.0 ± 0.1, +0.0 ± 0.1) px" in text
    assert "projector: focal length +0.00 ± 0.10 %, principal point (-1.1 ± 0.1, +0.0 ± 0.1) px" in text  # of f = 110
    assert "are not those of the scan folder" not in text


def test_a_change_that_was_made_is_said_first(scan: Scan) -> None:
    change = IntrinsicsChange(DeviceChange(-0.0125), DeviceChange(0.005))
    text = intrinsics_hint(record(change, True), scan)
    assert text.startswith("The intrinsics are not those of the scan folder: focal length of the camera -1.25 %, ")
    assert "of the projector +0.50 %" in text and "contradict" in text
