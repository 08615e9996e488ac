"""Scans and other poses are written as they are and read again; nothing half-written stays."""

import json

import numpy as np
import pytest
from sphere_scan import CAMERA, NAMES, PROJECTOR, edit, only_fault, pattern_image, poses, write_sphere

from sl_nerfstudio.errors import ScanError, UserError
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.scan import FileError, PoseSigma, Scale, ScanWriter, check_scan, read_scan
from sl_nerfstudio.scan.write import read_devices, read_ground_truth, read_poses, write_transforms
from sl_nerfstudio.storage import LOCK


def files(root):
    return {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}


def settings(**changes):
    return {
        "units": "mm",
        "scale": Scale(True, "measured with a ruler"),
        "projector": PROJECTOR,
        "pattern": pattern_image(),
        "camera": CAMERA,
        **changes,
    }


def frame(index=0, **changes):
    T_world_camera, T_world_projector = poses()[index]
    return {
        "image": np.zeros((CAMERA.h, CAMERA.w), np.uint8),
        "coords": np.zeros((CAMERA.h, CAMERA.w, 2), np.float32),
        "T_world_camera": T_world_camera,
        "T_world_projector": T_world_projector,
        **changes,
    }


def test_everything_comes_back_as_it_was(tmp_path):
    random = np.random.default_rng(0)
    shape = (CAMERA.h, CAMERA.w)
    image = random.integers(0, 65536, (*shape, 3), dtype=np.uint16)
    pattern = random.integers(0, 65536, shape, dtype=np.uint16)
    coords = random.normal(size=(*shape, 2)).astype(np.float32)
    coords[:5] = np.nan
    mask = random.random(shape) < 0.5
    color = random.integers(0, 256, (*shape, 3), dtype=np.uint8)
    own = Device(72, 60, 140.0, 141.0, 33.0, 29.0, k1=0.1, k2=-0.01, p1=1e-3, p2=2e-3)
    projector = Device(128, 96, 260.0, 255.0, 66.0, 45.0, k1=-0.1, model="DOE")
    sigma = PoseSigma(1.0, 2.0, 3.0, 4.0)
    with ScanWriter(tmp_path / "ä" / "scan", **settings(projector=projector, extra={"comment": "é"})) as writer:
        writer.add_frame("eins", **frame(0, image=image, pattern=pattern, coords=coords, mask=mask, color=color))
        writer.add_frame("zwei", **frame(1, camera=own, extra={"exposure": 0.1}, pose_sigma=sigma))
        writer.add_file("ground_truth/mesh.ply", b"ply")
    scan = read_scan(tmp_path / "ä" / "scan")
    assert (scan.units, scan.scale, scan.projector) == ("mm", Scale(True, "measured with a ruler"), projector)
    assert np.array_equal(scan.read_pattern(), pattern_image().astype(np.float32) / np.float32(255))
    one, two = scan.frames
    assert (one.name, two.name, one.camera, two.camera) == ("eins", "zwei", CAMERA, own)
    assert np.array_equal(one.read_image(), image) and one.read_image().dtype == np.uint16
    assert np.array_equal(one.read_pattern(), pattern.astype(np.float32) / np.float32(65535))
    assert np.array_equal(one.read_coords(), coords, equal_nan=True)
    assert np.array_equal(one.read_mask(), mask)
    assert np.array_equal(one.read_color(), color) and two.read_color() is None
    assert (one.pose_sigma, two.pose_sigma) == (None, sigma)
    assert np.array_equal(one.T_world_camera, poses()[0][0])
    assert np.array_equal(two.T_world_projector, poses()[1][1])
    assert (two.pattern_path, two.mask_path) == (None, None)
    assert two.read_mask().all()
    document = json.loads((tmp_path / "ä/scan/transforms.json").read_text(encoding="utf-8"))
    assert document["comment"] == "é"
    assert document["frames"][1]["exposure"] == 0.1
    assert read_ground_truth(scan).mesh_path == tmp_path / "ä" / "scan" / "ground_truth" / "mesh.ply"


def test_the_same_scan_is_written_as_the_same_bytes(tmp_path):
    a, b = write_sphere(tmp_path / "a", frames=2), write_sphere(tmp_path / "b", frames=2)
    assert all((a / name).read_bytes() == (b / name).read_bytes() for name in files(a))


def test_captures_without_coordinates(tmp_path):
    with ScanWriter(tmp_path / "scan", **settings()) as writer:
        for index in range(2):
            writer.add_frame(f"f{index}", **frame(index, coords=None))
    assert all(fault.field == "sl_coords_path" for fault in check_scan(tmp_path / "scan"))
    with pytest.raises(ScanError, match="sl_coords_path: is missing"):
        read_scan(tmp_path / "scan")
    scan = read_scan(tmp_path / "scan", need_coords=False)
    one = scan.frames[0]
    assert one.coords_files is None and np.isnan(one.read_coords()).all() and not one.read_mask().any()


