"""One frame decoded again, with everything known by formula."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.redecoding.measure import Ambiguity
from sl_nerfstudio.redecoding.redecode import PredictedSurface, redecode_frame
from tests.redecoding.lit_ball import CAMERA, PROJECTOR, T_CAMERA, T_PROJECTOR, ball, grid, picture, truth, with_holes

MASK = np.isfinite(truth()).all(-1)


@pytest.fixture(scope="module")
def predicted():
    return PredictedSurface(ball()).predict(CAMERA, PROJECTOR, T_CAMERA, T_PROJECTOR)


def again(decoded, predicted, image=None, mask=MASK):
    image = picture() if image is None else image
    return redecode_frame("f", image, mask, decoded, predicted, grid(), Ambiguity.of(grid()))


def error(coords):
    return np.linalg.norm(coords - truth(), axis=-1)


@pytest.mark.parametrize("share", [0.6, 0.9])
def test_cells_that_were_removed_come_back(predicted, share):
    decoded = with_holes(truth(), share)
    found, facts = again(decoded, predicted)
    new = np.isfinite(found).all(-1) & ~np.isfinite(decoded).all(-1)
    assert facts.decoded_after > 0.75 * MASK.sum() and facts.added == new.sum()
    assert np.median(error(found)[new]) < 0.05 and error(found)[new].max() < 1
    assert facts.replaced == facts.removed == 0
    kept = np.isfinite(decoded).all(-1)
    np.testing.assert_array_equal(found[kept], decoded[kept])  # what was decoded stays as it is, to the bit
    assert facts.limits is not None and facts.accepted_elsewhere < 0.01


def test_of_many_decoded_pixels_a_part_is_enough_to_learn_from(predicted, monkeypatch):
    monkeypatch.setattr("sl_nerfstudio.redecoding.redecode._MANY", 3000)
    decoded = with_holes(truth(), 0.6)
    found, facts = again(decoded, predicted)
    assert facts.checked < 0.15 * facts.decoded_before and facts.decoded_after > 0.75 * MASK.sum()
    assert np.nanmax(error(found)) < 1


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


@pytest.mark.parametrize("kind", ["blank", "another pattern", "noise"])
def test_an_image_without_the_pattern_gives_nothing(predicted, kind):
    images = {"blank": np.full(MASK.shape, 0.5, np.float32), "another pattern": picture(seed=7)}
    noise = np.random.default_rng(0).random(MASK.shape).astype(np.float32)
    decoded = with_holes(truth(), 0.6)
    found, facts = again(decoded, predicted, images.get(kind, noise))
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


@pytest.mark.parametrize("away", [(20, 0), (0, 12), (40, -20)])
def test_a_prediction_that_is_wrong_everywhere_is_refused(predicted, away):
    off = replace(predicted, coords=predicted.coords + np.float32(away))
    decoded = with_holes(truth(), 0.6)
    found, facts = again(decoded, off)
    assert facts.limits is None and np.array_equal(found, decoded, equal_nan=True)


@pytest.mark.parametrize("away", [(12, 5), (20, 0), (-20, 20), (60, 40)])
def test_a_prediction_that_is_wrong_in_a_part_gives_nothing_wrong_there(predicted, away):
    coords = predicted.coords.copy()
    coords[:, 84:] += np.float32(away)
    decoded = with_holes(truth(), 0.6)
    decoded[:, 84:] = np.nan
    found, facts = again(decoded, replace(predicted, coords=coords))
    new = np.isfinite(found).all(-1) & ~np.isfinite(decoded).all(-1)
    assert facts.added > 0.3 * MASK[:, :84].sum()
    assert (error(found)[new] > 2).mean() < 0.002


def test_a_frame_without_decoded_pixels_stays_empty(predicted):
    found, facts = again(np.full_like(truth(), np.nan), predicted)
    assert np.isnan(found).all() and facts.limits is None and facts.decoded_after == 0
