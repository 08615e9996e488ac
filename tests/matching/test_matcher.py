"""Captures matched along the lines of their poses, the fit to the image, and what tells right matches from wrong."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_fit import draw_sharpnesses
from sl_nerfstudio.matching import matcher
from sl_nerfstudio.matching.matcher import FEATURES, RIGHT, DecodedImage, LineFit, LineMatcher, features_of
from sl_nerfstudio.matching.semi_global import StereoMatches
from tests.matching.scene import PATTERN, PERIOD, across, step_scene

SIZE = 200 / 15


def decoded_of(scene, seed=2):
    """As decoders leave a capture: nothing within 12 pixels of the step, holes, and 0.3 px of noise."""
    rng = np.random.default_rng(seed)
    coords = (scene.coords + rng.normal(0, 0.3, scene.coords.shape)).astype(np.float32)
    side = len(coords)
    edge = round(0.55 * side)
    coords[edge - 12 : edge + 12] = np.nan
    coords[: side // 6, : side // 4] = np.nan
    return DecodedImage(scene.image, coords, np.ones(coords.shape[:2], bool))


def match(scene, image, T=None):
    pose = scene.T_camera_projector if T is None else T
    return LineMatcher(PATTERN).match(image, scene.camera, scene.projector, pose)


@pytest.fixture(scope="module")
def scene():
    return step_scene()


@pytest.fixture(scope="module")
def matched(scene):
    return match(scene, decoded_of(scene))


def test_what_was_not_decoded_is_matched_up_to_the_step(scene, matched):
    before = decoded_of(scene)
    error = np.linalg.norm(matched - scene.coords, axis=-1)
    known = np.isfinite(error)
    error_before = np.linalg.norm(before.coords - scene.coords, axis=-1)
    assert (error < 2).mean() > 0.95 > 0.9 > (error_before < 2).mean()
    assert (error[known] > 2).mean() < 0.01
    assert np.median(error[known]) < 0.1 < np.nanmedian(error_before)


def test_the_unit_of_length_does_not_matter(scene, matched):
    longer = scene.T_camera_projector.copy()
    longer[:3, 3] *= 1000
    np.testing.assert_allclose(match(scene, decoded_of(scene), longer), matched, atol=2e-3)


def test_a_wrong_pose_or_hardly_anything_decoded_changes_nothing(scene):
    image, wrong = decoded_of(scene), scene.T_camera_projector.copy()
    wrong[:3, 3] = [0.0, 1.0, 0.0]
    assert match(scene, image, wrong) is image.coords
    coords = np.full_like(image.coords, np.nan)
    coords[50:58, 50:58] = image.coords[50:58, 50:58]
    assert match(scene, replace(image, coords=coords)) is coords


def test_strips_give_what_the_whole_gives(monkeypatch, scene, matched):
    monkeypatch.setattr(matcher, "MOST_BYTES", 1)  # one row of tiles at a time
    monkeypatch.setattr(matcher, "STRIP_MARGIN", 4.0)
    strips = match(scene, decoded_of(scene))
    both = np.isfinite(strips[..., 0]) & np.isfinite(matched[..., 0])
    assert both.mean() > 0.98 * np.isfinite(matched[..., 0]).mean()
    assert (np.linalg.norm(strips - matched, axis=-1)[both] > 0.2).mean() < 0.01


# ------------------------------------------------------------------ the fit to the image


def fitted(scene, start, lines=None):
    grid = draw_sharpnesses(PATTERN.render(), PERIOD)[0]
    return LineFit(grid, SIZE).fitted(scene.image, lines or scene.lines, start, np.isfinite(start))


def errors(scene, coords):
    """Errors along the lines and across them, pattern pixels, away from the image's border and from the step."""
    inner = np.ones(coords.shape[:2], bool)
    inner[:10], inner[-10:], inner[:, :10], inner[:, -10:], inner[100:120] = (False,) * 5
    beside = across(scene.lines, scene.inverse_distance)
    apart = coords - scene.coords
    along = apart[..., 0] * beside[..., 1] - apart[..., 1] * beside[..., 0]
    return along[inner], (apart * beside).sum(-1)[inner]


def moved_start(scene, pixels):
    """Matches that are some pattern pixels off."""
    return scene.inverse_distance + pixels / np.linalg.norm(scene.lines.slopes(scene.inverse_distance), axis=-1)


def rough_start(scene):
    """Matches as the steps of the inverse distance leave them: half a pattern pixel off, differently everywhere."""
    return moved_start(scene, np.random.default_rng(1).normal(0, 0.5, scene.inverse_distance.shape))


def test_matches_that_are_rough_or_off_everywhere_become_exact_on_both_sides_of_a_step(scene):
    along, beside = errors(scene, fitted(scene, rough_start(scene)))
    assert np.isfinite(along).all()
    assert np.sqrt((along**2).mean()) < 0.06 and np.sqrt((beside**2).mean()) < 0.05
    along, _ = errors(scene, fitted(scene, moved_start(scene, 0.8)))
    assert abs(np.median(along)) < 0.15


