"""Objects that look the same after a turn: named where pairs of frames contradict each other by it, and only there."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.pairs import PairMatch, Rival
from sl_nerfstudio.registration.symmetry import _half, _parts
from tests.registration.symmetry.turned_scan import Scan


def contradicting(scan: Scan, degrees: float, scale: float = 1.0) -> PairMatch:
    right = scan.pair(0, 2)
    return PairMatch(**{**vars(right), "S_target_source": scan.turned(0, 2, degrees, scale)})


@pytest.fixture(scope="module")
def nut(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    path: Path = tmp_path_factory.mktemp("meshes") / "nut.ply"
    trimesh.creation.cylinder(30, 25, sections=6).export(path)
    return Scan(str(path))


@pytest.fixture(scope="module")
def frog() -> Scan:
    return Scan("frog")


def test_a_nut_looks_the_same_after_a_sixth_of_a_turn(nut: Scan) -> None:
    assert nut.turns(contradicting(nut, 60.0)) == pytest.approx((60.0,), abs=0.3)
    assert nut.turns(contradicting(nut, 60.0), contradicting(nut, 120.0)) == pytest.approx((60.0, 120.0), abs=0.3)


def test_all_frames_together_know_the_turn_better_than_the_pair_that_says_it(nut: Scan) -> None:
    """A turn that is off by some degrees, or has a scale, moves edges of the nut past each other."""
    for degrees, scale in ((57.0, 1.0), (61.0, 1.0), (60.0, 0.96), (62.0, 1.03)):
        assert nut.turns(contradicting(nut, degrees, scale)) == pytest.approx((60.0,), abs=0.3)


def test_a_rival_says_it_as_well(nut: Scan) -> None:
    doubtful = nut.pair(0, 2, (Rival(nut.turned(0, 2, -60.0), 0.9),))
    assert nut.turns(doubtful, used=True) == pytest.approx((60.0,), abs=0.3)


def test_pairs_that_agree_with_each_other_leave_no_doubt(nut: Scan) -> None:
    assert nut.turns() == ()


@pytest.mark.parametrize("degrees", [30.0, 45.0, 90.0])
def test_a_pair_that_fits_by_accident_is_no_symmetry(nut: Scan, degrees: float) -> None:
    assert nut.turns(contradicting(nut, degrees)) == ()


def test_a_symmetry_does_not_change_the_size(nut: Scan) -> None:
    assert nut.turns(contradicting(nut, 60.0, 1.2)) == ()


@pytest.mark.parametrize("degrees", [60.0, 180.0])
def test_a_frog_has_no_symmetry(frog: Scan, degrees: float) -> None:
    assert frog.turns(contradicting(frog, degrees)) == ()


def test_half_of_a_turn_made_twice_is_the_turn() -> None:
    rng = np.random.default_rng(1)
    for degrees in (12.0, 90.0, 179.9):
        axis = rng.standard_normal(3)
        R = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
        turn = Similarity(1.03, R, rng.standard_normal(3))
        half = _half(turn)
        twice = half @ half
        np.testing.assert_allclose(twice.R, turn.R, atol=1e-12)
        np.testing.assert_allclose(twice.t, turn.t, atol=1e-12)
        assert twice.scale == pytest.approx(1.03)
        assert Rotation.from_matrix(half.R).magnitude() == pytest.approx(np.radians(degrees / 2))
        first, second = _parts(turn)
        np.testing.assert_allclose(first.t, half.t, atol=1e-12)
        eight = second @ second @ second @ second @ second @ second @ second @ second
        three = turn @ turn @ turn
        np.testing.assert_allclose(eight.R, three.R, atol=1e-12)
        np.testing.assert_allclose(eight.t, three.t, atol=1e-10)
        assert Rotation.from_matrix(second.R).magnitude() == pytest.approx(np.radians(degrees * 3 / 8))


def test_what_is_round_has_no_sides() -> None:
    """A vase contradicts as little after any turn: which of two turns contradicts less is chance, and says nothing."""
    vase = Scan("vase")
    for degrees in (29.0, 60.0, 90.0):
        assert vase.turns(contradicting(vase, degrees)) == ()
        assert vase.aside(25.0).turns(contradicting(vase.aside(25.0), degrees)) == ()


def test_a_medal_that_slides_a_little_is_not_symmetric() -> None:
    medal = Scan("medal")
    for degrees in (10.0, 16.0):
        assert medal.turns(contradicting(medal, degrees)) == ()
