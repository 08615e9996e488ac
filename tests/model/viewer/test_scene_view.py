"""What nerfstudio's viewer shows of a scan, by the nodes of its scene."""

import math
import time
from typing import Any

import matplotlib
import numpy as np
import pytest
import viser.transforms as vtf

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.mesh import VertexQuality
from sl_nerfstudio.model.scene_nodes import DeviceNodes, first_view, vertical_fov
from sl_nerfstudio.model.viewer import MODES, UNKNOWN, SceneView, ViewerSurface
from tests.dataparser.tiny_scan import RADIUS
from tests.model.viewer.conftest import SCALE


def model_of(view: SceneView) -> Any:
    return view._model


def devices_of(view: SceneView) -> tuple[DeviceNodes, DeviceNodes]:
    assert view._devices is not None
    return view._devices


def messages(view: SceneView, kind: str) -> dict[str, Any]:
    """The last message of a kind about each node. What is sent at once arrives through a thread of viser's."""
    waiting = view.viser_server._websock_server._queued_messages
    for _ in range(500):
        if waiting.empty() and view.viser_server._websock_server._atomic_lock.acquire(timeout=1):
            view.viser_server._websock_server._atomic_lock.release()
            break
        time.sleep(0.01)
    queued = view.viser_server._websock_server._broadcast_buffer.message_from_id.values()
    return {m.name: m for m in queued if type(m).__name__ == kind}


def choose(view: SceneView, **values: Any) -> None:
    """As a user does; the callbacks run here."""
    for name, value in values.items():
        getattr(view.panel, name)._impl.value = value
        view._changed(name)


def test_every_device_is_named_coloured_and_where_it_stood(view: SceneView) -> None:
    scan = model_of(view).scan
    names = [frame.name for frame in scan.frames]
    frusta, labels = messages(view, "CameraFrustumMessage"), messages(view, "LabelMessage")
    colours = {"camera": (90, 160, 255), "projector": (255, 140, 40)}
    for devices, kind, T in zip(
        devices_of(view), colours, (scan.poses.T_world_camera, scan.poses.T_world_projector), strict=True
    ):
        for k, name in enumerate(names):
            r, g, b = colours[kind]
            assert frusta[f"/refined/{kind}/{name}"].color == r << 16 | g << 8 | b
            assert frusta[f"/starting/{kind}/{name}"].color == 130 << 16 | 130 << 8 | 130
            assert labels[f"/names/{kind}/{name}"].text == f"{kind} {k}"
            for handle in (devices.refined[k], devices.starting[k], devices.labels[k]):
                np.testing.assert_allclose(handle.position, 10 * SCALE * T[k, :3, 3], rtol=1e-6)
            looks = vtf.SO3(devices.refined[k].wxyz).as_matrix()[:, 2]  # viser's pyramids look along +z
            np.testing.assert_allclose(looks, -T[k, :3, 2], atol=1e-6)


@pytest.mark.parametrize(("fov", "aspect"), [(math.radians(75), 1.8), (0.6, 0.5)])
def test_the_first_view_is_framed_on_the_surface_which_is_there_at_once(view: SceneView, fov: float, aspect: float):
    assert "/surface" in messages(view, "GlbMessage") and view.panel.surface.value == "shaded"
    assert view._surface is not None
    surface = view._surface.mesh.vertices
    found = first_view(np.concatenate(view._numpy_poses()), surface, fov, aspect)
    np.testing.assert_allclose(found.centre, 0, atol=0.05)
    back = (found.eye - found.centre) / np.linalg.norm(found.eye - found.centre)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    seen = (surface - found.eye) @ np.stack([right, np.cross(back, right), -back], 1)
    edge = np.abs(seen[:, :2] / seen[:, 2:]) / (math.tan(fov / 2) * np.array([aspect, 1.0]))
    assert (seen[:, 2] > 0).all() and 0.85 < edge.max() < 1  # it fills the picture


