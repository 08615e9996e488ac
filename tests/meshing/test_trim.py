"""What is cut and what stays, against visibility computed by formula for balls and planes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, exp_se3
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.visibility import trim_to_observed

from .ray_cast_scan import CAMERA, look_at, pairs_around, scan_of

RADIUS = 40.0
POSES = pairs_around(6, elevation_deg=40)


def ball(centre: tuple[float, float, float], radius: float, cell: float = 1.5) -> Mesh:
    (x, y, z), r = centre, radius + 2 * cell
    return extract_mesh(
        lambda p: (p - p.new_tensor(centre)).norm(dim=-1) - radius,
        round(2 * r / cell),
        (x - r, y - r, z - r),
        (x + r, y + r, z + r),
    )


def together(*parts: Mesh) -> Mesh:
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts)])[:-1]
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]),
    )


def contains(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Which points are vertices of the mesh."""
    known = {tuple(v) for v in mesh.vertices.round(9)}
    return np.array([tuple(p) in known for p in points.round(9)])


def angle_beyond_horizon_deg(points: np.ndarray) -> np.ndarray:
    """For points of the ball at the origin: by how much the best frame sees and lights them (negative: not at all)."""
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    height = [
        np.min(
            [
                np.arcsin(((T[:3, 3] - points) * normals).sum(1) / np.linalg.norm(T[:3, 3] - points, axis=1))
                for T in pair
            ],
            0,
        )
        for pair in POSES
    ]
    return np.degrees(np.max(height, 0))


def euler(mesh: Mesh) -> int:
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    return len(mesh.vertices) - len(np.unique(edges, axis=0)) + len(mesh.faces)


@pytest.fixture(scope="module")
def truth() -> Mesh:
    return ball((0.0, 0.0, 0.0), RADIUS)


@pytest.fixture(scope="module")
def scan(truth, tmp_path_factory):
    return scan_of(truth, POSES, tmp_path_factory.mktemp("trim") / "scan")


def test_the_unseen_side_of_a_ball_is_cut_at_its_horizon(truth, scan):
    result = trim_to_observed(truth, scan)
    kept = contains(result.mesh, truth.vertices)
    margin = angle_beyond_horizon_deg(truth.vertices)
    assert kept[margin > 18].all()  # the last pixel of the ball's image is 18 degrees of it
    assert not kept[margin < -3].any()
    assert euler(result.mesh) == 1  # one disk: no hole, no speck
    assert result.total == len(truth.vertices) and result.unseen == pytest.approx((margin < 0).sum(), rel=0.25)
    assert result.contradicted == 0 and result.closed < 20 and result.loose_pieces < 10  # the horizon is ragged


TOWARDS_FIRST_CAMERA = np.array([np.cos(np.radians(40)), 0.0, np.sin(np.radians(40))])


def test_a_phantom_in_front_goes_and_what_it_hid_stays(truth, tmp_path):
    """One frame alone sees the phantom, and the surface behind it."""
    scan = scan_of(truth, POSES[:1], tmp_path / "scan")
    plain = trim_to_observed(truth, scan).mesh
    phantom = ball(tuple(62 * TOWARDS_FIRST_CAMERA), 9.0)
    result = trim_to_observed(together(truth, phantom), scan)
    assert not contains(result.mesh, phantom.vertices).any()
    assert np.array_equal(contains(result.mesh, truth.vertices), contains(plain, truth.vertices))
    centre = 62 * TOWARDS_FIRST_CAMERA
    faces = [((T[:3, 3] - phantom.vertices) * (phantom.vertices - centre)).sum(1) > 0 for T in POSES[0]]
    assert result.contradicted == pytest.approx((faces[0] & faces[1]).sum(), rel=0.1)


def test_a_bulge_on_the_surface_goes(truth, scan):
    """Surface that is 8 mm too far out over a patch: every frame decodes something else there."""
    towards = np.array([0.5, 0.0, np.sqrt(0.75)])
    angle = np.degrees(np.arccos((truth.vertices / RADIUS @ towards).clip(-1, 1)))
    bulged = Mesh(truth.vertices * (1 + 8 / RADIUS * np.clip((14 - angle) / 2, 0, 1))[:, None], truth.faces)
    result = trim_to_observed(bulged, scan)
    kept = contains(result.mesh, bulged.vertices)
    assert not kept[angle < 10].any()
    assert kept[(angle > 20) & (angle_beyond_horizon_deg(truth.vertices) > 18)].all()


