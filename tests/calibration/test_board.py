"""What is fitted, how far it can be trusted, and what to capture next."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.calibration.board import RadialMisfit, calibrate, next_pose, radial_misfit
from sl_nerfstudio.calibration.board_adjustment import FreeIntrinsics, adjust, camera_start, residuals
from sl_nerfstudio.cli.calibrate import next_pose_words, require_determined
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.review import verdict as verdicts
from sl_nerfstudio.review.verdict import judge_calibration, shortcomings, undetermined
from tests.calibration.board_scenes import (
    BOARD,
    CAMERA,
    PLAIN_CAMERA,
    PLAIN_PROJECTOR,
    POINTS,
    equidistant_scene,
    make_scene,
)

pytestmark = pytest.mark.slow

SEEDS = range(3)


def calibrated(scene, camera_alone=False):
    sizes = scene.sizes
    pattern = None if camera_alone else sizes[1]
    return calibrate(scene.views, BOARD, sizes[0], pattern, "OPENCV", lambda items, _: items)


@pytest.fixture(scope="module")
def both():
    """Both devices, lens shift, distortion in the camera alone, 0.1 px of noise."""
    scene = make_scene(5, count=5, noise=0.1, camera=CAMERA, projector=PLAIN_PROJECTOR)
    return scene, calibrated(scene)


@pytest.fixture(scope="module")
def cameras():
    """Cameras without distortion from other noise and other poses."""
    scenes = [make_scene(seed, count=5, noise=0.1, camera=PLAIN_CAMERA, projector=None) for seed in SEEDS]
    return [(scene, calibrated(scene, camera_alone=True)) for scene in scenes]


def test_strong_distortion_is_chosen_where_it_is(both):
    _, found = both
    assert found.free[0].terms >= 1 and found.free[1].terms == 0 and not found.free[1].aspect
    chosen = [score for score in found.models if score.chosen]
    assert [score.device for score in chosen] == [0, 1]
    without = next(score for score in found.models if score.device == 0 and score.model.terms == 0)
    assert without.costs.mean() > 1.5 * chosen[0].costs.mean()


def test_noise_alone_chooses_no_distortion(cameras):
    simple = [found.free[0].terms == 0 and not found.free[0].aspect for _, found in cameras]
    assert sum(simple) >= len(simple) - 1


def test_stated_uncertainty_covers_the_errors(both, cameras):
    ratios = []
    for scene, found in [both, *cameras]:
        for got, true, sigma in zip(found.adjusted.rig.devices, scene.truth.devices, found.sigmas, strict=True):
            ratios += [abs(getattr(got, k) - getattr(true, k)) / sigma.values[k] for k in ("fl_x", "cx", "cy")]
            assert abs(got.fl_x / true.fl_x - 1) < 0.01
    ratios = np.array(ratios)
    assert (ratios < 3).all() and (ratios < 1).mean() > 0.5


@pytest.mark.parametrize("seed", range(4))
def test_a_lens_that_is_none_of_the_models_is_no_good_calibration(seed):
    """An equidistant lens of 76 x 61 degrees, beside lenses that the model describes."""
    for scene, fits in (
        (make_scene(seed, count=12, noise=0.1, camera=CAMERA, projector=None), True),
        (equidistant_scene(seed, count=12, noise=0.1), False),
    ):
        seen = scene.seen
        adjusted = adjust(camera_start(scene.views, scene.sizes[0], POINTS).rig, (FreeIntrinsics(False, 2),), seen)
        found = radial_misfit(adjusted.rig.camera, seen[0], residuals(adjusted.rig, 0, seen[0]))
        assert (found is None) == fits


def test_the_verdict_says_that_a_lens_does_not_fit(both):
    _, found = both
    verdict = judge_calibration(replace(found, misfit=RadialMisfit(-0.2, 0.1)))
    assert verdict.band != "good"
    assert any("camera's lens does not fit" in reason and "fisheye" in reason for reason in verdict.reasons)


def test_noise_of_either_device_is_recognised(both):
    _, found = both
    np.testing.assert_allclose(found.adjusted.sigma_px, 0.1, rtol=0.15)
    np.testing.assert_allclose(found.rms_px, 0.1, rtol=0.2)
    assert found.left_out.error_px[0] < 0.2 and found.left_out.error_px[1] < 0.3


def test_the_suggested_pose_is_predicted_to_help(both):
    _, found = both
    pose = next_pose(found.adjusted, POINTS)
    assert pose is not None and pose == found.next_pose
    assert pose.sigma_after < pose.sigma_before
    words = next_pose_words(found)
    assert pose.tilt in words and f"{pose.sigma_after:.2%} instead of {pose.sigma_before:.2%}" in words


def test_parallel_boards_are_refused_with_the_cause():
    found = calibrated(
        make_scene(7, count=3, noise=0.1, camera=PLAIN_CAMERA, projector=None, spread=1.0), camera_alone=True
    )
    assert undetermined(found) == ("camera",)
    with pytest.raises(
        UserError, match=r"focal length of the camera(.*\n)+.*cause: .*nearly parallel(.*\n)+.*add pose"
    ):
        require_determined(found)


def test_a_verdict_names_the_device_and_what_lacks(both, monkeypatch):
    _, found = both

    def limits(**changed) -> None:
        for name, value in changed.items():
            monkeypatch.setattr(verdicts, name, value)

    limits(_FOCAL=(1e-9, 1e-8), _RMS_PX=(0.01, 1.5), _LEAST_TILT_DEG=180.0)
    verdict = judge_calibration(found)
    assert verdict.band == "poor"
    assert "focal length of the camera is uncertain" in verdict.reasons[0] and "nearly parallel" in verdict.reasons[0]
    assert any("where the projector should see them" in reason for reason in verdict.reasons)
    limits(_FOCAL=(1.0, 1.0), _CENTRE=(1.0, 1.0), _RMS_PX=(9.0, 9.0), _GOOD_PREDICTION=99.0)
    assert judge_calibration(found).band == "good" and not judge_calibration(found).reasons
    limits(_GOOD_COVERAGE=1.1)
    assert shortcomings(found)[-2:] == (
        f"corners fill only {found.coverage.camera:.0%} of the camera's image",
        f"corners fill only {found.coverage.projector:.0%} of the pattern",
    )