def test_devices_follow_their_poses_with_a_line_from_the_start(view: SceneView) -> None:
    model = model_of(view)
    start = model.scan.poses
    T = start.T_world_camera.copy()
    T[1, :3, 3] += [5.0, -3.0, 2.0]
    model.current = DevicePoses(T, start.T_world_projector)
    view.update(force=True)
    cameras, projectors = devices_of(view)
    np.testing.assert_allclose(cameras.refined[1].position, 10 * SCALE * T[1, :3, 3], rtol=1e-6)
    np.testing.assert_allclose(cameras.labels[1].position, 10 * SCALE * T[1, :3, 3], rtol=1e-6)
    np.testing.assert_allclose(cameras.starting[1].position, 10 * SCALE * start.T_world_camera[1, :3, 3], rtol=1e-6)
    drawn = messages(view, "MeshMessage")
    rod = drawn["/moved/camera"].vertices.reshape(2, 3, 3).mean(1)  # one prism: its two ends
    np.testing.assert_allclose(rod, 10 * SCALE * np.stack([start.T_world_camera[1, :3, 3], T[1, :3, 3]]), rtol=1e-5)
    assert not drawn["/moved/projector"].vertices.any()  # nothing moved
    np.testing.assert_allclose(
        projectors.refined[1].position, 10 * SCALE * start.T_world_projector[1, :3, 3], rtol=1e-6
    )


def test_frames_that_cannot_be_placed_are_red(view: SceneView) -> None:
    model_of(view).lost = [False, True, False]
    view.update(force=True)
    for kind in ("camera", "projector"):
        assert messages(view, "CameraFrustumMessage")[f"/refined/{kind}/frame_00001"].color == 230 << 16 | 60 << 8 | 50
        assert messages(view, "LabelMessage")[f"/names/{kind}/frame_00001"].text == f"{kind} 1: not placed"
    T = model_of(view).scan.poses.T_world_camera
    np.testing.assert_allclose(devices_of(view)[0].refined[1].position, 10 * SCALE * T[1, :3, 3], rtol=1e-6)


def test_the_panel_hides_and_shows(view: SceneView) -> None:
    cameras, projectors = devices_of(view)

    def shown() -> list[bool]:
        nodes = (cameras.refined, cameras.starting, projectors.refined, projectors.starting)
        assert all(len({handle.visible for handle in handles}) == 1 for handles in nodes)
        return [*(handles[0].visible for handles in nodes), cameras.path.visible, projectors.path.visible]

    def named() -> list[list[int]]:
        return [[k for k, label in enumerate(d.labels) if label.visible] for d in (cameras, projectors)]

    assert shown() == [True] * 6 and named() == [[0], [0]]
    choose(view, frame=2)
    assert named() == [[2], [2]]
    choose(view, projectors=False)
    assert shown() == [True, True, False, False, True, False] and named() == [[2], []]
    choose(view, starting=False)
    assert shown() == [True, False, False, False, False, False]
    choose(view, projectors=True, names=True)
    assert shown() == [True, False, True, False, False, False] and named() == [[0, 1, 2], [0, 1, 2]]
    choose(view, starting=True, names=False)
    assert shown() == [True] * 6 and named() == [[2], [2]]


def test_rays_of_the_chosen_frame_meet_on_the_surface(view: SceneView) -> None:
    scan = model_of(view).scan
    choose(view, rays=True, frame=1)
    assert model_of(view).viewed_frame == 1 and view.viewer.rerendered == 1  # its projector lights the picture, too
    drawn = messages(view, "MeshMessage")
    for kind, T in (("camera", scan.poses.T_world_camera), ("projector", scan.poses.T_world_projector)):
        ends = drawn[f"/rays/{kind}"].vertices.reshape(-1, 2, 3, 3).mean(2) / (10 * SCALE)  # mm
        assert 20 < len(ends) <= 60
        np.testing.assert_allclose(ends[:, 0], np.broadcast_to(T[1, :3, 3], ends[:, 0].shape), rtol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(ends[:, 1], axis=1), RADIUS, atol=0.05)
    choose(view, frame=2)  # of which nothing was decoded
    drawn = messages(view, "MeshMessage")
    assert not drawn["/rays/camera"].vertices.any() and not drawn["/rays/projector"].vertices.any()
    choose(view, rays=False)
    assert not [name for name in view._nodes if name.startswith("/rays")]


def test_the_surface_in_all_colours(view: SceneView) -> None:
    for mode in MODES[1:]:
        choose(view, surface=mode)
        assert "/surface" in messages(view, "GlbMessage") and view.panel._legend.content
    found = view._surface
    choose(view, surface="views")
    assert view._surface is found  # of one step, there is one mesh
    model_of(view).step += 1
    choose(view, surface="sigma")
    assert view._surface is not found and "Step 8" in view.panel._legend.content
    choose(view, surface=MODES[0])
    assert "/surface" not in view._nodes and not view.panel.update.visible


