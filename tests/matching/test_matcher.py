"""Captures matched along the lines of their poses."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.matching.lines import MATCHING_DEFAULTS, enlarged, pixels_a_period
from sl_nerfstudio.matching.matcher import DecodedImage, LineMatcher
from tests.matching.scene import PATTERN, PERIOD, step_scene


def decoded_of(scene, seed=2):
    """As decoders leave a capture: nothing within 12 pixels of the step, holes, and 0.3 px of noise."""
    rng = np.random.default_rng(seed)
    coords = (scene.coords + rng.normal(0, 0.3, scene.coords.shape)).astype(np.float32)
    side = len(coords)
    edge = round(0.55 * side)
    coords[edge - 12 : edge + 12] = np.nan
    coords[: side // 6, : side // 4] = np.nan
    return DecodedImage(scene.image, coords, np.ones(coords.shape[:2], bool))


@pytest.fixture(scope="module")
def scene():
    return step_scene()


@pytest.fixture(scope="module")
def matched(scene):
    return LineMatcher(PATTERN).match(decoded_of(scene), scene.camera, scene.projector, scene.T_camera_projector)


def share_right(scene, coords, within=2.0):
    return (np.linalg.norm(coords - scene.coords, axis=-1) < within).mean()


def test_what_was_not_decoded_is_matched_up_to_the_step(scene, matched):
    before = decoded_of(scene)
    error = np.linalg.norm(matched - scene.coords, axis=-1)
    known = np.isfinite(error)
    assert share_right(scene, matched) > 0.95 > 0.9 > share_right(scene, before.coords)
    assert (error[known] > 2).mean() < 0.01
    assert np.median(error[known]) < 0.1 < np.nanmedian(np.linalg.norm(before.coords - scene.coords, axis=-1))


def test_the_unit_of_length_does_not_matter(scene, matched):
    longer = scene.T_camera_projector.copy()
    longer[:3, 3] *= 1000
    again = LineMatcher(PATTERN).match(decoded_of(scene), scene.camera, scene.projector, longer)
    np.testing.assert_allclose(again, matched, atol=2e-3)


def test_a_wrong_pose_changes_nothing(scene):
    image, wrong = decoded_of(scene), scene.T_camera_projector.copy()
    wrong[:3, 3] = [0.0, 1.0, 0.0]
    assert LineMatcher(PATTERN).match(image, scene.camera, scene.projector, wrong) is image.coords


def test_hardly_anything_decoded_changes_nothing(scene):
    image = decoded_of(scene)
    coords = np.full_like(image.coords, np.nan)
    coords[50:58, 50:58] = image.coords[50:58, 50:58]
    few = replace(image, coords=coords)
    assert LineMatcher(PATTERN).match(few, scene.camera, scene.projector, scene.T_camera_projector) is coords


def test_strips_give_what_the_whole_gives(scene, matched):
    small = replace(MATCHING_DEFAULTS, most_bytes=200 * 40 * 3 * 120, strip_margin=4.0)
    strips = LineMatcher(PATTERN, small).match(
        decoded_of(scene), scene.camera, scene.projector, scene.T_camera_projector
    )
    both = np.isfinite(strips[..., 0]) & np.isfinite(matched[..., 0])
    assert both.mean() > 0.98 * np.isfinite(matched[..., 0]).mean()
    assert (np.linalg.norm(strips - matched, axis=-1)[both] > 0.2).mean() < 0.01


def test_large_images_are_matched_on_means_of_squares():
    scene = step_scene(side=600)
    matched = LineMatcher(PATTERN).match(decoded_of(scene), scene.camera, scene.projector, scene.T_camera_projector)
    error = np.linalg.norm(matched - scene.coords, axis=-1)
    known = np.isfinite(error)
    assert matched.shape == scene.coords.shape and known.mean() > 0.95
    assert np.median(error[known]) < 0.1 and (error[known] > 2).mean() < 0.015


@pytest.mark.parametrize("pixels", [8.0, 15.0, 40.0])
def test_the_size_of_a_period_is_measured(pixels):
    y, x = np.mgrid[:120, :130] * PERIOD / pixels
    coords = np.stack([0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y], -1).astype(np.float32)
    coords[30:50] = np.nan
    assert pixels_a_period(coords, PERIOD) == pytest.approx(pixels, rel=1e-3)
    assert pixels_a_period(np.full_like(coords, np.nan), PERIOD) is None


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_coordinates_are_enlarged_exactly_where_surfaces_are_flat(factor):
    """Also beside a jump, where what lies beyond must not be mixed in; pixels beyond the last square are unknown."""
    h, w = 61, 47
    y, x = np.mgrid[:h, :w] + 0.5
    fine = np.stack([1.3 * x + 0.2 * y, 0.9 * y - 0.1 * x], -1)
    fine[:, 24:] += 300.0
    middle = (slice(0, h // factor * factor), slice(0, w // factor * factor))
    coarse = fine[middle].reshape(h // factor, factor, w // factor, factor, 2).mean((1, 3)).astype(np.float32)
    coarse[3, 4] = np.nan
    out = enlarged(coarse, factor, (h, w), PERIOD)
    known = np.isfinite(out[..., 0])
    assert not known[3 * factor : 4 * factor, 4 * factor : 5 * factor].any()
    assert not known[h // factor * factor :].any() and not known[:, w // factor * factor :].any()
    split = 24 // factor * factor
    whole = known.copy()
    whole[:, split : split + factor] &= 24 % factor == 0  # squares on both sides of the jump
    np.testing.assert_allclose(out[whole], fine[whole], atol=1e-3)
