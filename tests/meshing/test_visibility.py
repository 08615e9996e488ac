"""Which frames see a vertex and whether they confirm it, and what is cut and stays."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import binary_dilation, distance_transform_cdt

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, exp_se3, exp_so3
from sl_nerfstudio.geometry.triangulation import pixel_rays, world_pixels
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.visibility import (
    ENOUGH,
    LEAST_PX,
    OFF_MASK_PX,
    Occluder,
    Trimmed,
    compare_decoded,
    count_frames,
    packed_device,
    trim_to_observed,
    visible_vertices,
)
from sl_nerfstudio.scan import Scan
from tests.formulas import pixels

from .ray_cast_scan import CAMERA, PROJECTOR, look_at, pairs_around, scan_of
from .solids import ball, extracted, plate, together, triangles_at_edges

POSES = (look_at((60.0, 0.0, 290.0)), look_at((-40.0, 30.0, 290.0)))


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Scan:
    """One frame of a plate of 60 mm."""
    return scan_of(plate(30.0, 1.0), [POSES], tmp_path_factory.mktemp("plate") / "scan")


def seen(mesh: Mesh, scan: Scan):
    everything = np.arange(len(mesh.vertices))
    occluder, frame = Occluder(mesh), scan.frames[0]
    return visible_vertices(mesh.vertices, mesh.vertex_normals(), everything, occluder, frame, PROJECTOR, *POSES)


def test_every_vertex_of_the_true_plate_is_seen_and_predicted_exactly(scan):
    mesh = plate(27.0, 1.5)  # ends 3 mm, about 1.5 camera pixels, inside the border
    view = seen(mesh, scan)
    assert np.array_equal(view.vertex, np.arange(len(mesh.vertices)))
    assert not view.off_mask.any() and not view.near_mask.any()
    inner = np.abs(mesh.vertices).max(1) < 25
    assert np.nanmax(view.most[inner]) < 0.05  # between pixels, bilinear interpolation is not a homography


def test_a_surface_at_another_height_is_predicted_wrong_by_the_parallax(scan):
    lifted = plate(20.0, 2.0, z=6.0)
    view = seen(lifted, scan)
    assert len(view.vertex) == len(lifted.vertices)
    # what is decoded there lies on z = 0, behind the vertex on its camera ray
    eye = POSES[0][:3, 3]
    behind = eye + (lifted.vertices - eye) * (eye[2] / (eye[2] - 6.0))
    both = [pixels(PROJECTOR, POSES[1], points) for points in (lifted.vertices, behind)]
    expected = np.linalg.norm(both[0] - both[1], axis=1)
    np.testing.assert_allclose(view.most, expected, rtol=0.02)
    assert expected.min() > LEAST_PX and (view.least > LEAST_PX).all()


def test_outside_the_mask_the_distance_in_pixels_decides(scan):
    """The mesh goes on beyond the true plate."""
    mesh, mask = plate(45.0, 1.0), scan.frames[0].read_mask()
    view = seen(mesh, scan)
    column, row = np.floor(pixels(CAMERA, POSES[0], mesh.vertices[view.vertex])).astype(int).T
    away = distance_transform_cdt(~mask, "chessboard")[row, column]
    assert np.array_equal(view.off_mask, away > OFF_MASK_PX) and view.off_mask.any()
    assert np.array_equal(view.near_mask, (away > 0) & (away <= OFF_MASK_PX)) and view.near_mask.any()
    assert (np.isnan(view.least) | ~view.off_mask).all()


def test_where_pixels_are_undecoded_their_neighbours_are_compared_on_the_tangent_plane(scan, tmp_path):
    lost = np.random.default_rng(0).random((CAMERA.h, CAMERA.w, 1)) < 0.7
    holey = scan_of(plate(30.0, 1.0), [POSES], tmp_path, lambda _, c: np.where(lost, np.float32(np.nan), c))
    decoded, mask = np.isfinite(holey.frames[0].read_coords()).all(-1), holey.frames[0].read_mask()
    for height in (0.0, 6.0):
        mesh = plate(20.0, 1.5, height)
        whole, view = seen(mesh, scan), seen(mesh, holey)
        column, row = np.floor(pixels(CAMERA, POSES[0], mesh.vertices[view.vertex])).astype(int).T
        known = binary_dilation(decoded, np.ones((3, 3)))[row, column] & mask[row, column]
        assert np.array_equal(np.isfinite(view.most), known) and 0 < known.mean() < 1
        np.testing.assert_allclose(view.most[known], whole.most[known], rtol=0.03, atol=0.05)
        assert (view.least[known] <= whole.most[known] + 0.05).all()


def test_counts_add_up_over_the_frames_and_stop_once_decided(tmp_path):
    mesh, frames = plate(20.0, 2.0), 6
    scan = scan_of(plate(30.0, 1.0), [POSES] * frames, tmp_path / "scan")
    counts = count_frames(mesh, Occluder(mesh), scan, scan.poses)
    checked_in_all = np.arange(len(mesh.vertices)) % 8 == 0
    assert (counts.confirmed == np.where(checked_in_all, frames, ENOUGH)).all()
    assert counts.decided.all()
    assert not (counts.contradicted.any() or counts.near_mask.any() or counts.inconclusive.any())
    assert counts.residual_px.shape == (frames,) and (counts.residual_px < 0.05).all()


def test_undecoded_frames_are_inconclusive_and_wrong_ones_contradict(tmp_path):
    def change(number: int, coords: np.ndarray) -> np.ndarray:
        return coords * np.float32(np.nan) if number == 0 else coords + np.float32(40) * (number == 1)

    mesh = plate(20.0, 2.0)
    scan = scan_of(plate(30.0, 1.0), [POSES] * 3, tmp_path / "scan", change)
    counts = count_frames(mesh, Occluder(mesh), scan, scan.poses)
    assert (counts.inconclusive == 1).all() and (counts.contradicted == 1).all() and (counts.confirmed == 1).all()
    assert (counts.against == 1).all() and not counts.decided.any()
    assert np.isnan(counts.residual_px[0]) and counts.residual_px[1] == pytest.approx(40 * 2**0.5, rel=1e-3)


RADIUS = 40.0
RING = pairs_around(6, elevation_deg=40)


def contains(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Which points are vertices of the mesh."""
    known = {tuple(v) for v in mesh.vertices.round(9)}
    return np.array([tuple(p) in known for p in points.round(9)])


