"""Pictures without the pattern (`sl_color_path`): read, written, and what can be wrong with them."""

from pathlib import Path

import numpy as np
import pytest
from sphere_scan import CAMERA, NAMES, PROJECTOR, correspondences, edit, look_up, only_fault, pattern_image, poses

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.scan import Scale, ScanWriter, check_scan, read_scan, write_transforms
from sl_nerfstudio.scan.images import encode_png

NAME = NAMES[1]


def gradient() -> np.ndarray:
    y, x = np.mgrid[: CAMERA.h, : CAMERA.w]
    return np.stack([x, y, x + y], -1).astype(np.uint8)


def put(root: Path, picture: np.ndarray, path: str = "color/one.png") -> None:
    (root / path).parent.mkdir(exist_ok=True)
    (root / path).write_bytes(encode_png(picture))
    edit(root, lambda document: document["frames"][1].update(sl_color_path=path))


def test_a_picture_is_read_and_other_frames_have_none(sphere):
    put(sphere, gradient())
    assert check_scan(sphere) == []
    scan = read_scan(sphere)
    assert [frame.color_path is None for frame in scan.frames] == [True, False, True, True]
    assert np.array_equal(scan.frames[1].read_color(), gradient()) and scan.frames[0].read_color() is None


def test_the_writer_writes_it_and_refined_poses_keep_it(tmp_path):
    settings = {"units": "mm", "scale": Scale(False), "projector": PROJECTOR, "pattern": pattern_image()}
    with ScanWriter(tmp_path / "scan", **settings, camera=CAMERA) as writer:
        for name, (T_camera, T_projector) in zip(NAMES, poses(), strict=True):
            coords = correspondences(T_camera, T_projector)
            seen = look_up(pattern_image(), coords)
            writer.add_frame(
                name,
                image=seen,
                coords=coords,
                color=gradient(),
                T_world_camera=T_camera,
                T_world_projector=T_projector,
            )
    scan = read_scan(tmp_path / "scan")
    assert np.array_equal(scan.frames[2].read_color(), gradient())
    write_transforms(tmp_path / "refined.json", scan, scan.poses)
    assert (tmp_path / "refined.json").read_text().count('"sl_color_path": "color/frame_') == 4
    with pytest.raises(ValueError, match="color of"), ScanWriter(tmp_path / "b", **settings, camera=CAMERA) as writer:
        coords = correspondences(*poses()[0])
        image = look_up(pattern_image(), coords)
        writer.add_frame(
            "a", image=image, coords=coords, color=gradient()[1:], T_world_camera=np.eye(4), T_world_projector=np.eye(4)
        )


@pytest.mark.parametrize(
    ("picture", "problem"),
    [
        (gradient()[:, 2:], "is 70 x 60 pixels, but the camera has 72 x 60"),
        (np.full((CAMERA.h, CAMERA.w, 3), 9, np.uint8), "has the same value everywhere"),
    ],
)
def test_a_picture_that_cannot_be_that_of_the_frame(sphere, picture, problem):
    put(sphere, picture)
    fault = only_fault(sphere)
    assert problem in fault.problem and fault.file == "color/one.png" and fault.frame == NAME


def test_a_picture_with_the_pattern_is_refused(sphere):
    edit(sphere, lambda document: document["frames"][1].update(sl_color_path=f"images/{NAME}.png"))
    fault = only_fault(sphere)
    assert "shows the pattern (correlation 0.9" in fault.problem or "shows the pattern (correlation 1" in fault.problem
    assert "taken without the pattern" in fault.remedy


def test_missing_and_misspelt_pictures(sphere):
    edit(sphere, lambda document: document["frames"][1].update(sl_color_path="color/none.png"))
    with pytest.raises(ScanError, match=r"color/none.png: .*is missing"):
        read_scan(sphere)
    edit(
        sphere, lambda document: document["frames"][1].update(sl_color_paht=document["frames"][1].pop("sl_color_path"))
    )
    assert "did you mean 'sl_color_path'?" in only_fault(sphere).remedy
