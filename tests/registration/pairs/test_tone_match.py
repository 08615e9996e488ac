"""Frames that slip along each other are held by the tone of their surface, or said to slip."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.agreement import Hypotheses, Side, Tolerance
from sl_nerfstudio.registration.pairs import PairMatch, likeness, register_pair, turn_by_tone
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surfaces import SurfaceMap, build_surface_map
from tests.registration.shaped_clouds import rendered

PAIR = REGISTRATION_DEFAULTS.pair


@cache
def vase(first: int, second: int) -> tuple[tuple[SurfaceMap, SurfaceMap], Similarity]:
    """Two frames of a vase with blotches, and the true similarity."""
    some = rendered("vase", (first, second), resolution=300, lit=True)
    maps, S = tuple(build_surface_map(c) for c in some.clouds), some.S_world_camera
    return (maps[0], maps[1]), S[1].inverse() @ S[0]


def registered(maps: tuple[SurfaceMap, SurfaceMap], seed: int = 0) -> PairMatch:
    found = register_pair(maps, (0, 1), PAIR.neighbours, np.random.default_rng(seed))
    assert found is not None
    return found


def without_tone(surface: SurfaceMap) -> SurfaceMap:
    return replace(surface, tone=np.full_like(surface.tone, np.nan))


@pytest.mark.parametrize("pair", [(4, 6), (9, 12), (15, 17)])
def test_the_blotches_of_a_vase_hold_it(pair):
    """Surfaces alone leave the frames turned by more; with tones, the turn is right to within what is stated."""
    maps, true = vase(*pair)
    bare, found = registered((without_tone(maps[0]), without_tone(maps[1]))), registered(maps)
    assert bare.slip_deg > 0 and not bare.by_tone
    assert found.slip_deg == 0 and found.by_tone
    off = angle_deg((found.S_target_source @ true.inverse()).R)
    assert off < 1.5 and off < 3.5 * found.rotation_sigma_deg
    assert found.rotation_sigma_deg < 3 < bare.rotation_sigma_deg


def test_tones_of_another_surface_hold_nothing():
    """The right shape with the blotches of another vase."""
    maps, _ = vase(4, 6)
    for seed in range(5):
        assert not registered((maps[0], with_tone(maps[1], blotches(maps[1], seed)))).by_tone


def blotches(surface: SurfaceMap, seed: int) -> np.ndarray:
    """Random ones, about as large as those of the vase."""
    return gaussian_filter(np.random.default_rng(seed).standard_normal(surface.valid.shape), 4)


def with_tone(surface: SurfaceMap, tone: np.ndarray) -> SurfaceMap:
    return replace(surface, tone=np.where(np.isfinite(surface.tone), tone, np.nan).astype(np.float32))


def test_what_light_and_view_make_holds_nothing():
    """Both cameras see the same tones at the same places of their images: a highlight, not a print."""
    maps, _ = vase(4, 6)
    for seed in range(5):
        made = blotches(maps[0], seed)
        assert not registered((with_tone(maps[0], made), with_tone(maps[1], made))).by_tone


def test_a_motion_that_leaves_both_surfaces_ends_without_a_word():
    """What shrinks or grows threefold within a radian has nothing to follow after some steps."""
    maps, true = vase(4, 6)
    rng = np.random.default_rng(0)
    sides = Side.sampled(maps[0], 400, rng), Side.sampled(maps[1], 400, rng)
    away = np.array([5.0, -3.0, 4.0, 0.6, 0.0, 0.8, 1.1])
    with np.errstate(all="raise", under="ignore"):
        assert turn_by_tone(sides, true, (away, 12.0), Tolerance(0.0, 2.0), PAIR) is None


def test_likeness_is_the_correlation_of_the_tones_that_meet():
    """Of a frame with itself it is one; with the opposite tones minus one; turned away it is not known."""
    (surface, _), _ = vase(4, 6)
    opposite = replace(surface, tone=-surface.tone)
    same, far = Similarity.identity(), Similarity(1.0, Rotation.from_rotvec([0, 2.5, 0]).as_matrix(), np.zeros(3))
    both = Hypotheses.joined([Hypotheses.of(same), Hypotheses.of(far)])
    width, rng = Tolerance(0.0, 2.0), np.random.default_rng(0)
    sides = Side.sampled(surface, 400, rng), Side.sampled(surface, 400, rng)
    found = likeness(sides, both, width, PAIR)
    assert found.correlation[0] == pytest.approx(1) and np.isnan(found.correlation[1])
    assert found.share[0] == pytest.approx(1, abs=0.02) and found.share[1] < PAIR.tone.least_share
    turned = likeness((sides[0], Side.sampled(opposite, 400, rng)), both, width, PAIR)
    assert turned.correlation[0] == pytest.approx(-1)