def angle_beyond_horizon_deg(points: np.ndarray) -> np.ndarray:
    """For points of the ball at the origin: by how much the best frame sees and lights them (negative: not at all)."""
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    way = np.array(RING)[..., None, :3, 3] - points  # ring, device, point
    height = np.arcsin((way * normals).sum(-1) / np.linalg.norm(way, axis=-1))
    return np.degrees(height.min(1).max(0))


def euler(mesh: Mesh) -> int:
    return len(mesh.vertices) - len(triangles_at_edges(mesh)[0]) + len(mesh.faces)


@pytest.fixture(scope="module")
def truth() -> Mesh:
    return ball((0.0, 0.0, 0.0), RADIUS)


@pytest.fixture(scope="module")
def ball_scan(truth, tmp_path_factory):
    return scan_of(truth, RING, tmp_path_factory.mktemp("trim") / "scan")


@pytest.fixture(scope="module")
def result(truth, ball_scan) -> Trimmed:
    """What is kept of the ball."""
    return trim_to_observed(truth, ball_scan)


def test_the_unseen_side_of_a_ball_is_cut_at_its_horizon(truth, result):
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
    ball_scan = scan_of(truth, RING[:1], tmp_path / "scan")
    plain = trim_to_observed(truth, ball_scan).mesh
    phantom = ball(tuple(62 * TOWARDS_FIRST_CAMERA), 9.0)
    result = trim_to_observed(together(truth, phantom), ball_scan)
    assert not contains(result.mesh, phantom.vertices).any()
    assert np.array_equal(contains(result.mesh, truth.vertices), contains(plain, truth.vertices))
    outward = phantom.vertices - 62 * TOWARDS_FIRST_CAMERA
    faces = [((T[:3, 3] - phantom.vertices) * outward).sum(1) > 0 for T in RING[0]]
    assert result.contradicted == pytest.approx((faces[0] & faces[1]).sum(), rel=0.1)


def with_bulge(truth: Mesh, towards: np.ndarray, height: float, reach_deg: float) -> tuple[Mesh, np.ndarray]:
    """The ball, too far out over a patch; and how many degrees each vertex is from the middle of the patch."""
    angle = np.degrees(np.arccos((truth.vertices / RADIUS @ towards).clip(-1, 1)))
    factor = 1 + height / RADIUS * np.clip((reach_deg - angle) / 2, 0, 1)
    return Mesh(truth.vertices * factor[:, None], truth.faces), angle


