"""Whole synthetic scans as files: reproducible, in any unit and any world, and faultless."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan import Scale, read_ground_truth, read_scan
from sl_nerfstudio.scan.check import check_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

_CONFIG = SynthConfig(frames=4, resolution=72, seed=3)


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Makes each scan once."""

    @cache
    def scan(**options):
        root = tmp_path_factory.mktemp("scan") / "scan"
        synthesise(replace(_CONFIG, **options), root)
        return root

    return scan


def _files(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def _document(root, truth=False):
    return json.loads((root / ("ground_truth/transforms.json" if truth else "transforms.json")).read_text())


def _poses(document, key):
    return np.array([frame[key] for frame in document["frames"]])


def test_a_scan_is_faultless_and_complete(make):
    root = make()
    assert check_scan(root) == []
    scan = read_scan(root)
    truth = read_ground_truth(scan)
    assert len(scan.frames) == 4 and scan.units == truth.units == "mm"
    assert scan.scale == Scale(True, "baseline of frame 0", baseline_of="frame_00000")
    assert truth.mesh_path == root / "ground_truth/mesh.ply"
    assert (root / "pattern.json").is_file()
    assert truth.poses is not None
    assert np.abs(truth.poses.T_world_camera - scan.poses.T_world_camera).max() > 0.1


def test_same_flags_same_bytes(make, tmp_path):
    synthesise(_CONFIG, tmp_path / "again")
    assert _files(make()) == _files(tmp_path / "again")


def test_another_seed_is_another_scan(make):
    one, other = _files(make()), _files(make(seed=4))
    assert one.keys() == other.keys()
    same = {name for name in one if one[name] == other[name]}
    assert same == {"pattern.png", "pattern.json", "ground_truth/mesh.ply"}


@pytest.mark.parametrize(("units", "millimetre"), [("cm", 0.1), ("m", 1e-3), ("um", 1e3), ("arbitrary", 1.0)])
def test_units_scale_lengths_and_nothing_else(make, units, millimetre):
    one, other = make(), make(units=units)
    for name, content in _files(one).items():
        if not name.endswith(("transforms.json", "mesh.ply")):
            assert (other / name).read_bytes() == content, name
    for truth in (False, True):
        a, b = _document(one, truth), _document(other, truth)
        assert (a["units"], b["units"]) == ("mm", units)
        for key in ("transform_matrix", "projector_transform_matrix"):
            expected = _poses(a, key)
            expected[:, :3, 3] *= millimetre
            np.testing.assert_allclose(_poses(b, key), expected, rtol=1e-12)
    sigma, scaled = _document(one)["sl_pose_sigma"], _document(other)["sl_pose_sigma"]
    for key, value in sigma.items():
        assert scaled[key] == pytest.approx(value * (millimetre if "translation" in key else 1))
    meshes = [trimesh.load(root / "ground_truth/mesh.ply", process=False) for root in (one, other)]
    np.testing.assert_allclose(meshes[1].vertices, meshes[0].vertices * millimetre, rtol=1e-12, atol=1e-15)


def test_a_turned_world_is_the_same_scan_elsewhere(make):
    one, other = make(), make(world_turn=8)
    a, b = _document(one), _document(other)
    moves = _poses(b, "transform_matrix") @ np.linalg.inv(_poses(a, "transform_matrix"))
    T = moves[0]
    np.testing.assert_allclose(moves, np.tile(T, (4, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(
        T @ _poses(a, "projector_transform_matrix"), _poses(b, "projector_transform_matrix"), atol=1e-9
    )
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2)) > 10 and np.linalg.norm(T[:3, 3]) > 20
    truth = _poses(_document(other, True), "transform_matrix") @ np.linalg.inv(
        _poses(_document(one, True), "transform_matrix")
    )
    np.testing.assert_allclose(truth, moves, atol=1e-9)
    meshes = [trimesh.load(root / "ground_truth/mesh.ply", process=False).vertices for root in (one, other)]
    np.testing.assert_allclose(meshes[1], meshes[0] @ T[:3, :3].T + T[:3, 3], atol=1e-9)
    assert (one / "coords/frame_00002.npz").read_bytes() == (other / "coords/frame_00002.npz").read_bytes()


def test_each_kind_of_noise_leaves_the_rest_alone(make):
    """Coordinates, images and poses draw from streams of their own."""
    base = _files(make())
    for options, changed in (
        ({"noise": 0.7}, ("coords/",)),
        ({"sensor_noise": 0.03}, ("images/", "patterns/")),
        ({"pose_error": (2.0, 1.0)}, ("transforms.json",)),
    ):
        other = _files(make(**options))
        different = {name for name in base if base[name] != other[name]}
        assert different and all(name.startswith(changed) for name in different), (options, different)


def test_the_first_baseline_is_exact_only_where_the_scale_is_known(make):
    for options in ({}, {"scale_known": False}):
        start = read_scan(make(**options))
        ratio = np.log(start.poses.baseline / read_ground_truth(start).poses.baseline)
        assert (abs(ratio[0]) < 1e-9) == start.scale.known == (not options)


def test_images_only_is_what_a_camera_brings_home(make):
    root = make(images_only=True)
    outside = {name for name in _files(root) if not name.startswith("ground_truth/")}
    assert outside == {"pattern.png", "pattern.json", "intrinsics.json"} | {
        f"images/frame_{n:05d}.png" for n in range(4)
    }
    apart = root / "ground_truth"
    assert check_scan(apart) == []
    assert not (apart / "ground_truth").exists() and (apart / "mesh.ply").is_file()
    for n in range(4):
        name = f"images/frame_{n:05d}.png"
        assert (root / name).read_bytes() == (apart / name).read_bytes() == (make() / name).read_bytes()
    true_document, document = _document(make(), True), json.loads((root / "intrinsics.json").read_text())
    assert _document(apart)["frames"][2]["transform_matrix"] == true_document["frames"][2]["transform_matrix"]
    assert all(true_document[key] == value for key, value in document.items())
    clean, decoded = (np.load(r / "coords/frame_00001.npz")["coords"] for r in (apart, make()))
    error = (decoded - clean)[np.isfinite(decoded)]
    assert np.median(np.abs(error)) == pytest.approx(0.3 * 0.6745, rel=0.1)


def test_any_image_is_a_pattern(make, tmp_path):
    from sl_nerfstudio.scan.images import encode_png

    dots = (np.random.default_rng(0).random((90, 120)) < 0.1).astype(np.uint8) * np.uint8(255)
    path = tmp_path / "dots.png"
    path.write_bytes(encode_png(dots))
    root = make(pattern=path, frames=2)
    assert check_scan(root) == []
    assert not (root / "pattern.json").exists()
    assert (read_scan(root).projector.w, read_scan(root).projector.h) == (120, 90)
    assert np.array_equal(np.rint(255 * read_scan(root).read_pattern()), dots)


def test_a_mesh_file_in_metres(tmp_path):
    trimesh.creation.icosphere(subdivisions=3, radius=0.4).export(tmp_path / "ball.ply")
    config = replace(_CONFIG, scene=str(tmp_path / "ball.ply"), units="m", frames=2, clean=True)
    synthesise(config, tmp_path / "scan")
    mesh = trimesh.load(tmp_path / "scan/ground_truth/mesh.ply", process=False)
    np.testing.assert_allclose(mesh.extents, 0.8, atol=1e-6)
    assert 4 * 0.8 < np.linalg.norm(read_scan(tmp_path / "scan").poses.T_world_camera[0, :3, 3]) < 5 * 0.8
    assert check_scan(tmp_path / "scan") == []


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames": 1}, "--frames 1: a scan needs at least 2 frames"),
        ({"missing": 15.0}, "--missing 15.0: it is a fraction: 15 % is 0.15"),
        ({"wrong": -0.1}, "--wrong -0.1"),
        ({"missing": 0.9, "wrong": 0.2}, "--missing and --wrong"),
        ({"noise": -1.0}, "--noise -1.0"),
        ({"noise": float("nan")}, "--noise nan"),
        ({"camera_distortion": (0.0, float("inf"), 0.0, 0.0)}, "--camera-distortion"),
        ({"pose_error": (-1.0, 3.0)}, "--pose-error"),
        ({"autocalibration_error": (0.2, 0.4, 2.0)}, "2 % is 0.02"),
        ({"supersampling": 0}, "--supersampling 0"),
        ({"scene": "teapot"}, "--scene teapot: neither a built-in scene"),
    ],
)
def test_flags_that_make_no_sense_write_nothing(tmp_path, options, message):
    with pytest.raises(UserError, match=message.replace("(", r"\(")):
        synthesise(replace(_CONFIG, **options), tmp_path / "scan")
    assert not (tmp_path / "scan").exists()
