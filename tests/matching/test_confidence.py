"""What tells right matches from wrong ones."""

import numpy as np

from sl_nerfstudio.matching.costs import StereoMatches
from sl_nerfstudio.matching.matcher import (
    FEATURES,
    RIGHT,
    Logistic,
    features_of,
)

COUNT = len(FEATURES)


def flat_matches(shape=(40, 50)):
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    coords = np.stack([1.4 * x, 1.4 * y], -1)
    return StereoMatches(
        np.full(shape, 7.0, np.float32), np.full(shape, 20, np.uint8), np.full(shape, 99, np.float32)
    ), coords


def features(matches, coords, decoded=None, mask=None):
    decoded = coords if decoded is None else decoded
    mask = np.ones(coords.shape[:2], bool) if mask is None else mask
    correlation = np.full(coords.shape[:2], 0.9, np.float32)
    return features_of(matches, coords, correlation, decoded, mask, 2.0, 6.0, 14.0)


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


def test_matches_on_a_steep_plane_lie_between_their_neighbours():
    matches, coords = flat_matches()
    y, x = np.mgrid[:40, :50].astype(np.float32)
    steep = StereoMatches((3 * x - 2 * y + 90).astype(np.float32), matches.cost, matches.margin)
    assert (features(steep, coords)[4:-4, 4:-4, -1] == 1).all()


def test_a_match_at_the_decoded_place_far_from_jumps_is_right_and_a_lonely_one_beside_them_is_not():
    matches, coords = flat_matches()
    p = RIGHT.probability(features(matches, coords))
    assert p.min() > 0.95
    rng = np.random.default_rng(0)
    wild = StereoMatches(
        rng.uniform(0, 60, (40, 50)).astype(np.float32), np.full((40, 50), 90, np.uint8), matches.margin * 0
    )
    nowhere = np.full_like(coords, np.nan)
    p = RIGHT.probability(features(wild, coords * 20, nowhere, np.zeros((40, 50), bool)))
    assert p.max() < 0.2


def test_the_probability_is_logistic():
    weights = np.arange(1.0, COUNT + 1) / 10
    x = np.random.default_rng(1).normal(size=(3, 4, COUNT)).astype(np.float32)
    expected = 1 / (1 + np.exp(-(0.3 + (x * weights).sum(-1))))
    np.testing.assert_allclose(Logistic(0.3, tuple(weights)).probability(x), expected, rtol=1e-5)