def test_true_poses_go_to_ground_truth(tmp_path):
    true = [(camera + 0.0, projector + 0.0) for camera, projector in poses()]
    for camera, _ in true:
        camera[0, 3] += 1
    with ScanWriter(tmp_path / "scan", **settings(extra={"sl_pose_sigma": 3})) as writer:
        for index in range(3):
            sigma = PoseSigma(1.0, 1.0, 1.0, 1.0)
            writer.add_frame(f"f{index}", **frame(index, pose_sigma=sigma, true_poses=true[index]))
    edit(tmp_path / "scan", lambda document: document.pop("sl_pose_sigma"))
    truth = read_ground_truth(read_scan(tmp_path / "scan"))
    assert truth.mesh_path is None and truth.poses is not None
    assert np.array_equal(truth.poses.T_world_camera, [camera for camera, _ in true[:3]])
    assert np.array_equal(truth.poses.T_world_projector, [projector for _, projector in true[:3]])
    assert "sl_pose_sigma" not in (tmp_path / "scan/ground_truth/transforms.json").read_text()


def test_nothing_stays_of_a_scan_that_failed(tmp_path):
    root = tmp_path / "new" / "scan"
    with pytest.raises(ZeroDivisionError), ScanWriter(root, **settings()) as writer:
        writer.add_frame("f0", **frame())
        assert files(root) == {LOCK, "pattern.png", "images/f0.png", "coords/f0.npz"}  # no transforms.json yet
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_scan_without_frames_is_not_written(tmp_path):
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
def test_faulty_settings(tmp_path, changes, message):
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
        ("f1", {"color": np.zeros((5, 5, 3), np.uint8)}, "color of f1 is (5, 5)"),
        ("f1", {"T_world_camera": np.diag([2.0, 2, 2, 1])}, "transform_matrix is scaled"),
        ("f1", {"T_world_projector": np.full((4, 4), np.nan)}, "projector_transform_matrix holds NaN or infinity"),
        ("f1", {"extra": {"quality": float("nan")}}, "not JSON compliant"),
    ],
)
def test_faulty_frames(tmp_path, name, changes, message):
    with pytest.raises(ValueError) as error, ScanWriter(tmp_path / "scan", **settings()) as writer:
        writer.add_frame("f0", **frame())
        writer.add_frame(name, **frame(1, **changes))
    assert message in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_a_frame_needs_intrinsics(tmp_path):
    needed = pytest.raises(ValueError, match="a frame needs its own camera")
    with needed, ScanWriter(tmp_path / "scan", **settings(camera=None)) as writer:
        writer.add_frame("f0", **frame())


def test_refined_poses_keep_everything_else(sphere):
    edit(sphere, lambda document: document.update(applied_scale=2.0, sl_pose_sigma=vars(PoseSigma(1.0, 1.0, 1.0, 1.0))))
    edit(sphere, lambda document: document["frames"][1].update(exposure=7))
    scan = read_scan(sphere)
    moved = scan.poses.mapped(Similarity(1.0, np.eye(3), np.array([1.0, 2.0, 3.0])))
    T_c, T_p = moved.T_world_camera, moved.T_world_projector
    target = sphere.parent / "refined" / "transforms.json"
    write_transforms(target, scan, moved, [{"sl_sigma": i} for i in range(4)], {"sl_note": "refined"})
    before, after = (json.loads((folder / "transforms.json").read_text()) for folder in (sphere, target.parent))
    assert after.pop("sl_note") == "refined"
    assert before.pop("sl_pose_sigma")["camera_translation"] == 1
    assert [record.pop("sl_sigma") for record in after["frames"]] == [0, 1, 2, 3]
    for old, new, camera, projector in zip(before["frames"], after["frames"], T_c, T_p, strict=True):
        assert new.pop("transform_matrix") == camera.tolist() != old.pop("transform_matrix")
        assert new.pop("projector_transform_matrix") == projector.tolist() != old.pop("projector_transform_matrix")
    assert before == after
    assert list(target.parent.iterdir()) == [target]
    found = read_poses(target, scan)
    assert np.array_equal(found.T_world_camera, T_c) and np.array_equal(found.T_world_projector, T_p)
    target.replace(sphere / "transforms.json")
    assert check_scan(sphere) == []
    assert np.array_equal(read_scan(sphere).poses.T_world_camera, T_c)


CHANGE = IntrinsicsChange.of((0.01, -0.002, 0.003, -0.008, 0.004, 0.001))


