"""Writing scans: what is written comes back, and nothing half-written stays."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sphere_scan import CAMERA, PROJECTOR, edit, pattern_image, poses, write_sphere

from sl_nerfstudio.errors import ScanError, UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan import PoseSigma, Scale, ScanWriter, check_scan, read_ground_truth, read_scan
from sl_nerfstudio.storage import LOCK


def files(root: Path) -> set[str]:
    return {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}


def settings(**changes: Any) -> dict[str, Any]:
    return {
        "units": "mm",
        "scale": Scale(True, "measured with a ruler"),
        "projector": PROJECTOR,
        "pattern": pattern_image(),
        "camera": CAMERA,
        **changes,
    }


def frame(index: int = 0, **changes: Any) -> dict[str, Any]:
    T_world_camera, T_world_projector = poses()[index]
    return {
        "image": np.zeros((CAMERA.h, CAMERA.w), np.uint8),
        "coords": np.zeros((CAMERA.h, CAMERA.w, 2), np.float32),
        "T_world_camera": T_world_camera,
        "T_world_projector": T_world_projector,
        **changes,
    }


def test_everything_comes_back_as_it_was(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    shape = (CAMERA.h, CAMERA.w)
    image = random.integers(0, 65536, (*shape, 3), dtype=np.uint16)
    pattern = random.integers(0, 65536, shape, dtype=np.uint16)
    coords = random.normal(size=(*shape, 2)).astype(np.float32)
    coords[:5] = np.nan
    mask = random.random(shape) < 0.5
    own = Device(72, 60, 140.0, 141.0, 33.0, 29.0, k1=0.1, k2=-0.01, p1=1e-3, p2=2e-3)
    projector = Device(128, 96, 260.0, 255.0, 66.0, 45.0, k1=-0.1, model="DOE")
    sigma = PoseSigma(1.0, 2.0, 3.0, 4.0)
    with ScanWriter(tmp_path / "ä" / "scan", **settings(projector=projector, extra={"comment": "é"})) as writer:
        writer.add_frame("eins", **frame(0, image=image, pattern=pattern, coords=coords, mask=mask, pose_sigma=sigma))
        writer.add_frame("zwei", **frame(1, camera=own, extra={"exposure": 0.1}))
        writer.add_file("ground_truth/mesh.ply", b"ply")
    scan = read_scan(tmp_path / "ä" / "scan")
    assert (scan.units, scan.scale, scan.projector) == ("mm", Scale(True, "measured with a ruler"), projector)
    assert np.array_equal(scan.read_pattern(), pattern_image().astype(np.float32) / np.float32(255))
    one, two = scan.frames
    assert (one.name, two.name, one.camera, two.camera) == ("eins", "zwei", CAMERA, own)
    assert np.array_equal(one.read_image(), image)
    assert one.read_image().dtype == np.uint16
    assert np.array_equal(one.read_pattern(), pattern.astype(np.float32) / np.float32(65535))
    assert np.array_equal(one.read_coords(), coords, equal_nan=True)
    assert np.array_equal(one.read_mask(), mask)
    assert (one.pose_sigma, two.pose_sigma) == (sigma, None)
    assert np.array_equal(one.T_world_camera, poses()[0][0])
    assert np.array_equal(two.T_world_projector, poses()[1][1])
    assert (two.pattern_path, two.mask_path) == (None, None)
    assert two.read_mask().all()
    document = json.loads((tmp_path / "ä/scan/transforms.json").read_text(encoding="utf-8"))
    assert document["comment"] == "é"
    assert document["frames"][1]["exposure"] == 0.1
    assert read_ground_truth(scan).mesh_path == tmp_path / "ä" / "scan" / "ground_truth" / "mesh.ply"


def test_the_same_scan_is_written_as_the_same_bytes(tmp_path: Path) -> None:
    a, b = write_sphere(tmp_path / "a", frames=2), write_sphere(tmp_path / "b", frames=2)
    assert all((a / name).read_bytes() == (b / name).read_bytes() for name in files(a))


def test_captures_without_coordinates(tmp_path: Path) -> None:
    with ScanWriter(tmp_path / "scan", **settings()) as writer:
        for index in range(2):
            writer.add_frame(f"f{index}", **frame(index, coords=None))
    assert all(fault.field == "sl_coords_path" for fault in check_scan(tmp_path / "scan"))
    with pytest.raises(ScanError, match="sl_coords_path: is missing"):
        read_scan(tmp_path / "scan")
    scan = read_scan(tmp_path / "scan", need_coords=False)
    assert scan.frames[0].coords_path is None
    assert np.isnan(scan.frames[0].read_coords()).all()
    assert not scan.frames[0].read_mask().any()


def test_true_poses_go_to_ground_truth(tmp_path: Path) -> None:
    true = [(camera + 0.0, projector + 0.0) for camera, projector in poses()]
    for camera, _ in true:
        camera[0, 3] += 1
    with ScanWriter(tmp_path / "scan", **settings(extra={"sl_pose_sigma": 3})) as writer:
        for index in range(3):
            sigma = PoseSigma(1.0, 1.0, 1.0, 1.0)
            writer.add_frame(f"f{index}", **frame(index, pose_sigma=sigma, true_poses=true[index]))
    edit(tmp_path / "scan", lambda document: document.pop("sl_pose_sigma"))
    truth = read_ground_truth(read_scan(tmp_path / "scan"))
    assert truth.mesh_path is None
    assert truth.poses is not None
    assert np.array_equal(truth.poses.T_world_camera, [camera for camera, _ in true[:3]])
    assert np.array_equal(truth.poses.T_world_projector, [projector for _, projector in true[:3]])
    assert "sl_pose_sigma" not in (tmp_path / "scan/ground_truth/transforms.json").read_text()


def test_nothing_stays_of_a_scan_that_failed(tmp_path: Path) -> None:
    root = tmp_path / "new" / "scan"
    with pytest.raises(ZeroDivisionError), ScanWriter(root, **settings()) as writer:
        writer.add_frame("f0", **frame())
        assert files(root) == {LOCK, "pattern.png", "images/f0.png", "coords/f0.npz"}  # no transforms.json yet
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_scan_without_frames_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no frame was written"), ScanWriter(tmp_path / "scan", **settings()):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"units": "inch"}, "units must be one of m, cm, mm, um, arbitrary, got 'inch'"),
        ({"pattern": np.zeros((3, 3), np.uint8)}, "the pattern is (3, 3), the projector (96, 128)"),
        ({"camera": Device(72, 60, 1.0, 1.0, 1.0, 1.0, model="DOE")}, "a camera cannot be a DOE"),
    ],
)
def test_faulty_settings(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as error:
        ScanWriter(tmp_path / "scan", **settings(**changes))
    assert str(error.value) == message
    assert not (tmp_path / "scan").exists()


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("f0", {}, "was given before"),
        ("a/b", {}, "is not a file name"),
        ("..", {}, "is not a file name"),
        ("", {}, "is not a file name"),
        ("f1", {"image": np.zeros((5, 5), np.uint8)}, "image of f1 is (5, 5), the camera (60, 72)"),
        ("f1", {"coords": np.zeros((5, 5, 2), np.float32)}, "coords of f1 is (5, 5)"),
        ("f1", {"T_world_camera": np.diag([2.0, 2, 2, 1])}, "transform_matrix is scaled"),
        ("f1", {"T_world_projector": np.full((4, 4), np.nan)}, "projector_transform_matrix holds NaN or infinity"),
        ("f1", {"extra": {"quality": float("nan")}}, "not JSON compliant"),
    ],
)
def test_faulty_frames(tmp_path: Path, name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as error, ScanWriter(tmp_path / "scan", **settings()) as writer:
        writer.add_frame("f0", **frame())
        writer.add_frame(name, **frame(1, **changes))
    assert message in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_files_may_not_leave_the_folder(tmp_path: Path) -> None:
    for path in ("../x", "/tmp/x", "a/../../x"):
        with (
            pytest.raises(ValueError, match="leaves the scan folder"),
            ScanWriter(tmp_path / "s", **settings()) as writer,
        ):
            writer.add_file(path, b"")
    assert list(tmp_path.iterdir()) == []


def test_a_frame_needs_intrinsics(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="a frame needs its own camera"):  # noqa: SIM117
        with ScanWriter(tmp_path / "scan", **settings(camera=None)) as writer:
            writer.add_frame("f0", **frame())
