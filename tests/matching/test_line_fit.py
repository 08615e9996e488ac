"""The fit of matches to an image whose coordinates are known."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid_fit import draw_sharpnesses
from sl_nerfstudio.matching.lines import LineFitSettings
from sl_nerfstudio.matching.matcher import LineFit
from tests.matching.scene import PATTERN, PERIOD, step_scene

SIZE = 200 / 15


DEFAULTS = LineFitSettings()


def fitted(scene, settings=DEFAULTS, start=None):
    grid = draw_sharpnesses(PATTERN.render(), PERIOD)[0]
    w = scene.inverse_distance if start is None else start
    return LineFit(grid, SIZE, settings).fitted(scene.image, scene.lines, w)


def errors(scene, coords):
    """Along the lines and across them, pattern pixels, away from the image's border and from the step."""
    inner = np.ones(coords.shape[:2], bool)
    inner[:10], inner[-10:], inner[:, :10], inner[:, -10:], inner[100:120] = (False,) * 5
    slope = scene.lines.slopes(scene.inverse_distance)
    direction = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    apart = coords - scene.coords
    along = (apart * direction).sum(-1)
    across = apart[..., 1] * direction[..., 0] - apart[..., 0] * direction[..., 1]
    return along[inner], across[inner]


def rough_start(scene, seed=1):
    """Matches as the steps of the inverse distance leave them: half a pattern pixel off, differently everywhere."""
    slope = np.linalg.norm(scene.lines.slopes(scene.inverse_distance), axis=-1)
    return scene.inverse_distance + np.random.default_rng(seed).normal(0, 0.5, slope.shape) / slope


def test_rough_matches_become_exact_on_both_sides_of_a_step():
    scene = step_scene()
    along, across = errors(scene, fitted(scene, start=rough_start(scene)))
    assert np.isfinite(along).all()
    assert np.sqrt((along**2).mean()) < 0.06 and np.sqrt((across**2).mean()) < 0.05


def test_a_match_that_is_off_everywhere_is_drawn_to_the_image():
    scene = step_scene()
    slope = np.linalg.norm(scene.lines.slopes(scene.inverse_distance), axis=-1)
    along, _ = errors(scene, fitted(scene, start=scene.inverse_distance + 0.8 / slope))
    assert abs(np.median(along)) < 0.15


def test_a_pose_that_is_off_shows_across_the_lines():
    """The offset is what tells the joint adjustment where the projector stands: it must not be taken away."""
    scene = step_scene()
    moved = np.array([0.3, 0.5], np.float32)
    lines = replace(scene.lines, offset=scene.lines.offset - moved)  # as lines of a wrong pose run
    grid = draw_sharpnesses(PATTERN.render(), PERIOD)[0]
    w = lines.nearest(scene.coords)
    coords = LineFit(grid, SIZE, DEFAULTS).fitted(scene.image, lines, w)
    _, across = errors(scene, coords)
    slope = scene.lines.slopes(scene.inverse_distance)
    direction = slope / np.linalg.norm(slope, axis=-1, keepdims=True)
    missed = abs(moved[1] * direction[..., 0] - moved[0] * direction[..., 1]).mean()
    assert missed > 0.3 and abs(np.median(across)) < 0.35 * missed


@pytest.mark.parametrize("noise, share", [(0.05, 0.9), (0.15, 0.8)])
def test_noise_is_not_taken_for_detail(noise, share):
    """What the image says is weighed against the flat surface: errors along the lines stay below those without it."""
    scene = step_scene(noise=noise)
    start = rough_start(scene)
    weighed, _ = errors(scene, fitted(scene, LineFitSettings(detail=0.02), start=start))
    believed, _ = errors(scene, fitted(scene, LineFitSettings(detail=10.0), start=start))
    assert np.sqrt((weighed**2).mean()) < share * np.sqrt((believed**2).mean())


def test_small_regions_are_left_out():
    scene = step_scene()
    start = scene.inverse_distance.copy()
    start[40:46, 40:46] *= 1.2
    coords = fitted(scene, start=start)
    assert np.isnan(coords[41:45, 41:45]).all() and np.isfinite(coords[20:38, 20:38]).all()