def test_a_bulge_on_the_surface_goes(truth, ball_scan):
    """Every frame decodes something else there."""
    bulged, angle = with_bulge(truth, np.array([0.5, 0.0, np.sqrt(0.75)]), 8.0, 14.0)
    result = trim_to_observed(bulged, ball_scan)
    kept = contains(result.mesh, bulged.vertices)
    assert not kept[angle < 10].any()
    assert kept[(angle > 20) & (angle_beyond_horizon_deg(truth.vertices) > 18)].all()


def test_one_frame_that_sees_through_an_invented_patch_outweighs_two_that_decode_nothing_there(truth, tmp_path):
    """A bulge over a patch that two of three frames do not decode, and one decodes where the object really is."""
    towards, poses = np.array([0.0, 0.0, 1.0]), RING[::2]
    bulged, angle = with_bulge(truth, towards, 5.0, 8.0)

    def undecoded(number: int, coords: np.ndarray) -> np.ndarray:
        if number == 1:
            return coords
        row, column = np.mgrid[: CAMERA.h, : CAMERA.w] + 0.5
        u, v = pixels(CAMERA, poses[number][0], RADIUS * towards)
        return np.where((np.hypot(column - u, row - v) < 7)[..., None], np.float32(np.nan), coords)

    result = trim_to_observed(bulged, scan_of(truth, poses, tmp_path / "scan", undecoded))
    kept = contains(result.mesh, bulged.vertices)
    assert not kept[angle < 6].any()
    assert kept[(angle > 15) & (angle < 40)].all()


