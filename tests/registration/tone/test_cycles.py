"""What only the tones of two frames say counts if a third frame confirms it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.assembly import Pivots
from sl_nerfstudio.registration.pairs import PairMatch
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.view_graph import with_confirmed_tones

PAIR = REGISTRATION_DEFAULTS.pair
AXIS = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # the motion along which frames slip: about y
CENTRE = np.array([0.1, 0.0, -3.0])
PIVOTS = Pivots(np.tile(CENTRE, (4, 1)), np.ones(4))


def turned(deg: float) -> Similarity:
    """About an axis through the centre of all frames."""
    R = Rotation.from_rotvec([0, np.radians(deg), 0]).as_matrix()
    return Similarity(1.0, R, CENTRE - R @ CENTRE)


def pair(source: int, target: int, deg: float, slip: float = 0.0, shape_slip: float = 12.0) -> PairMatch:
    """Frames of one walk about the axis, `deg` apart; by default held by tones."""
    return PairMatch(
        source, target, turned(deg), 1e4 * np.eye(7), 0.6, 0.98, 0.01, (), 0.5, slip, AXIS, max(shape_slip, slip)
    )  # fmt: skip


def by_tone(edges: list[PairMatch]) -> list[bool]:
    return [e.by_tone for e in with_confirmed_tones(edges, PIVOTS, PAIR)]


@pytest.mark.parametrize("reverse", [False, True])
def test_three_pairs_that_close_a_cycle_confirm_each_other(reverse):
    last = pair(2, 0, -45) if reverse else pair(0, 2, 45)
    assert by_tone([pair(0, 1, 20), pair(1, 2, 25), last]) == [True] * 3


def test_a_pair_that_no_cycle_confirms_slips():
    edges = [pair(0, 1, 20), pair(1, 2, 25), pair(0, 2, 45), pair(0, 3, 60), pair(1, 3, 100)]
    found = with_confirmed_tones(edges, PIVOTS, PAIR)
    assert [e.by_tone for e in found] == [True] * 3 + [False] * 2
    assert [e.slip_deg for e in found] == [0.0] * 3 + [12.0] * 2
    assert found[:3] == edges[:3]


def test_pairs_that_surfaces_hold_confirm_tones_and_need_no_confirmation_themselves():
    firm = pair(1, 2, 25, shape_slip=0.0)
    assert by_tone([pair(0, 1, 20), firm, pair(0, 2, 45)]) == [True, False, True]
    alone = pair(0, 1, 20, shape_slip=0.0)
    assert with_confirmed_tones([alone], PIVOTS, PAIR) == [alone]


def test_pairs_that_slip_confirm_nothing():
    assert by_tone([pair(0, 1, 20), pair(1, 2, 25, slip=12.0), pair(0, 2, 45)]) == [False] * 3


def test_a_pair_without_its_tone_is_as_uncertain_as_its_surfaces_leave_it():
    """Variances of independent motions add: along the slip it is larger by the slip's square, elsewhere the same."""
    held = pair(0, 1, 20)
    free = held.without_tone()
    before, after = np.linalg.inv(held.information), np.linalg.inv(free.information)
    np.testing.assert_allclose(after, before + np.radians(12) ** 2 * np.outer(AXIS, AXIS), atol=1e-9)
    assert free.rotation_sigma_deg == pytest.approx(np.hypot(12, np.degrees(0.01)), rel=1e-6)
    assert free.slip_deg == 12 and not free.by_tone and held.by_tone
