import numpy as np

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh, observable
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.meshing.mesh import Mesh

from .faceted_scan import looking_at_origin
from .shapes import sphere

DEVICE = Device(w=100, h=100, fl_x=400.0, fl_y=400.0, cx=50.0, cy=50.0)


def test_of_a_sphere_exactly_what_faces_both_devices_is_observable() -> None:
    surface = IndexedMesh(sphere(10.0, 120))
    points, normals = surface.sample(4000, 0)
    camera, projector = looking_at_origin(400.0, 0.0, 0.0), looking_at_origin(500.0, 1.0, 0.0)
    seen = observable(points, normals, surface, [(DEVICE, camera, DEVICE, projector)])
    heights = [(T[:3, 3] - points) @ np.eye(3) for T in (camera, projector)]
    cosines = np.array([(h * points / 10).sum(1) / np.linalg.norm(h, axis=1) for h in heights])
    clear = np.abs(cosines).min(0) > 0.05
    np.testing.assert_array_equal(seen[clear], (cosines > 0).all(0)[clear])


def test_frames_add_up_but_camera_and_projector_must_belong_to_one_frame() -> None:
    surface = IndexedMesh(sphere(10.0, 60))
    points, normals = surface.sample(2000, 0)
    front, back = looking_at_origin(400.0, 0.0, 0.0), looking_at_origin(400.0, np.pi, 0.0)
    both_front = observable(points, normals, surface, [(DEVICE, front, DEVICE, front)])
    everything = observable(points, normals, surface, [(DEVICE, front, DEVICE, front), (DEVICE, back, DEVICE, back)])
    never = observable(points, normals, surface, [(DEVICE, front, DEVICE, back)])
    assert 0.4 < both_front.mean() < 0.5
    assert everything.mean() > 0.9
    assert not never.any()


def test_what_is_hidden_or_out_of_the_picture_is_not_observed() -> None:
    ball = sphere(10.0, 60)
    shield = np.array([[30.0, -50, -50], [30.0, 50, -50], [30.0, 0, 80]])  # between the ball and the devices at +x
    both = IndexedMesh(
        Mesh(
            np.concatenate([ball.vertices, shield]),
            np.concatenate([ball.faces, [[0, 1, 2] + np.array(len(ball.vertices))]]),
        )
    )
    points, normals = IndexedMesh(ball).sample(500, 0)
    T = looking_at_origin(400.0, 0.0, 0.0)
    assert not observable(points, normals, both, [(DEVICE, T, DEVICE, T)]).any()
    aside = T.copy()
    aside[:3, 3] += 200 * T[:3, 0]
    assert not observable(points, normals, IndexedMesh(ball), [(DEVICE, T, DEVICE, aside)]).any()
