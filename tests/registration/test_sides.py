"""Objects that look the same, or nearly, from several sides: a nut, a bar, a frog."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.geometry.lie import angle_deg
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import Registration
from tests.registration.shaped_clouds import RenderedClouds, rendered, write_bar

STEPS, ALL_AROUND = 8, 30  # steps of 9 to 17 degrees; a nut looks the same after 60
FRAMES = 8  # all the way around


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
def test_a_bar_is_registered_all_around(tmp_path: Path) -> None:
    """Two bosses, one on each end, of unequal height: it is nearly the same after half a turn.

    In steps of 45 degrees errors of scale add up around it: rigid parts would not meet.
    """
    write_bar(tmp_path / "bar.ply")
    true = rendered(str(tmp_path / "bar.ply"), tuple(range(FRAMES)), FRAMES, 90)
    found = register(true.clouds)
    assert found.registered.all() and not found.turns_deg
    assert max(turned_from_truth(found, true)) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["frog", "medal", "vase"])
def test_a_frog_a_medal_that_slides_and_a_vase_that_is_round_have_no_sides(scene: str) -> None:
    assert register(rendered(scene, tuple(range(FRAMES)), 24, 90).clouds).turns_deg == ()
