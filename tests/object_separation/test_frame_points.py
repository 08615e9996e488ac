"""Triangulated points are on the surface, and their sigma is how far they are from it."""

from dataclasses import replace

import numpy as np

from sl_nerfstudio.object_separation.planes import cross_frame_noise, normals_of, points_of


def test_points_of_the_table_scatter_about_it_by_their_stated_sigma(cases):
    case = cases("box", "table")
    ratios = []
    for frame, is_object in zip(case.frames, case.is_object, strict=True):
        points = points_of(frame)
        table = ~is_object[points.row, points.column]
        z = points.p_world[table, 2]
        up = np.array([0.0, 0.0, 1.0])
        off = z - np.median(z)  # without the error of the frame's pose
        ratios.append(1.4826 * np.median(np.abs(off) / points.sigma_along(up)[table]))
    assert 0.7 < np.median(ratios) < 1.6


def test_a_thinned_frame_has_the_same_points(cases):
    frame = cases("box", "table").frames[0]
    thin = frame.thinned(600)
    assert 300 < np.isfinite(thin.coords).all(-1).sum() <= 700 and thin.stride > 1
    few, all_ = points_of(thin), points_of(frame)
    place = {(r, c): p for r, c, p in zip(all_.row.tolist(), all_.column.tolist(), all_.p_world, strict=True)}
    same = [place[r * thin.stride, c * thin.stride] for r, c in zip(few.row.tolist(), few.column.tolist(), strict=True)]
    np.testing.assert_allclose(few.p_world, same, atol=1e-9)


def test_normals_look_at_the_camera_and_are_those_of_the_surface(cases):
    case = cases("box", "table")
    points = points_of(case.frames[0])
    normals = normals_of(points, 40)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    assert ((normals * points.ray).sum(1) <= 0).all()
    table = ~case.is_object[0][points.row, points.column]
    assert np.median(normals[table, 2]) > 0.95
    assert np.isnan(normals_of(points.chosen(np.arange(5)), 12)).all()


def test_poses_that_disagree_show_as_noise(cases):
    frames = cases("box", "table").frames
    points = [points_of(f.thinned(1500)) for f in frames]
    good = cross_frame_noise(points, [normals_of(p, 12) for p in points])
    lifted = []
    for k, frame in enumerate(frames):
        up = np.eye(4)
        up[2, 3] = 1.5 * (-1) ** k
        lifted.append(
            replace(frame, T_world_camera=up @ frame.T_world_camera, T_world_projector=up @ frame.T_world_projector)
        )
    apart = [points_of(f.thinned(1500)) for f in lifted]
    assert cross_frame_noise(apart, [normals_of(p, 12) for p in apart]) > 2 * good
    assert cross_frame_noise(points[:1], [normals_of(points[0], 12)]) == 1.0


def test_a_frame_without_coordinates_has_no_points(cases):
    frame = cases("box", "table").frames[0]
    empty = replace(frame, coords=np.full_like(frame.coords, np.nan))
    assert len(points_of(empty)) == 0
