"""Colours of vertices: a ball whose colour is a function of the place, in pictures made by formula."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.meshing.mesh import GREY, Mesh
from sl_nerfstudio.meshing.texture import vertex_colours
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.images import encode_png

from .coloured_ball import BALL, PINHOLE, angle_cosines, colour_at, coloured_scan, picture


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return coloured_scan(tmp_path_factory.mktemp("colour") / "scan", pictures=3)


def test_vertices_have_the_colour_of_their_place_and_unseen_ones_are_grey(scan):
    found = vertex_colours(BALL, scan, scan.poses)
    assert found is not None and found.pictures == 3
    cosine = angle_cosines(scan, range(3), BALL.vertices)
    clearly = (cosine > 0.3).any(0)
    assert found.seen[clearly].all() and not found.seen[(cosine < 0.1).all(0)].any()
    expected = colour_at(BALL.vertices) * 255
    assert np.abs(found.rgb[clearly] - expected[clearly]).max() < 5
    assert (found.rgb[~found.seen] == GREY).all() and 0.2 < found.seen.mean() < 0.8


def test_flat_views_weigh_less(scan):
    """One picture is all white: its share in a vertex is its squared cosine."""
    white = np.full((PINHOLE.h, PINHOLE.w), 255, dtype=np.uint8)
    path = scan.root / "color/white.png"
    path.write_bytes(encode_png(white))
    first = replace(scan.frames[0], color_path=path)
    found = vertex_colours(BALL, replace(scan, frames=(first, *scan.frames[1:2])), scan.poses[:2])
    assert found is not None
    squares = angle_cosines(scan, range(2), BALL.vertices) ** 2
    both = (angle_cosines(scan, range(2), BALL.vertices) > 0.3).all(0)
    share = squares[0] / squares.sum(0)
    expected = 255 * (share[:, None] + (1 - share[:, None]) * colour_at(BALL.vertices))
    assert both.sum() > 100 and np.abs(found.rgb[both] - expected[both]).max() < 5


def test_what_is_hidden_takes_no_colour_from_what_hides_it(scan):
    eye = scan.frames[0].T_world_camera[:3, 3]
    plate = trimesh.creation.box((12.0, 12.0, 0.5))
    plate.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], eye / np.linalg.norm(eye)))
    plate.apply_translation(0.5 * eye)
    vertices = np.concatenate([BALL.vertices, plate.vertices]).astype(np.float64)
    faces = np.concatenate([BALL.faces, plate.faces + len(BALL.vertices)]).astype(np.int64)
    alone = replace(scan, frames=scan.frames[:1])
    open_view = vertex_colours(BALL, alone, scan.poses[:1])
    found = vertex_colours(Mesh(vertices, faces), alone, scan.poses[:1])
    assert open_view is not None and found is not None
    behind = open_view.seen & ~found.seen[: len(BALL.vertices)]
    ray = BALL.vertices - eye
    off = np.linalg.norm(np.cross(ray, -eye / np.linalg.norm(eye)), axis=1) / np.linalg.norm(ray, axis=1)
    assert behind.any() and (off[behind] < 0.06).all() and not (open_view.seen & (off < 0.036) & ~behind).any()
    assert (found.rgb[: len(BALL.vertices)][behind] == GREY).all()


def test_pictures_with_16_bits_and_a_scan_without_pictures(scan):
    assert vertex_colours(BALL, replace(scan, frames=scan.frames[3:]), scan.poses[3:]) is None
    path = scan.root / "color/deep.png"
    path.write_bytes(encode_png(picture(scan.frames[0].T_world_camera).astype(np.uint16) * 257))
    deep = replace(scan, frames=(replace(scan.frames[0], color_path=path),))
    plain = replace(scan, frames=scan.frames[:1])
    deep_found, found = (vertex_colours(BALL, s, scan.poses[:1]) for s in (deep, plain))
    assert deep_found is not None and found is not None and np.array_equal(deep_found.rgb, found.rgb)