@pytest.mark.parametrize("own_cameras", [False, True])
def test_changed_intrinsics_are_written_and_read_beside_the_scans_own(sphere, own_cameras):
    def give_every_frame_its_own(document):
        common = {key: document.pop(key) for key in ("fl_x", "fl_y", "cx")}
        for index, record in enumerate(document["frames"]):
            record.update(common | {"fl_x": common["fl_x"] + index})

    if own_cameras:
        edit(sphere, give_every_frame_its_own)
    scan, stated = read_scan(sphere), (sphere / "transforms.json").read_bytes()
    changed = scan.with_intrinsics_change(CHANGE)
    for old, new, (f, x, y) in (
        (scan.frames[2].camera, changed.frames[2].camera, CHANGE.values[:3]),
        (scan.projector, changed.projector, CHANGE.values[3:]),
    ):
        assert (new.fl_x, new.fl_y) == pytest.approx((old.fl_x * (1 + f), old.fl_y * (1 + f)), rel=1e-15)
        assert (new.cx - old.cx, new.cy - old.cy) == pytest.approx((old.fl_x * x, old.fl_x * y), rel=1e-9)
        assert (new.w, new.h, new.k1, new.model) == (old.w, old.h, old.k1, old.model)
    with pytest.raises(ValueError, match="changed before"):
        changed.with_intrinsics_change(CHANGE)
    target = sphere.parent / "refined" / "transforms.json"
    write_transforms(target, changed, scan.poses)
    assert (sphere / "transforms.json").read_bytes() == stated
    found = read_devices(target, scan)
    assert [frame.camera for frame in found.frames] == [frame.camera for frame in changed.frames]
    assert found.projector == changed.projector
    target.replace(sphere / "transforms.json")  # and a scan with it is a scan
    assert check_scan(sphere) == []
    assert [frame.camera for frame in read_scan(sphere).frames] == [frame.camera for frame in changed.frames]


def test_a_file_of_poses_may_say_nothing_of_devices_but_nothing_false(sphere, tmp_path):
    scan = read_scan(sphere)
    document = json.loads((sphere / "transforms.json").read_text())
    frames = [{"file_path": record["file_path"]} for record in document["frames"]]
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({"frames": frames}))
    found = read_devices(path, scan)
    assert found.projector == scan.projector
    assert [frame.camera for frame in found.frames] == [frame.camera for frame in scan.frames]
    path.write_text(json.dumps({**document, "fl_x": -1.0}))
    with pytest.raises(ScanError, match="fl_x: is -1") as error:
        read_devices(path, scan)
    assert "poses.json" in str(error.value)


def test_wrong_numbers_of_poses_are_refused(sphere):
    scan = read_scan(sphere)
    with pytest.raises(ValueError, match="4 frames, but poses of 3 and 4 sets of fields"):
        write_transforms(sphere / "x.json", scan, scan.poses[:3])
    with pytest.raises(ValueError, match="4 frames, but poses of 4 and 1 sets of fields"):
        write_transforms(sphere / "x.json", scan, scan.poses, [{}])
    scaled = DevicePoses(scan.poses.T_world_camera @ np.diag([2.0, 2, 2, 1]), scan.poses.T_world_projector)
    with pytest.raises(ValueError, match="transform_matrix is scaled"):
        write_transforms(sphere / "x.json", scan, scaled)
    edit(sphere, lambda document: document["frames"].reverse())
    with pytest.raises(ScanError, match="lists other frames than before"):
        write_transforms(sphere / "x.json", scan, scan.poses)
    assert not (sphere / "x.json").exists()


def test_poses_of_another_file_are_matched_by_name(sphere, tmp_path):
    scan = read_scan(sphere)
    document = json.loads((sphere / "transforms.json").read_text())
    document["frames"].reverse()
    document["frames"].append({"file_path": "images/other.png"})
    document["frames"][-1] |= {key: np.eye(4).tolist() for key in ("transform_matrix", "projector_transform_matrix")}
    path = tmp_path / "other.json"
    path.write_text(json.dumps(document))
    assert np.array_equal(read_poses(path, scan).stacked(), scan.poses.stacked())
    for key in ("transform_matrix", "projector_transform_matrix"):
        frames = [{k: v for k, v in record.items() if k != key} for record in document["frames"]]
        path.write_text(json.dumps({**document, "frames": frames}))
        with pytest.raises(FileError, match=rf"other.json: has no {key}\n(.|\n)*give one with both poses per frame"):
            read_poses(path, scan)
    del document["frames"][1]
    document["frames"][0]["transform_matrix"][0][0] = 5
    del document["frames"][2]["transform_matrix"]
    path.write_text(json.dumps(document))
    with pytest.raises(ScanError) as error:
        read_poses(path, scan)
    assert [(f.file, f.frame, f.field) for f in error.value.faults] == [
        ("other.json", NAMES[0], "transform_matrix"),
        ("other.json", NAMES[2], "frames"),
        ("other.json", NAMES[3], "transform_matrix"),
    ]
    path.write_text("[]")
    with pytest.raises(ScanError, match="holds a list instead of an object"):
        read_poses(path, scan)
    path.write_text('{"frames": 3}')
    with pytest.raises(ScanError, match="is missing or is not a list of objects"):
        read_poses(path, scan)


def test_faulty_truth_is_a_fault_of_the_scan(sphere):
    (sphere / "ground_truth").mkdir()
    document = json.loads((sphere / "transforms.json").read_text())
    document["frames"][2]["transform_matrix"][3][3] = 0
    (sphere / "ground_truth" / "transforms.json").write_text(json.dumps(document))
    fault = only_fault(sphere)
    assert (fault.file, fault.frame, fault.field) == ("ground_truth/transforms.json", NAMES[2], "transform_matrix")