def test_one_frame_that_sees_through_an_invented_patch_outweighs_two_that_decode_nothing_there(truth, tmp_path):
    """A bulge over a patch that two of three frames do not decode, and one decodes where the object really is."""
    towards, poses = np.array([0.0, 0.0, 1.0]), POSES[::2]
    angle = np.degrees(np.arccos((truth.vertices / RADIUS @ towards).clip(-1, 1)))
    bulged = Mesh(truth.vertices * (1 + 5 / RADIUS * np.clip((8 - angle) / 2, 0, 1))[:, None], truth.faces)

    def undecoded(number: int, coords: np.ndarray) -> np.ndarray:
        if number == 1:
            return coords
        row, column = np.mgrid[: CAMERA.h, : CAMERA.w] + 0.5
        x, y, z = np.linalg.solve(poses[number][0], [*(RADIUS * towards), 1.0])[:3]
        u, v = CAMERA.cx - CAMERA.fl_x * x / z, CAMERA.cy + CAMERA.fl_y * y / z
        return np.where((np.hypot(column - u, row - v) < 7)[..., None], np.float32(np.nan), coords)

    result = trim_to_observed(bulged, scan_of(truth, poses, tmp_path / "scan", undecoded))
    kept = contains(result.mesh, bulged.vertices)
    assert not kept[angle < 6].any()
    assert kept[(angle > 15) & (angle < 40)].all()


def cells(number: int, share: float, across: int = 16, size: int = 6) -> np.ndarray:
    """A share of the cells of size x size camera pixels, another one in each frame."""
    chosen = np.random.default_rng(number).random((across, across)) < share
    return np.kron(chosen, np.ones((size, size), dtype=bool))


@pytest.mark.parametrize("share", [0.15, 0.5])
def test_undecoded_cells_inside_the_mask_make_no_hole(truth, tmp_path, share):
    camera = CAMERA.scaled(2.0)
    whole = trim_to_observed(truth, scan_of(truth, POSES, tmp_path / "a", camera=camera)).mesh
    blank = np.float32(np.nan)
    scan = scan_of(
        truth, POSES, tmp_path / "b", lambda i, c: np.where(cells(i, share, 32)[..., None], blank, c), camera
    )
    holey = trim_to_observed(truth, scan).mesh
    assert euler(holey) == 1
    assert len(holey.faces) == pytest.approx(len(whole.faces), rel=0.05)  # cells at the border are no gaps


@pytest.mark.parametrize("frames", [1, 6])
def test_wrongly_decoded_cells_make_no_hole(truth, tmp_path, frames):
    """3 % wrong cells, off by 60 px; with one frame nothing else confirms the surface there."""
    camera, poses = CAMERA.scaled(2.0), POSES[:frames]
    wrong = scan_of(
        truth, poses, tmp_path / "a", lambda i, c: c + np.float32(60) * cells(i, 0.03, 96, 2)[..., None], camera
    )
    result = trim_to_observed(truth, wrong)
    assert euler(result.mesh) == 1
    assert len(result.mesh.faces) == pytest.approx(
        len(trim_to_observed(truth, scan_of(truth, poses, tmp_path / "b", None, camera)).mesh.faces), rel=0.02
    )
    assert frames > 1 or result.closed > 0


def test_noise_of_coordinates_and_poses_cuts_nothing(truth, scan, tmp_path):
    rng = np.random.default_rng(0)
    noisy = scan_of(truth, POSES, tmp_path / "scan", lambda i, c: c + rng.normal(0, 1, c.shape).astype(np.float32))
    tilt = exp_se3(torch.tensor([0.5, -0.5, 0.5, 0.003, 0.002, -0.003], dtype=torch.float64)).numpy()
    moved = DevicePoses(noisy.poses.T_world_camera @ tilt, noisy.poses.T_world_projector)
    faces = len(trim_to_observed(truth, noisy, moved).mesh.faces)
    assert faces == pytest.approx(len(trim_to_observed(truth, scan).mesh.faces), rel=0.02)


def test_shadows_and_hidden_parts_of_a_plane(tmp_path):
    """One frame, a ball above a plane: the plane stays where the ball blocks neither camera nor projector."""
    sphere, plane = ball((0.0, 0.0, 25.0), 12.0), plate(60.0, 1.0)
    both = together(sphere, plane)
    T_camera, T_projector = look_at((150.0, 0.0, 300.0)), look_at((-150.0, 60.0, 300.0))
    result = trim_to_observed(both, scan_of(both, [(T_camera, T_projector)], tmp_path / "scan"))
    kept = contains(result.mesh, plane.vertices)
    clear = np.min(
        [clearance(plane.vertices, T[:3, 3], np.array([0.0, 0.0, 25.0])) for T in (T_camera, T_projector)], 0
    )
    central = np.abs(plane.vertices).max(1) < 55
    assert kept[central & (clear > 12 + 4)].all()  # a camera pixel is 2 mm here
    assert not kept[clear < 12 - 4].any()


def plate(half: float, cell: float) -> Mesh:
    """The plane z = 0, seen from above."""
    n = int(2 * half / cell) + 1
    x, y = np.meshgrid(np.linspace(-half, half, n), np.linspace(-half, half, n))
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    faces = np.concatenate([i + np.array([0, 1, n]), i + np.array([1, n + 1, n])])
    return Mesh(np.stack([x.ravel(), y.ravel(), np.zeros(n * n)], 1), faces)