def test_normals_depth_and_coordinates_have_the_colours_of_their_place(view: SceneView) -> None:
    surface, scan = ViewerSurface(model_of(view), 32), model_of(view).scan
    p = surface.mesh.vertices / SCALE  # mm, in the scan's axes
    np.testing.assert_allclose(surface.coloured("normals", 0).rgb, 127.5 * (p / RADIUS + 1), atol=8)
    distance = np.linalg.norm(p - scan.poses.T_world_camera[1, :3, 3], axis=1)
    depth = surface.coloured("depth", 1)
    assert depth.scale == ("turbo", pytest.approx(distance.min()), pytest.approx(distance.max()), "mm")
    share = (distance - distance.min()) / np.ptp(distance)
    np.testing.assert_allclose(depth.rgb, 255 * matplotlib.colormaps["turbo"](share)[:, :3], atol=1)
    rgb = surface.coloured("coordinates", 1).rgb
    T_projector_world = np.linalg.inv(scan.poses.T_world_projector[1])
    x, y, z = (p @ T_projector_world[:3, :3].T + T_projector_world[:3, 3]).T
    projector = scan.projector
    u, v = projector.cx - projector.fl_x * x / z, projector.cy + projector.fl_y * y / z
    # facing the projector, by more than the mesh's normals err, and away from the edges of its picture
    towards = scan.poses.T_world_projector[1, :3, 3] - p
    facing = (towards * p).sum(1) / (np.linalg.norm(towards, axis=1) * RADIUS)
    lit = (facing > 0.1) & (np.minimum(u, v) > 1) & (u < projector.w - 1) & (v < projector.h - 1)
    expected = 255 * np.stack([u[lit] % 128 / 128, v[lit] % 128 / 128, np.full(lit.sum(), 0.2)], 1)
    assert lit.sum() > 100
    np.testing.assert_allclose(rgb[lit], expected, atol=1)
    assert (rgb[facing < -0.1] == UNKNOWN).all()


def test_residual_sigma_and_views_are_those_of_the_vertices_and_grey_where_no_frame_confirms(view: SceneView) -> None:
    surface = ViewerSurface(model_of(view), 32)
    n = len(surface.mesh.vertices)
    sigma, residual, views = np.linspace(0, 0.2, n), np.linspace(3, 0, n), np.arange(n) % 4
    sigma[views == 0] = residual[views == 0] = np.nan
    surface.__dict__["quality"] = VertexQuality(sigma, sigma, views, residual, np.full(n, 20.0))
    for mode, values, units, share in (("sigma", sigma, "mm", 95), ("residual", residual, "pattern px", 95),
                                       ("views", views, "frames", 100)):  # fmt: skip
        coloured = surface.coloured(mode, 0)
        assert coloured.scale is not None
        colours, lower, upper, said = coloured.scale
        assert (lower, said) == (0, units) and upper == pytest.approx(np.nanpercentile(values, share))
        expected = 255 * matplotlib.colormaps[colours](np.clip(values / upper, 0, 1))[:, :3]
        np.testing.assert_allclose(coloured.rgb[views > 0], expected[views > 0], atol=1)
        assert (coloured.rgb[views == 0] == UNKNOWN).all() and "Grey: no frame confirms" in coloured.meaning


def test_a_field_without_a_surface_is_said_not_raised(view: SceneView) -> None:
    model_of(view).offset, model_of(view).step = 5.0, 8
    choose(view, surface="normals")
    assert "no zero level" in view.panel._legend.content and "/surface" not in view._nodes
    model_of(view).offset = 0.0
    view._changed("update")
    assert "/surface" in view._nodes


def test_vertical_field_of_view() -> None:
    pinhole = Device(w=640, h=480, fl_x=500.0, fl_y=400.0, cx=320.0, cy=240.0)
    assert vertical_fov(pinhole) == pytest.approx(2 * math.atan(240 / 400))
    doe = Device(w=600, h=600, fl_x=600.0, fl_y=600.0, cx=300.0, cy=300.0, model="DOE")
    assert vertical_fov(doe) == pytest.approx(2 * math.asin(300 / 600))
    shifted = Device(w=640, h=480, fl_x=500.0, fl_y=400.0, cx=320.0, cy=0.0)
    assert vertical_fov(shifted) == pytest.approx(math.atan(480 / 400))
