"""Scans without noise, as files, against formulas and a ray caster that share nothing with the package."""

import json

import cv2
import numpy as np
import pytest
import trimesh

from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise


def nearest_on_mesh(vertices, faces, o, d):
    """Distances along rays to the first triangle, each ray against all triangles (Moeller and Trumbore)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    out = np.empty(len(d))
    for n, (origin, direction) in enumerate(zip(np.broadcast_to(o, d.shape), d, strict=True)):
        h = np.cross(direction, e2)
        det = (e1 * h).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            u = (s * h).sum(1) / det
            q = np.cross(s, e1)
            v = (q @ direction) / det
            t = (e2 * q).sum(1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & np.isfinite(t)
        out[n] = t[hit].min(initial=np.inf)
    return out


def camera_rays(camera, T_world_camera, uv):
    """Unit directions in the world of pixels; distortion is undone by OpenCV."""
    K = np.array([[camera["fl_x"], 0, camera["cx"]], [0, camera["fl_y"], camera["cy"]], [0, 0, 1]])
    bend = np.array([camera[k] for k in ("k1", "k2", "p1", "p2")])
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
    flat = cv2.undistortPointsIter(uv[:, None].astype(np.float64), K, bend, None, None, stop)[:, 0]
    d = np.stack([flat[:, 0], -flat[:, 1], -np.ones(len(uv))], 1)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return d @ T_world_camera[:3, :3].T


def projector_pixels(projector, T_world_projector, p_world):
    """x_p, y_p of points by the formulas of the scan format."""
    p = (p_world - T_world_projector[:3, 3]) @ T_world_projector[:3, :3]
    q = np.linalg.norm(p, axis=1) if projector["model"] == "DOE" else -p[:, 2]
    x, y = p[:, 0] / q, -p[:, 1] / q  # y down, as images have it
    k1, k2, p1, p2 = (projector[k] for k in ("k1", "k2", "p1", "p2"))
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([projector["fl_x"] * xd + projector["cx"], projector["fl_y"] * yd + projector["cy"]], 1)


_VARIANTS = {
    "pinhole": {},
    "DOE": {"projector_model": "DOE", "projector_distortion": (0.02, 0.0, 0.0, 0.001)},
    "bent": {
        "camera_distortion": (-0.3, 0.08, 0.002, -0.001),
        "projector_distortion": (0.15, -0.05, 0.001, 0.002),
        "path": "rigid-rig",
    },
    "static": {"path": "static-projector", "world_turn": 3, "units": "cm"},
}


@pytest.fixture(scope="module", params=_VARIANTS)
def scan(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("clean") / request.param
    synthesise(SynthConfig(clean=True, frames=3, resolution=96, seed=11, **_VARIANTS[request.param]), root)
    return root


def _frames(root):
    """Camera, projector and, for each frame, both poses, coordinates and mask, read without the package."""
    document = json.loads((root / "transforms.json").read_text())
    for frame in document["frames"]:
        coords = np.load(root / frame["sl_coords_path"])["coords"].astype(np.float64)
        mask = cv2.imread(str(root / frame["mask_path"]), cv2.IMREAD_UNCHANGED) > 0
        poses = [np.array(frame[k]) for k in ("transform_matrix", "projector_transform_matrix")]
        yield document, document["projector"], *poses, coords, mask


def _pixels(mask):
    rows, columns = np.nonzero(mask)
    return np.stack([columns, rows], 1) + 0.5


def test_coordinates_are_those_of_the_first_point_on_the_mesh(scan):
    mesh = trimesh.load(scan / "ground_truth/mesh.ply", process=False)
    rng = np.random.default_rng(0)
    for camera, projector, T_c, T_p, coords, mask in _frames(scan):
        uv = rng.permutation(_pixels(mask))[:40]
        d = camera_rays(camera, T_c, uv)
        t = nearest_on_mesh(mesh.vertices, mesh.faces, T_c[:3, 3], d)
        expected = projector_pixels(projector, T_p, T_c[:3, 3] + t[:, None] * d)
        column, row = (uv - 0.5).astype(int).T
        np.testing.assert_allclose(coords[row, column], expected, atol=1e-3)


def test_the_mask_is_what_both_devices_see(scan):
    """Shadow rays against every triangle: pixels in the projector's shadow are not in the mask, all others are."""
    mesh = trimesh.load(scan / "ground_truth/mesh.ply", process=False)
    rng = np.random.default_rng(1)
    shadowed = 0
    for camera, projector, T_c, T_p, _, mask in _frames(scan):
        closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((25, 25))) > 0
        around = closed & ~mask  # mostly shadows
        uv = np.concatenate([rng.permutation(_pixels(part))[:45] for part in (mask, around)])
        d = camera_rays(camera, T_c, uv)
        t = nearest_on_mesh(mesh.vertices, mesh.faces, T_c[:3, 3], d)
        hit = np.isfinite(t)
        p = T_c[:3, 3] + t[hit, None] * d[hit]
        pixel = projector_pixels(projector, T_p, p)
        inside = ((pixel >= 0) & (pixel < (projector["w"], projector["h"]))).all(1)
        ray = p - T_p[:3, 3]
        distance = np.linalg.norm(ray, axis=1)
        reach = nearest_on_mesh(mesh.vertices, mesh.faces, T_p[:3, 3], ray / distance[:, None])
        expected = np.zeros(len(uv), dtype=bool)
        expected[hit] = inside & (reach > distance * (1 - 1e-6))
        column, row = (uv - 0.5).astype(int).T
        assert (mask[row, column] == expected).all()
        shadowed += (hit & ~expected).sum()
    assert shadowed > 20, "the sample must hold points in the shadow"


@pytest.fixture(scope="module")
def fine_scan(tmp_path_factory):
    root = tmp_path_factory.mktemp("clean") / "fine"
    synthesise(SynthConfig(clean=True, frames=2, resolution=200, seed=4), root)
    return root


def test_the_captured_image_shows_the_pattern_where_the_coordinates_say(fine_scan):
    """Warping the pattern through the coordinates gives the captured image up to shading; the rest is dark."""
    pattern = cv2.imread(str(fine_scan / "pattern.png"), cv2.IMREAD_UNCHANGED) / 255
    pattern = cv2.GaussianBlur(pattern, (0, 0), 2.2)  # about the footprint of a camera pixel
    for frame, (*_, coords, mask) in enumerate(_frames(fine_scan)):
        image, shown = (
            cv2.imread(str(fine_scan / f"{kind}/frame_{frame:05d}.png"), cv2.IMREAD_UNCHANGED) / 255
            for kind in ("images", "patterns")
        )
        at = np.where(mask[..., None], coords, 0).astype(np.float32)
        warped = cv2.remap(pattern, at[..., 0] - 0.5, at[..., 1] - 0.5, cv2.INTER_LINEAR)
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3))) > 0
        assert np.corrcoef(warped[inner], shown[inner])[0, 1] > 0.8
        outer = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) == 0
        assert image[outer].max() < 0.15 < 0.3 < image[inner].max()


def test_coordinates_exist_exactly_on_the_mask_and_poses_are_the_true_ones(scan):
    for *_, coords, mask in _frames(scan):
        assert np.array_equal(np.isfinite(coords).all(-1), mask)
        assert np.array_equal(np.isnan(coords).all(-1), ~mask)
    start = json.loads((scan / "transforms.json").read_text())
    truth = json.loads((scan / "ground_truth/transforms.json").read_text())
    assert start["frames"] == truth["frames"]
    assert "sl_pose_sigma" not in start
