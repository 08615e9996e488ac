"""Which decoded pixels are probably wrong: the features, the model, and how it was trained."""

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid.image_decoder import GridImageDecoder
from sl_nerfstudio.decoding.grid.reliability import Evidence, Reliability
from sl_nerfstudio.decoding.grid.trained import load_reliability
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.noise import disturb_image
from sl_nerfstudio.synthesis.setup import make_setup
from training.reliability import Config, examples, fit

BEND = 4  # its place among the features


def evidence_of(coords):
    one = np.ones(coords.shape[:2], np.float32)
    return Evidence(coords, coords, one, one, one)


def plane(size=60):
    y, x = np.mgrid[:size, :size].astype(np.float32)
    return np.stack([1.2 * x + 0.1 * y, 1.1 * y], -1)


def test_a_plane_does_not_bend_and_a_tear_does():
    smooth, torn = plane(), plane()
    torn[:, 30:] += 12.0
    flat = evidence_of(smooth).features(20.0, 14.0)[15:45, 15:45, BEND]
    assert np.ptp(flat) < 0.05 and flat.max() < np.log(0.0025)
    bend = evidence_of(torn).features(20.0, 14.0)[30, :, BEND]
    assert bend[29:31].min() > bend[[10, 50]].max() + 3


def test_pixels_at_the_border_of_a_region_bend_and_unknown_ones_do_not_spoil_their_neighbours():
    coords = plane()
    coords[:, 40:] = np.nan
    features = evidence_of(coords).features(20.0, 14.0)[:, :40]
    assert np.isfinite(features).all()
    assert features[30, 39, BEND] > features[30, 20, BEND] + 2


def test_the_model_is_logistic():
    model = Reliability(np.array([1, 0, 0, 0, -2], np.float32), 0.5)
    features = np.array([[0, 3, 3, 3, 0], [1, 0, 0, 0, 1]], np.float32)
    np.testing.assert_allclose(model.wrong(features), [1 / (1 + np.exp(-0.5)), 1 / (1 + np.exp(0.5))], rtol=1e-5)


def test_the_shipped_model_tells_wrong_pixels_from_right_ones():
    truth = make_setup(SynthConfig(resolution=280, frames=2, seed=3)).render(0, 2)
    image = as_grey(disturb_image(truth.radiance, 1.05, 0.012, np.random.default_rng(0)))
    decoder = GridImageDecoder(GridPattern())
    found = decoder.detect(image)
    evidence = decoder.examine(image, found)
    chance = load_reliability().wrong(evidence.features(20.0, found.appearance.period))
    decoded = np.isfinite(evidence.fitted[..., 0])
    wrong = decoded & ~(np.linalg.norm(evidence.fitted - truth.coords, axis=-1) < 2)
    right = decoded & ~wrong
    order = chance[right][:, None] < np.random.default_rng(0).choice(chance[wrong], 200)
    assert wrong.sum() > 50 and order.mean() > 0.85


def test_the_training_finds_the_weights_that_made_its_data():
    rng = np.random.default_rng(0)
    weight, bias = np.array([1.5, -1, 0, 0.5, 2], np.float32), -1.0
    features = rng.normal(0.3, 1, (40000, 5)).astype(np.float32)
    wrong = rng.random(40000) < Reliability(weight, bias).wrong(features)
    found, found_bias = fit(features, wrong)
    np.testing.assert_allclose(found, weight, atol=0.1)
    assert found_bias == pytest.approx(bias, abs=0.1)


def test_examples_are_features_and_facts(tmp_path):
    features, wrong = next(
        one for number in range(6) if (one := examples(Config(tmp_path, size=160, pixels=500), number)) is not None
    )
    assert features.shape == (len(wrong), 5) and len(wrong) <= 500 and wrong.mean() < 0.5
