"""Other poses for a scan: refined ones are written, true ones are read, and frames are matched by name."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sphere_scan import NAMES, edit

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.scan import FileError, check_scan, read_poses, read_scan
from sl_nerfstudio.scan.write import read_devices, write_transforms


def moved(T: np.ndarray) -> np.ndarray:
    out = T.copy()
    out[:, :3, 3] += [1.0, 2.0, 3.0]
    return out


def test_refined_poses_keep_everything_else(sphere: Path) -> None:
    edit(sphere, lambda document: document.update(applied_scale=2.0, sl_pose_sigma={"camera_translation": 1.0}))
    edit(sphere, lambda document: document["frames"][1].update(exposure=7))
    edit(sphere, lambda document: document["sl_pose_sigma"].update(
        camera_rotation_deg=1.0, relative_translation=1.0, relative_rotation_deg=1.0))  # fmt: skip
    scan = read_scan(sphere)
    T_c, T_p = moved(scan.poses.T_world_camera), moved(scan.poses.T_world_projector)
    target = sphere.parent / "refined" / "transforms.json"
    write_transforms(target, scan, DevicePoses(T_c, T_p), [{"sl_sigma": i} for i in range(4)], {"sl_note": "refined"})
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
def test_changed_intrinsics_are_written_and_read_beside_the_scans_own(sphere: Path, own_cameras: bool) -> None:
    def give_every_frame_its_own(document: dict[str, Any]) -> None:
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


def test_a_file_of_poses_may_say_nothing_of_devices_but_nothing_false(sphere: Path, tmp_path: Path) -> None:
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


def test_wrong_numbers_of_poses_are_refused(sphere: Path) -> None:
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


def test_poses_of_another_file_are_matched_by_name(sphere: Path, tmp_path: Path) -> None:
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


def test_faulty_truth_is_a_fault_of_the_scan(sphere: Path) -> None:
    (sphere / "ground_truth").mkdir()
    document = json.loads((sphere / "transforms.json").read_text())
    document["frames"][2]["transform_matrix"][3][3] = 0
    (sphere / "ground_truth" / "transforms.json").write_text(json.dumps(document))
    faults = check_scan(sphere)
    assert [(f.file, f.frame, f.field) for f in faults] == [
        ("ground_truth/transforms.json", NAMES[2], "transform_matrix")
    ]
