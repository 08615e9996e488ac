"""Rivals: clearly different similarities between the same two frames, and how near they come."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.pairs import PairMatch, Rival, is_ambiguous, register_pair
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surfaces import build_surface_map
from tests.registration.analytic_clouds import difference, rolled
from tests.registration.shaped_clouds import cloud_of_depth

PAIR = REGISTRATION_DEFAULTS.pair


def relief(x, y, odd: float):
    """The same after half a turn about the line of sight where `odd` is 0."""
    even = np.cos(17 * x) * np.cos(11 * y) + np.sin(9 * x) * np.sin(13 * y) + 4 * x * y
    return 3 + 0.06 * even + odd * np.exp(-((x - 0.12) ** 2 + (y - 0.1) ** 2) / 0.006)


@pytest.mark.parametrize(("odd", "ambiguous"), [(0.0, True), (0.35, False)])
def test_half_a_turn_of_a_symmetric_surface_is_a_rival_as_good_as_the_best(odd, ambiguous):
    surface = build_surface_map(cloud_of_depth(lambda x, y: relief(x, y, odd)))
    found = register_pair((surface, surface), (0, 1), PAIR.anywhere, np.random.default_rng(0))
    ratios = [rival.ratio for rival in found.rivals]
    assert ratios == sorted(ratios, reverse=True) and all(0 < ratio <= 1 for ratio in ratios)
    assert is_ambiguous(found) is ambiguous
    turns = Similarity.identity(), Similarity(1.0, rolled(180), np.zeros(3))
    said = [found.S_target_source, *(r.S_target_source for r in found.rivals)]
    if ambiguous:
        assert found.second_best_ratio > 0.97
        for true in turns:
            assert min(difference(S, true, surface.centroid)[0] for S in said[:2]) < 1
    else:
        assert difference(found.S_target_source, turns[0], surface.centroid)[0] < 1
    for k, a in enumerate(said):
        for b in said[:k]:
            angle, shift, _ = difference(a, b, surface.centroid)
            assert angle > PAIR.same_rotation_deg or shift > PAIR.same_shift * surface.radius


@given(st.lists(st.floats(0, 1), max_size=4))
def test_the_second_best_ratio_is_that_of_the_best_rival(ratios):
    rivals = tuple(Rival(Similarity.identity(), r) for r in sorted(ratios, reverse=True))
    match = PairMatch(0, 1, Similarity.identity(), np.eye(7), 0.5, 0.9, 0.02, rivals, 0.5, 0.0, np.zeros(7))
    assert match.second_best_ratio == max(ratios, default=0.0)
    assert replace(match, rivals=()).second_best_ratio == 0.0
    assert match.other(0) == 1 and match.other(1) == 0
