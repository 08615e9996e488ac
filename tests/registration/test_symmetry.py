"""Objects that look the same, or nearly, from several sides: a nut, a bar, a frog."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.assembly import PoseGraphSolution
from sl_nerfstudio.registration.pairs import LEAST_ODDS, PairMatch, Rival
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.registration.symmetry import symmetric_turns_deg
from tests.registration.graph_edges import edge
from tests.registration.shaped_clouds import RenderedClouds, rendered, write_bar

STEPS, ALL_AROUND = 8, 30  # steps of 9 to 17 degrees; a nut looks the same after 60
FRAMES = 8  # all the way around

# Turns that pairs say, of cameras around the axis z.


def ring(count: int, aside: float) -> list[Similarity]:
    """Cameras around an axis beside the origin of the world."""
    turns = [Rotation.from_euler("z", 360 * k / count, degrees=True).as_matrix() for k in range(count)]
    stand = Rotation.from_euler("x", 70, degrees=True).as_matrix()
    return [Similarity(1.0 + 0.1 * k, R @ stand, R @ stand @ [0, 0, 4] + [aside, 0, 0]) for k, R in enumerate(turns)]


def other_side(nodes: list[Similarity], i: int, j: int, degrees: float, scale: float = 1.0) -> Similarity:
    """What a pair says that takes one side of the object for another."""
    R, c = Rotation.from_euler("z", degrees, degrees=True).as_matrix(), nodes[0].t - nodes[0].R @ [0, 0, 4]
    return nodes[j].inverse() @ Similarity(scale, R, c - scale * R @ c) @ nodes[i]


def turns(nodes: list[Similarity], edges: list[PairMatch]) -> tuple[float, ...]:
    return symmetric_turns_deg(edges, PoseGraphSolution(dict(enumerate(nodes)), np.ones(len(edges), dtype=bool)))


def alike(nodes: list[Similarity], count: int, said: float, odds: float = -1.0, **kwargs) -> list[PairMatch]:
    """Pairs of neighbours, `count` of them with a rival on another side."""
    n = len(nodes)
    return [
        edge(
            nodes,
            k,
            (k + 1) % n,
            rivals=(Rival(other_side(nodes, k, (k + 1) % n, said, **kwargs), odds),) * (k < count),
        )
        for k in range(n)
    ]


@given(st.floats(25, 180), st.sampled_from([-1, 1]), st.floats(-50, 50), st.floats(-LEAST_ODDS + 0.1, 0))
def test_a_turn_that_most_frames_fit_as_well_is_named_wherever_the_axis_is(degrees, sense, aside, odds):
    nodes = ring(FRAMES, aside)
    assert turns(nodes, alike(nodes, FRAMES, sense * degrees, odds)) == pytest.approx((degrees,), abs=1e-3)
    assert turns(nodes, alike(nodes, FRAMES, sense * degrees, -LEAST_ODDS - 0.1)) == ()


def test_a_pair_that_says_the_turn_itself_counts_as_one_with_a_rival():
    nodes = ring(FRAMES, 3.0)
    swapped = [
        replace(e, S_target_source=e.rivals[0].S_target_source, rivals=(Rival(e.S_target_source, 0.0),))
        for e in alike(nodes, FRAMES, 60.0)
    ]
    assert turns(nodes, swapped) == pytest.approx((60.0,), abs=1e-3)


def test_what_is_no_turn_of_the_whole_object_is_not_named():
    """What few frames say, what changes the size, what slides a little, and what slips: a vase has no sides."""
    nodes = ring(FRAMES, 3.0)
    assert turns(nodes, alike(nodes, FRAMES, 60.0)) == pytest.approx((60.0,), abs=1e-3)
    assert turns(nodes, alike(nodes, 2, 60.0)) == ()
    assert turns(nodes, alike(nodes, FRAMES, 60.0, scale=1.2)) == ()
    assert turns(nodes, alike(nodes, FRAMES, 12.0)) == ()
    assert turns(nodes, [replace(e, slip_deg=30.0) for e in alike(nodes, FRAMES, 60.0)]) == ()
    assert turns(nodes[:1], []) == ()


# Whole scans.


def turned_from_truth(found: Registration, true: RenderedClouds) -> list[float]:
    """Angles between the rotations of registered frames, against the first, and the true ones, in degrees."""
    inside = np.flatnonzero(found.registered)
    first, R, T = inside[0], found.T_world_camera[:, :3, :3], true.T_world_camera[:, :3, :3]
    return [angle_deg(R[first].T @ R[k] @ (T[first].T @ T[k]).T) for k in inside]


@pytest.fixture(scope="module")
def nut_walk(tmp_path_factory: pytest.TempPathFactory) -> RenderedClouds:
    path: Path = tmp_path_factory.mktemp("meshes") / "nut.ply"
    trimesh.creation.cylinder(30, 25, sections=6).export(path)
    return rendered(str(path), tuple(range(STEPS)), ALL_AROUND, 90)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_nut_is_registered_at_the_sides_that_it_shows_or_said_to_be_symmetric(
    nut_walk: RenderedClouds, seed: int
) -> None:
    found = register(nut_walk.clouds, seed=seed)
    assert found.registered.sum() > STEPS / 2
    assert max(turned_from_truth(found, nut_walk)) < 3
    assert any(turn == pytest.approx(60, abs=1) for turn in found.turns_deg) or not found.by_order


@pytest.mark.slow
def test_no_frame_of_a_bar_is_on_the_wrong_side(tmp_path: Path) -> None:
    """Two bosses, one on each end, of unequal height: it is nearly the same after half a turn."""
    write_bar(tmp_path / "bar.ply")
    true = rendered(str(tmp_path / "bar.ply"), tuple(range(FRAMES)), FRAMES, 90)
    found = register(true.clouds)
    assert found.registered.sum() > FRAMES / 2
    assert max(turned_from_truth(found, true)) < 3 and not found.turns_deg


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["frog", "medal", "vase"])
def test_a_frog_a_medal_that_slides_and_a_vase_that_is_round_have_no_sides(scene: str) -> None:
    assert register(rendered(scene, tuple(range(FRAMES)), 24, 90).clouds).turns_deg == ()
