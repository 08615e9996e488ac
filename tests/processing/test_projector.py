"""`sl-process` without the projector's intrinsics, and for rigs that do not move freely: as a user runs it."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.api import write_devices
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.processing.projector import FIELDS
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import make_setup
from tests.processing.ramp_scan import NAMES, RampScan, make_captures

pytestmark = pytest.mark.slow


def _captures(root, path) -> RampScan:
    setup = make_setup(SynthConfig(scene="head", frames=22, resolution=130, seed=3, path=path))
    return make_captures(root, setup, tuple(setup.render(k, 1).coords for k in range(len(NAMES))))


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    return _captures(tmp_path_factory.mktemp("still"), "static-projector")


@pytest.fixture(scope="module")
def rigid(tmp_path_factory):
    return _captures(tmp_path_factory.mktemp("rigid"), "rigid-rig")


def _with_camera_alone(config, scan: RampScan):
    path = config.output.with_name("camera.json")
    write_devices(path, scan.camera, None)
    return replace(config, intrinsics=path)


def _run(config):
    log = []
    return process(config, lambda *_: "report", log.append), log


def test_a_projector_that_stands_still_needs_no_intrinsics(ramps_registered, still, tmp_path):
    result, log = _run(_with_camera_alone(still.config(tmp_path / "s", rig="static-projector"), still))
    assert result.registered == len(NAMES)
    assert any(line.startswith("projector, by resection from the cameras: focal lengths ") for line in log)
    scan = read_scan(tmp_path / "s")
    assert scan.projector.fl_x == pytest.approx(still.projector.fl_x, rel=5e-3)
    beams = scan.poses.T_world_projector
    np.testing.assert_allclose(beams, np.broadcast_to(beams[0], beams.shape), atol=1e-6)  # it did not move
    stated = json.loads((tmp_path / "s" / "transforms.json").read_text())["projector"]["intrinsics_sigma"]
    assert set(stated) == set(FIELDS) and 0 < stated["fl_x"] < 0.02 * still.projector.fl_x
    document = json.loads((tmp_path / "s" / "processing.json").read_text())["projector"]
    assert document["sigma"] == stated and document["fl_x"] == scan.projector.fl_x


def test_a_rigid_rig_has_one_relative_pose(ramps_registered, rigid, tmp_path):
    result, _ = _run(rigid.config(tmp_path / "s", rig="rigid"))
    assert result.registered == len(NAMES)
    T = read_scan(tmp_path / "s").poses.T_camera_projector
    np.testing.assert_allclose(T, np.broadcast_to(T[0], T.shape), atol=1e-6)


def test_a_camera_alone_in_the_file_is_an_error_that_names_the_flags(ramps_registered, ramp_scan, tmp_path):
    config = _with_camera_alone(ramp_scan.config(tmp_path / "s"), ramp_scan)
    with pytest.raises(UserError, match="--estimate-projector") as caught:
        _run(config)
    assert "describes no projector" in str(caught.value)


def test_frames_of_one_relative_pose_do_not_determine_the_projector(ramps_registered, rigid, tmp_path):
    config = _with_camera_alone(rigid.config(tmp_path / "s", estimate_projector=True), rigid)
    with pytest.raises(UserError, match="do not determine the projector's intrinsics") as caught:
        _run(config)
    assert "stands in the same way against the camera in all frames" in str(caught.value)
    assert "turned by 90 degrees" in str(caught.value)


def stated_too_long(ramp_scan: RampScan, folder, factor: float):
    """The settings with a projector's focal length that is wrong by a factor."""
    true = ramp_scan.projector
    wrong = replace(true, fl_x=factor * true.fl_x, fl_y=factor * true.fl_y)
    write_devices(folder / "wrong.json", ramp_scan.camera, wrong)
    return replace(ramp_scan.config(folder / "s"), intrinsics=folder / "wrong.json")


def require_cause(said: str, fl_x: float) -> None:
    """The right focal length and the remedy are named."""
    value = float(re.search(r"projector, focal length ([\d.]+) ±", said)[1])
    assert value == pytest.approx(fl_x, rel=3e-3) and "--estimate-projector" in said


def test_a_wrong_focal_length_is_named_as_the_cause(ramps_registered, ramp_scan, tmp_path):
    result, log = _run(stated_too_long(ramp_scan, tmp_path, 1.02))
    (said,) = [line for line in log if line.startswith("The stated intrinsics contradict the captures")]
    require_cause(said, ramp_scan.projector.fl_x)
    assert said in result.remarks and result.verdict.band != "good"


def test_a_focal_length_with_which_no_two_surfaces_agree_is_named_in_the_error(ramps_registered, ramp_scan, tmp_path):
    with pytest.raises(UserError) as caught:
        _run(stated_too_long(ramp_scan, tmp_path, 1.03))
    said = str(caught.value)
    assert "0 of 4 frames can be used" in said and "The stated intrinsics contradict the captures" in said
    require_cause(said, ramp_scan.projector.fl_x)
