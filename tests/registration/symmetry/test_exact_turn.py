"""A turn that a pair says nearly, and all frames say exactly."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.symmetry import _motion_in_camera, exact_turn
from tests.registration.symmetry.turned_scan import Scan


def test_motions_of_the_world_are_those_of_points_in_the_camera() -> None:
    """Against points moved in the world, in a camera with a unit of its own."""
    rng = np.random.default_rng(0)
    S = Similarity(1.7, Rotation.random(random_state=3).as_matrix(), rng.standard_normal(3))
    centre, c = rng.standard_normal(3), rng.standard_normal(3)
    p = rng.standard_normal((5, 3))
    M = _motion_in_camera(S, c, centre) / S.scale
    for axis in range(6):
        x = 1e-6 * np.eye(6)[axis]
        world = S.points(p)
        moved = centre + (world - centre) @ Rotation.from_rotvec(x[3:]).as_matrix().T + x[:3]
        v, w, growth = np.split(M @ x, [3, 6])
        assert growth == 0
        expected = c + (p - c) @ Rotation.from_rotvec(w).as_matrix().T + v
        np.testing.assert_allclose(S.inverse().points(moved), expected, atol=1e-11)


@pytest.mark.parametrize("aside", [0.0, 40.0])
def test_the_turn_of_a_nut_is_found_from_five_degrees_off(tmp_path: Path, aside: float) -> None:
    """Its axis, too, wherever the world's origin is; and a turn has no scale."""
    trimesh.creation.cylinder(30, 25, sections=6).export(tmp_path / "nut.ply")
    scan = Scan(str(tmp_path / "nut.ply")).aside(aside)
    tilt = Rotation.from_euler("xyz", [2.0, -1.5, 57.0], degrees=True).as_matrix()
    start = Similarity(1.04, tilt, scan.axis - 1.04 * tilt @ scan.axis + [1.0, -0.5, 0.8])
    turn = exact_turn(scan.sides, scan.nodes, start, REGISTRATION_DEFAULTS)
    assert turn.scale == 1.0
    true = Rotation.from_euler("z", 60.0, degrees=True).as_matrix()
    assert angle_deg(turn.R @ true.T) < 0.3
    assert np.linalg.norm(turn.points(scan.axis[None])[0] - scan.axis) < 0.3  # millimetres of 60