def cells(number: int, share: float, size: int) -> np.ndarray:
    """A share of the cells of size x size camera pixels, another one in each frame."""
    chosen = np.random.default_rng(number).random((192 // size, 192 // size)) < share
    return np.kron(chosen, np.ones((size, size), dtype=bool))[..., None]


def undecoded(share: float):
    return lambda i, c: np.where(cells(i, share, 6), np.float32(np.nan), c)


def wrong(i: int, c: np.ndarray) -> np.ndarray:
    """3 % of the cells are off by 60 px."""
    return c + np.float32(60) * cells(i, 0.03, 2)


FINE = CAMERA.scaled(2.0)


@pytest.fixture(scope="module")
def faces_observed(truth, tmp_path_factory) -> dict[int, int]:
    """Triangles that stay where one frame and where all of them decode everything."""
    root = tmp_path_factory.mktemp("fine")
    scans = {n: scan_of(truth, RING[:n], root / str(n), camera=FINE) for n in (1, len(RING))}
    return {n: len(trim_to_observed(truth, scan).mesh.faces) for n, scan in scans.items()}


@pytest.mark.parametrize(
    ("frames", "change", "tolerance"),
    [(6, undecoded(0.15), 0.05), (6, undecoded(0.5), 0.05), (6, wrong, 0.02), (1, wrong, 0.02)],
    ids=["15 % undecoded", "half undecoded", "wrong", "wrong, and nothing else confirms the surface"],
)
def test_undecoded_and_wrong_cells_inside_the_mask_make_no_hole(
    truth, faces_observed, tmp_path, frames, change, tolerance
):
    result = trim_to_observed(truth, scan_of(truth, RING[:frames], tmp_path / "scan", change, FINE))
    assert euler(result.mesh) == 1
    assert len(result.mesh.faces) == pytest.approx(faces_observed[frames], rel=tolerance)  # cells at borders: no gaps
    assert frames > 1 or result.closed > 0


def test_noise_other_axes_and_missing_masks_cut_nothing(truth, ball_scan, result, tmp_path):
    rng = np.random.default_rng(0)
    noisy = scan_of(truth, RING, tmp_path / "scan", lambda i, c: c + rng.normal(0, 1, c.shape).astype(np.float32))
    tilt = exp_se3(torch.tensor([0.5, -0.5, 0.5, 0.003, 0.002, -0.003], dtype=torch.float64)).numpy()
    tilted = DevicePoses(noisy.poses.T_world_camera @ tilt, noisy.poses.T_world_projector)
    R = exp_so3(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64)).numpy()
    S = Similarity(1.0, R, np.array([500.0, -20, 7]))
    without = replace(ball_scan, frames=tuple(replace(f, mask_path=None) for f in ball_scan.frames))
    for mesh, scan, poses, tolerance in (
        (truth, noisy, tilted, 0.02),
        (truth.mapped(S), ball_scan, ball_scan.poses.mapped(S), 2e-3),
        (truth, without, None, 0),  # decoded pixels are the mask
    ):
        faces = len(trim_to_observed(mesh, scan, poses).mesh.faces)
        assert faces == pytest.approx(len(result.mesh.faces), rel=tolerance)


def test_shadows_and_hidden_parts_of_a_plane(tmp_path):
    """One frame, a ball above a plane: the plane stays where the ball blocks neither camera nor projector."""
    sphere, plane = ball((0.0, 0.0, 25.0), 12.0), plate(60.0, 1.0)
    both = together(sphere, plane)
    T_camera, T_projector = look_at((150.0, 0.0, 300.0)), look_at((-150.0, 60.0, 300.0))
    result = trim_to_observed(both, scan_of(both, [(T_camera, T_projector)], tmp_path / "scan"))
    kept = contains(result.mesh, plane.vertices)
    centre = np.array([0.0, 0.0, 25.0])
    clear = np.min([clearance(plane.vertices, T[:3, 3], centre) for T in (T_camera, T_projector)], 0)
    central = np.abs(plane.vertices).max(1) < 55
    assert kept[central & (clear > 12 + 4)].all()  # a camera pixel is 2 mm here
    assert not kept[clear < 12 - 4].any()


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

    return extracted(sdf, 42, 41.0)


def test_the_sides_of_a_thin_plate_do_not_grow_downwards(tmp_path):
    """The field goes on below the lower edge, where no frame decodes anything: silence is no proof there."""
    ball_scan = scan_of(box(-4.0, 4.0), RING, tmp_path / "scan")
    grown = box(-33.0, 4.0)
    result = trim_to_observed(grown, ball_scan).mesh
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
    blind = [covered_pixels(T_camera, phantom.vertices) for T_camera, _ in RING]
    ball_scan = scan_of(
        truth, RING, tmp_path / "scan", lambda i, c: np.where(blind[i][..., None], np.float32(np.nan), c)
    )
    result = trim_to_observed(both, ball_scan)
    assert result.loose_pieces > 0
    assert not contains(result.mesh, phantom.vertices).any()


def covered_pixels(T_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels within two of a projection of the points."""
    u, v = pixels(CAMERA, T_camera, points).T
    out = np.zeros((96, 96), dtype=bool)
    for dy, dx in product(range(-2, 3), repeat=2):
        out[(v + dy).astype(int).clip(0, 95), (u + dx).astype(int).clip(0, 95)] = True
    return out


def test_wrong_poses_and_another_surface_are_told_apart(truth, ball_scan):
    upside_down, given = np.diag([1.0, -1.0, -1.0, 1.0]), ball_scan.poses
    poses = DevicePoses(given.T_world_camera @ upside_down, given.T_world_projector @ upside_down)
    said = r"the frames observed no part(.|\n)*no vertex that faces camera and projector is inside a mask"
    with pytest.raises(UserError, match=rf"{said}(.|\n)*last step(.|\n)*sl-process(.|\n)*--keep-unobserved"):
        trim_to_observed(truth, ball_scan, poses)
    with pytest.raises(UserError, match=r"coordinates are not the decoded ones; they differ by \d+ px"):
        trim_to_observed(ball((0.0, 0.0, -70.0), 25.0), ball_scan)


MOST_PX = 16.0


COUNT = 3000


LENS = {"k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -2e-3}


PLAIN = Device(96, 80, 160.0, 150.0, 48.0, 40.0), Device(400, 300, 800.0, 780.0, 200.0, 150.0)


BENT = Device(96, 80, 160.0, 150.0, 48.0, 40.0, **LENS), Device(400, 300, 800.0, 780.0, 200.0, 150.0, model="DOE")


def jacobian(points, normals, uv, devices, poses) -> Float[ndarray, "n 2 2"]:
    """Derivative of the predicted coordinate by the camera pixel's x and y, on the tangent plane."""
    columns = []
    for step in ((1.0, 0.0), (0.0, 1.0)):
        camera = Intrinsics.of(devices[0], torch.float64)
        origin, direction = pixel_rays(camera, torch.from_numpy(poses[0]), torch.from_numpy(uv[:, 0] + step))
        o, d = origin.numpy(), direction.numpy()
        towards = (d * normals).sum(1)
        distance = ((points - o) * normals).sum(1) / np.where(towards < 0, towards, -1e-12)
        there, _ = world_pixels(devices[1], poses[1], o + distance[:, None] * d)
        columns.append((there - uv[:, 1]).clip(-MOST_PX, MOST_PX))
    return np.stack(columns, -1)


def at(coords: ndarray, row: ndarray, column: ndarray) -> ndarray:
    return coords[np.clip(row, 0, coords.shape[0] - 1), np.clip(column, 0, coords.shape[1] - 1)].astype(float)


def bounds(coords: ndarray, uv: ndarray, J: ndarray) -> tuple[ndarray, ndarray]:
    """Bounds of the distance, by the rule that the compiled file states; which of them are bilinear."""
    slope = np.linalg.norm(J, axis=(1, 2))
    column, row = np.floor(uv[:, 0] - 0.5).astype(int).T
    corners = np.stack([at(coords, row + dy, column + dx) - uv[:, 1] for dy, dx in product((0, 1), repeat=2)])
    spread = np.linalg.norm(corners.max(0) - corners.min(0), axis=1)
    x, y = (uv[:, 0] - 0.5 - np.stack([column, row], 1)).T[:, :, None]
    value = (1 - y) * ((1 - x) * corners[0] + x * corners[1]) + y * ((1 - x) * corners[2] + x * corners[3])
    whole = spread <= 2 * slope + 1
    column, row = np.floor(uv[:, 0]).astype(int).T
    nine = []
    for dy, dx in product((-1, 0, 1), repeat=2):
        away = np.stack([column + dx, row + dy], 1) + 0.5 - uv[:, 0]
        off = at(coords, row + dy, column + dx) - uv[:, 1] - np.einsum("nij,nj->ni", J, away)
        distance, bend = np.linalg.norm(off, axis=1), 0.5 * slope * np.linalg.norm(away, axis=1)
        nine.append(((distance - bend).clip(min=0), distance))
    best = np.fmin.reduce(np.array(nine))
    return np.where(whole, np.linalg.norm(value, axis=1), best).T, whole


@pytest.mark.parametrize("devices", [PLAIN, BENT], ids=["plain", "lens and DOE"])
def test_bounds_are_those_of_the_formulas_for_arrays(devices: tuple[Device, Device]) -> None:
    rng = np.random.default_rng(8)
    poses = POSES
    points = np.column_stack([rng.uniform(-80, 80, (COUNT, 2)), rng.uniform(-10, 10, COUNT)])
    normals = rng.normal(size=(COUNT, 3)) * 0.5 + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = [world_pixels(device, T, points) for device, T in zip(devices, poses, strict=True)]
    which = np.flatnonzero(seen[0][1])
    uv = np.stack([pixels for pixels, _ in seen], 1)[which]
    # The coordinates of the plane z = 0, a step across the image, noise, and holes.
    h, w = devices[0].h, devices[0].w
    v, u = np.mgrid[:h, :w] + 0.5
    origin, d = pixel_rays(
        Intrinsics.of(devices[0], torch.float64), torch.from_numpy(poses[0]), torch.from_numpy(np.stack([u, v], -1))
    )
    ground = (origin - origin[..., 2:] / d[..., 2:] * d).numpy().reshape(-1, 3)
    coords = world_pixels(devices[1], poses[1], ground)[0].reshape(h, w, 2) + rng.normal(0, 0.3, (h, w, 2))
    coords[:, 50:] += 25
    coords[rng.random((h, w)) < 0.2] = np.nan
    coords[:20, :20] = np.nan
    mask = rng.random((h, w)) < 0.8
    grown = mask | (rng.random((h, w)) < 0.5)
    coords = coords.astype(np.float32)

    offsets, outside = np.full((len(which), 2), np.nan), np.empty((len(which), 2), dtype=bool)
    packed = np.stack([packed_device(device, T) for device, T in zip(devices, poses, strict=True)])
    compare_decoded(len(which), points, normals, which, uv, coords, mask, grown, packed, MOST_PX, offsets, outside)
    J = jacobian(points[which], normals[which], uv, devices, poses)
    wanted, whole = bounds(coords, uv, J)
    column, row = np.floor(uv[:, 0]).astype(int).T
    assert np.array_equal(outside, np.stack([~grown[row, column], ~mask[row, column]], 1))
    on = mask[row, column]
    assert min((whole & on).sum(), (~whole & on).sum(), (on & np.isnan(wanted[:, 0])).sum()) > 40
    assert (np.abs(J) == MOST_PX).any()
    np.testing.assert_allclose(offsets[on], wanted[on], rtol=1e-7, atol=1e-7)
    assert np.isnan(offsets[~on]).all()