def test_a_pose_that_is_off_shows_across_the_lines(scene):
    """The offset is what tells the joint adjustment where the projector stands: it must not be taken away."""
    moved = np.array([0.3, 0.5], np.float32)
    lines = replace(scene.lines, offset=scene.lines.offset - moved)  # as lines of a wrong pose run
    _, beside = errors(scene, fitted(scene, lines.nearest(scene.coords), lines))
    missed = abs((moved * across(scene.lines, scene.inverse_distance)).sum(-1)).mean()
    assert missed > 0.3 and abs(np.median(beside)) < 0.35 * missed


@pytest.mark.parametrize("noise, share", [(0.05, 0.9), (0.15, 0.8)])
def test_noise_is_not_taken_for_detail(monkeypatch, noise, share):
    """What the image says is weighed against the flat surface: errors along the lines stay below those without it."""
    scene = step_scene(noise=noise)
    rms = []
    for detail in (0.02, 10.0):
        monkeypatch.setattr(matcher, "DETAIL", detail)
        along, _ = errors(scene, fitted(scene, rough_start(scene)))
        rms.append(np.sqrt((along**2).mean()))
    assert rms[0] < share * rms[1]


def test_what_was_not_decoded_has_no_say(scene):
    """Nor has the image there, as in a shadow; pixels that were decoded keep their coordinates."""
    decoded = np.ones(scene.image.shape, bool)
    decoded[40:60] = False
    grid, start = draw_sharpnesses(PATTERN.render(), PERIOD)[0], rough_start(scene)
    dark = np.where(decoded, scene.image, np.float32(0.1))
    both = (scene.image, start), (dark, np.where(decoded, start, moved_start(scene, 2.0)))
    plain, disturbed = (LineFit(grid, SIZE).fitted(image, scene.lines, w, decoded) for image, w in both)
    np.testing.assert_allclose(disturbed[decoded], plain[decoded], atol=0.02)
    trusting = LineFit(grid, SIZE).fitted(dark, scene.lines, both[1][1], np.ones_like(decoded))
    assert abs(trusting - plain)[decoded].max() > 0.5


def test_small_regions_are_left_out(scene):
    start = scene.inverse_distance.copy()
    start[40:46, 40:46] *= 1.2
    coords = fitted(scene, start)
    assert np.isnan(coords[41:45, 41:45]).all() and np.isfinite(coords[20:38, 20:38]).all()


# ------------------------------------------------------------------ which matches are right

COUNT = len(FEATURES)


def flat_matches(shape=(40, 50)):
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    matches = (np.full(shape, 7, np.float32), np.full(shape, 20, np.uint8), np.full(shape, 99, np.float32))
    return StereoMatches(*matches), np.stack([1.4 * x, 1.4 * y], -1)


def features(matches, coords, decoded=None, mask=None):
    decoded = coords if decoded is None else decoded
    mask = np.ones(coords.shape[:2], bool) if mask is None else mask
    correlation = np.full(coords.shape[:2], 0.9, np.float32)
    return features_of(matches, coords, correlation, decoded, mask, 20.0, 14.0)


def test_features_are_what_their_names_say():
    matches, coords = flat_matches()
    coords[:, 25:] += 40  # a jump between columns 24 and 25
    matches.index[:, 25:] = 12
    decoded = coords.copy()
    decoded[:10] = np.nan
    decoded[10:20, :, 0] += 5
    found = features(matches, coords, decoded, np.arange(50)[None] < np.full((40, 1), 45))
    margin, cost, at, elsewhere, mask, jump, correlation, between = np.moveaxis(found, -1, 0)
    assert np.allclose(margin, np.log(100))
    assert (cost == 20).all() and (correlation == np.float32(0.9)).all()
    assert not at[:20].any() and at[20:].all()
    assert not elsewhere[:10].any() and elsewhere[10:20].all() and not elsewhere[20:].any()
    assert mask[:, :45].all() and not mask[:, 45:].any()
    # The two columns beside the jump are at distance zero; the next ones are 1, 2, .. pixels of 14 a period away.
    expected = np.log(np.minimum(np.abs(np.arange(50) - 24.5) - 0.5, 28) / 14 + 0.07)
    np.testing.assert_allclose(jump[20], expected, atol=1e-5)
    assert (between[:, 5:20] == 1).all() and (between[:, 24] < 0.7).all()


def test_a_match_at_the_decoded_place_far_from_jumps_is_right_and_a_lonely_one_beside_them_is_not():
    matches, coords = flat_matches()
    assert RIGHT.probability(features(matches, coords)).min() > 0.95
    y, x = np.mgrid[:40, :50].astype(np.float32)
    steep = replace(matches, index=3 * x - 2 * y + 90)  # each lies between its neighbours
    assert (features(steep, coords)[4:-4, 4:-4, -1] == 1).all()
    index = np.random.default_rng(0).uniform(0, 60, (40, 50)).astype(np.float32)
    wild = StereoMatches(index, np.full((40, 50), 90, np.uint8), matches.margin * 0)
    nowhere = np.full_like(coords, np.nan)
    assert RIGHT.probability(features(wild, coords * 20, nowhere, np.zeros((40, 50), bool))).max() < 0.2
