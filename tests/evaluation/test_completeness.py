"""Openings of a mesh, and what to capture next."""

import numpy as np
import pytest

from sl_nerfstudio.evaluation.completeness import (
    NextView,
    find_openings,
    information,
    known,
    next_view,
    occluders,
    places,
)
from sl_nerfstudio.evaluation.mesh_index import CaptureView, IndexedMesh
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from tests.formulas import look_at

from .shapes import sphere


def cut_sphere(*heights: float, radius: float = 1.0) -> Mesh:
    """A sphere without the caps beyond the given signed heights."""
    mesh = sphere(radius, resolution=80)
    z = mesh.vertices[mesh.faces].mean(1)[:, 2]
    keep = np.ones(len(z), bool)
    for height in heights:
        keep &= z < height if height > 0 else z > height
    return mesh.with_faces(keep)


def test_a_closed_surface_has_no_openings():
    found = find_openings(sphere())
    assert len(found) == 0 and len(found.fan) == 0 and found.normal.shape == (0, 3)


def test_two_caps_are_two_openings_with_the_circles_area_length_and_axis():
    found = find_openings(cut_sphere(0.8, -0.3, radius=1.0))
    assert len(found) == 2
    for k, height in enumerate((-0.3, 0.8)):  # the largest first
        r = np.sqrt(1 - height**2)
        assert found.area[k] == pytest.approx(np.pi * r**2, rel=0.03)
        assert found.length[k] == pytest.approx(2 * np.pi * r, rel=0.15)  # jagged
        np.testing.assert_allclose(found.normal[k], [0, 0, np.sign(height)], atol=0.02)
        np.testing.assert_allclose(found.centre[k], [0, 0, height], atol=0.05)


def test_the_closing_triangles_close_the_mesh():
    """The divergence theorem: the vector areas of a closed surface add up to zero."""
    mesh = cut_sphere(0.6, -0.1)
    found = find_openings(mesh)
    corners = np.concatenate([mesh.vertices[mesh.faces], found.fan])
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(0)
    np.testing.assert_allclose(area, 0, atol=1e-9)


DEVICE = Device(w=300, h=300, fl_x=500.0, fl_y=500.0, cx=150.0, cy=150.0)
DISTANCE = 5.0


def poses(angles_deg: np.ndarray, elevation: float) -> DevicePoses:
    """Cameras at some angles around the axis, each with its projector 12 degrees to the side."""
    ring = [(np.cos(a), np.sin(a), elevation) for a in np.radians(angles_deg)]
    beside = [(np.cos(a), np.sin(a), elevation) for a in np.radians(np.asarray(angles_deg) + 12)]
    return DevicePoses(
        *(np.stack([look_at(DISTANCE * np.array(d) / np.linalg.norm(d)) for d in way]) for way in (ring, beside))
    )


def proposed(mesh: Mesh, devices: DevicePoses) -> NextView:
    pairs = zip(devices.T_world_camera, devices.T_world_projector, strict=True)
    frames = [CaptureView(DEVICE, T_camera, DEVICE, T_projector) for T_camera, T_projector in pairs]
    found = next_view(IndexedMesh(mesh), find_openings(mesh), frames, 0.3)
    assert found is not None
    return found


def test_a_view_from_below_is_proposed_where_the_underside_is_missing():
    found = proposed(cut_sphere(-0.4), poses(np.arange(0, 360, 30), 0.6))
    way = found.T_world_camera[:3, 3] / np.linalg.norm(found.T_world_camera[:3, 3])
    assert way[2] < -0.8 and found.elevation_deg < -53 and found.opening == 0
    assert np.linalg.norm(found.T_world_camera[:3, 3]) == pytest.approx(DISTANCE, rel=0.1)
    assert found.new_area > 0.6 * found.unseen_area and found.removed > 0.6


def test_the_unseen_side_is_proposed_where_nothing_is_cut_off():
    """Cameras on one side only; the mesh goes on where no frame looked."""
    found = proposed(cut_sphere(), poses(np.array([-20.0, 0.0, 20.0]), 0.0))
    way = found.T_world_camera[:3, 3] / np.linalg.norm(found.T_world_camera[:3, 3])
    assert way[0] < -0.5 and found.nearest_deg > 90 and found.opening == -1


def test_a_projector_that_stands_still_stays_where_it_is():
    devices = poses(np.array([-30.0, 0.0, 30.0]), 0.5)
    still = DevicePoses(devices.T_world_camera, np.repeat(devices.T_world_projector[1:2], 3, 0))
    found = proposed(cut_sphere(-0.4), still)
    np.testing.assert_array_equal(found.T_world_projector, still.T_world_projector[0])


def test_information_follows_from_noise_angle_and_visibility():
    mesh = cut_sphere(-0.4)
    surface, openings = IndexedMesh(mesh), find_openings(mesh)
    at, hiding = places(surface, openings, 400), occluders(surface, openings)
    wide, narrow = (poses(np.array([0.0]), 0.6) for _ in range(2))
    narrow.T_world_projector[0] = poses(np.array([-9.0]), 0.6).T_world_projector[0]  # 3 degrees beside the camera
    views = [CaptureView(DEVICE, p.T_world_camera[0], DEVICE, p.T_world_projector[0]) for p in (wide, narrow)]
    one, coarse = information(at, hiding, views[0], 0.3), information(at, hiding, views[0], 0.6)
    np.testing.assert_allclose(one, 4 * coarse)  # variance is the square of the noise
    flat = information(at, hiding, views[1], 0.3)
    both = (one > 0) & (flat > 0)
    assert both.sum() > 50 and np.median(one[both] / flat[both]) == pytest.approx(16, rel=0.2)  # (12 / 3)^2
    facing = (at.normals * views[0].T_world_camera[:3, 2]).sum(1)
    assert (one[facing < 0] == 0).all() and (one[at.opening >= 0] == 0).all()  # the opening looks down
    total = known(at, hiding, views, 0.3)
    np.testing.assert_allclose(total, one + flat + 1 / at.doubt**2)
    assert at.area.sum() == pytest.approx(surface.area + openings.area.sum(), rel=1e-6)
