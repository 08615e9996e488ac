"""What a surface predicts, and one frame decoded again, with everything known by formula."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.redecoding.measure import Ambiguity
from sl_nerfstudio.redecoding.redecode import PredictedSurface, redecode_frame
from tests.formulas import pixels
from tests.redecoding.lit_ball import (
    CAMERA,
    PROJECTOR,
    T_CAMERA,
    T_PROJECTOR,
    ball,
    grid,
    picture,
    seen_at,
    truth,
    with_holes,
)


@pytest.fixture(scope="module")
def predicted():
    return PredictedSurface(ball()).predict(CAMERA, PROJECTOR, T_CAMERA, T_PROJECTOR)


def test_coordinates_are_those_of_the_ball(predicted):
    both = predicted.known & np.isfinite(truth()).all(-1)
    assert (predicted.known != np.isfinite(truth()).all(-1)).mean() < 0.01  # the mesh's outline has corners
    error = np.linalg.norm(predicted.coords - truth(), axis=-1)[both]
    assert np.median(error) < 0.05 and np.quantile(error, 0.99) < 1  # large only where rays graze the facets


def test_a_point_that_moves_along_its_ray_moves_its_coordinate_along_the_stated_direction(predicted):
    row, column = 70, 84
    seen = seen_at(np.array([column + 0.5]), np.array([row + 0.5]))
    ray = seen.p_world[0] - T_CAMERA[:3, 3]
    way = pixels(PROJECTOR, T_PROJECTOR, seen.p_world + 0.01 * ray)[0] - seen.coords[0]
    np.testing.assert_allclose(predicted.along[row, column], way / np.linalg.norm(way), atol=2e-3)
    assert predicted.depth[row, column] * CAMERA.fl_x == pytest.approx(np.linalg.norm(ray), abs=0.05)


def test_there_is_no_prediction_in_the_shadow_of_something_else():
    way = T_PROJECTOR[:3, 3] / np.linalg.norm(T_PROJECTOR[:3, 3])
    side = np.cross(way, [0.0, 0, 1])
    corners = 150 * way + 20 * np.array([side, [0, 0, 1], -side, [0, 0, -1.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + len(ball().vertices)
    shaded = Mesh(np.concatenate([ball().vertices, corners]), np.concatenate([ball().faces, faces]))
    found = PredictedSurface(shaded).predict(CAMERA, PROJECTOR, T_CAMERA, T_PROJECTOR)
    light = np.abs(truth() - 200).max(-1)  # the plate is about the middle of the light
    assert not found.known[light < 60].any() and found.known[(light > 155) & (light < 170)].mean() > 0.9


def test_a_far_away_origin_changes_nothing(predicted):
    shift = np.array([1e5, -2e5, 3e5])
    T_camera, T_projector = T_CAMERA.copy(), T_PROJECTOR.copy()
    T_camera[:3, 3] += shift
    T_projector[:3, 3] += shift
    moved = Mesh(ball().vertices + shift, ball().faces)
    found = PredictedSurface(moved).predict(CAMERA, PROJECTOR, T_camera, T_projector)
    same = found.known & predicted.known
    assert (found.known == predicted.known).mean() > 0.999
    np.testing.assert_allclose(found.coords[same], predicted.coords[same], atol=0.02)


MASK = np.isfinite(truth()).all(-1)


def again(decoded, predicted, image=None, mask=MASK):
    image = picture() if image is None else image
    return redecode_frame("f", image, mask, decoded, predicted, grid(), Ambiguity.of(grid()))


def error(coords):
    return np.linalg.norm(coords - truth(), axis=-1)


@pytest.mark.parametrize(("share", "mask", "many"), [(0.6, MASK, 20_000), (0.9, MASK, 20_000), (0.6, None, 3000)])
def test_cells_that_were_removed_come_back(predicted, monkeypatch, share, mask, many):
    """Without a mask, the image itself tells where the pattern is; of many decoded pixels a part is enough."""
    monkeypatch.setattr("sl_nerfstudio.redecoding.redecode._MANY", many)
    decoded = with_holes(truth(), share)
    found, facts = again(decoded, predicted, mask=mask)
    assert facts.shown == (MASK.size if mask is None else MASK.sum())
    new = np.isfinite(found).all(-1) & ~np.isfinite(decoded).all(-1)
    assert facts.decoded_after > 0.75 * MASK.sum() and facts.added == new.sum()
    assert np.median(error(found)[new]) < 0.05 and error(found)[new].max() < 1
    assert facts.replaced == facts.removed == 0
    kept = np.isfinite(decoded).all(-1)
    np.testing.assert_array_equal(found[kept], decoded[kept])  # what was decoded stays as it is, to the bit
    assert facts.limits is not None and facts.accepted_elsewhere < 0.01
    assert (facts.checked < 0.15 * facts.decoded_before) == (many == 3000)


def test_noise_makes_no_wrong_values(predicted):
    rng = np.random.default_rng(0)
    image = (picture() + 0.03 * rng.standard_normal(MASK.shape)).astype(np.float32)
    decoded = with_holes(truth(), 0.6) + (0.3 * rng.standard_normal(truth().shape)).astype(np.float32)
    found, facts = again(decoded, predicted, image)
    new = np.isfinite(found).all(-1) & ~np.isfinite(decoded).all(-1)
    assert facts.decoded_after > 0.6 * MASK.sum() and (error(found)[new] > 2).mean() < 1e-3


def test_wrong_cells_are_replaced(predicted):
    decoded = with_holes(truth(), 0.3)
    wrong = np.zeros_like(MASK)
    wrong[60:75, 60:75] = wrong[85:100, 90:105] = True
    wrong &= np.isfinite(decoded).all(-1)
    decoded[60:75, 60:75, 0] += 20
    decoded[85:100, 90:105] += (-40, 20)
    found, facts = again(decoded, predicted)
    after = error(found)[wrong]
    assert wrong.sum() > 200 and facts.replaced > 0.8 * wrong.sum()
    assert (after[np.isfinite(after)] > 2).mean() < 0.03


@pytest.mark.parametrize(
    ("image", "away"),
    [
        (np.full(MASK.shape, 0.5, np.float32), (0, 0)),
        (picture(seed=7), (0, 0)),  # another pattern
        (np.random.default_rng(0).random(MASK.shape).astype(np.float32), (0, 0)),
        *((picture(), away) for away in ((20, 0), (0, 12), (40, -20))),
    ],
    ids=["blank", "another pattern", "noise", "one period", "across", "two periods"],
)
@pytest.mark.slow
def test_an_image_or_a_prediction_that_is_wrong_everywhere_changes_nothing(predicted, image, away):
    off = replace(predicted, coords=predicted.coords + np.float32(away))
    for decoded in (with_holes(truth(), 0.6), np.full_like(truth(), np.nan)):
        found, facts = again(decoded, off, image)
        np.testing.assert_array_equal(found, decoded)
        assert facts.limits is None and facts.added == 0


def test_where_the_image_lacks_the_pattern_nothing_is_added(predicted):
    """A smear over a part of the image: surface and poses would predict a coordinate, the image does not confirm it."""
    image, decoded = picture().copy(), with_holes(truth(), 0.6)
    image[70:100, 60:100] = image[70:100, 60:100].mean()
    found, _ = again(decoded, predicted, image)
    inside = np.zeros_like(MASK)
    inside[76:94, 66:94] = True
    assert not (np.isfinite(found) & ~np.isfinite(decoded)).all(-1)[inside].any()


@pytest.mark.parametrize("away", [(12, 5), (20, 0), (-20, 20), (60, 40)])
@pytest.mark.slow
def test_a_prediction_that_is_wrong_in_a_part_gives_nothing_wrong_there(predicted, away):
    coords = predicted.coords.copy()
    coords[:, 84:] += np.float32(away)
    decoded = with_holes(truth(), 0.6)
    decoded[:, 84:] = np.nan
    found, facts = again(decoded, replace(predicted, coords=coords))
    new = np.isfinite(found).all(-1) & ~np.isfinite(decoded).all(-1)
    assert facts.added > 0.3 * MASK[:, :84].sum()
    assert (error(found)[new] > 2).mean() < 0.002