def clearance(points: np.ndarray, eye: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Distance of the ball's centre from the way of each point to the eye."""
    way = eye - points
    t = ((centre - points) * way).sum(1) / (way * way).sum(1)
    return np.linalg.norm(points + t.clip(0, 1)[:, None] * way - centre, axis=1)


def box(bottom: float, top: float, half: float = 30.0) -> Mesh:
    """A plate with upright sides."""
    centre, size = (0.0, 0.0, (top + bottom) / 2), (half, half, (top - bottom) / 2)

    def sdf(p: torch.Tensor) -> torch.Tensor:
        q = (p - p.new_tensor(centre)).abs() - p.new_tensor(size)
        return q.clamp_min(0).norm(dim=-1) + q.max(-1).values.clamp_max(0)

    return extract_mesh(sdf, 41, (-41.0, -41.0, -41.0), (41.0, 41.0, 41.0))


def test_the_sides_of_a_thin_plate_do_not_grow_downwards(tmp_path):
    """The field goes on below the lower edge, where no frame decodes anything: silence is no proof there."""
    scan = scan_of(box(-4.0, 4.0), POSES, tmp_path / "scan")
    grown = box(-33.0, 4.0)
    result = trim_to_observed(grown, scan).mesh
    kept = result.vertices
    # a camera pixel is 1.9 mm, so 2.5 mm of a side seen from 40 degrees above; a cell is 2 mm
    assert kept[:, 2].min() > -4 - 2.5 - 2
    top = grown.vertices[grown.vertices[:, 2] > 3.9]
    assert contains(result, top[np.abs(top[:, :2]).max(1) < 27]).all()
    side = grown.vertices[(np.abs(grown.vertices[:, :2]).max(1) > 29.9) & (np.abs(grown.vertices[:, 2]) < 2)]
    assert len(side) and contains(result, side).all()  # the true sides stay


def test_frames_that_look_along_a_side_do_not_say_how_far_it_reaches(tmp_path):
    """From 80 degrees above, a pixel is 11 mm of an upright side; frames from 15 degrees see its edge to 2 mm."""
    poses = pairs_around(6, elevation_deg=80) + pairs_around(6, elevation_deg=15)
    result = trim_to_observed(box(-13.0, 4.0), scan_of(box(-4.0, 4.0), poses, tmp_path / "scan")).mesh
    assert -4 - 2.5 < result.vertices[:, 2].min() < -2


def test_a_floating_piece_that_no_frame_confirms_goes(truth, tmp_path):
    """In front of it nothing was decoded at all, so nothing denies it: but nothing confirms it either."""
    phantom = ball(tuple(58 * TOWARDS_FIRST_CAMERA), 6.0)
    both = together(truth, phantom)
    blind = [covered_pixels(T_camera, phantom.vertices) for T_camera, _ in POSES]
    scan = scan_of(truth, POSES, tmp_path / "scan", lambda i, c: np.where(blind[i][..., None], np.float32(np.nan), c))
    result = trim_to_observed(both, scan)
    assert result.loose_pieces > 0
    assert not contains(result.mesh, phantom.vertices).any()


def covered_pixels(T_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels within two of a projection of the points."""
    p = (points - T_camera[:3, 3]) @ T_camera[:3, :3]
    u, v = 160 * p[:, 0] / -p[:, 2] + 48, -160 * p[:, 1] / -p[:, 2] + 48
    out = np.zeros((96, 96), dtype=bool)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            out[(v + dy).astype(int).clip(0, 95), (u + dx).astype(int).clip(0, 95)] = True
    return out


def test_given_poses_replace_those_of_the_scan(truth, scan):
    S = Similarity(
        1.0,
        exp_se3(torch.tensor([0, 0, 0, 0.3, -0.2, 0.9], dtype=torch.float64)).numpy()[:3, :3],
        np.array([500.0, -20, 7]),
    )
    moved = trim_to_observed(truth.mapped(S), scan, scan.poses.mapped(S)).mesh
    assert len(moved.faces) == pytest.approx(len(trim_to_observed(truth, scan).mesh.faces), rel=2e-3)


def test_wrong_poses_say_so(truth, scan):
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0])
    with pytest.raises(
        UserError,
        match=r"the frames observed no part(.|\n)*no vertex that faces camera and projector is inside a mask"
        r"(.|\n)*sl-check(.|\n)*--keep-unobserved",
    ):
        poses = DevicePoses(scan.poses.T_world_camera @ upside_down, scan.poses.T_world_projector @ upside_down)
        trim_to_observed(truth, scan, poses)


def test_another_surface_says_so(scan):
    with pytest.raises(UserError, match=r"coordinates are not the decoded ones; they differ by \d+ px"):
        trim_to_observed(ball((0.0, 0.0, -70.0), 25.0), scan)


def test_missing_mask_files_mean_decoded_pixels(truth, scan, tmp_path: Path):
    without = replace(scan, frames=tuple(replace(f, mask_path=None) for f in scan.frames))
    assert len(trim_to_observed(truth, without).mesh.faces) == len(trim_to_observed(truth, scan).mesh.faces)
