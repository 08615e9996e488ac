"""Real captures pass; so they do with honest errors in their poses; and mixed-up ones are named."""

import os
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path

import pytest
from sphere_scan import edit
from test_check_conventions import disturbed, undo

from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.check import check_folder
from sl_nerfstudio.scan.check_conventions import Interpretation, convention_problems

DATA = Path(os.environ.get("SL_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))


def folder(name):
    if not (DATA / name / "transforms.json").exists():
        pytest.skip(f"real captures not found: {DATA / name} (set SL_REAL_DATA to their folder)")
    return DATA / name


@pytest.fixture(scope="module", params=[pytest.param("elephant", marks=pytest.mark.slow), "house"])
def examined(request):
    return check_folder(folder(request.param))


@pytest.mark.slow
def test_real_captures_are_clean(examined):
    assert examined.faults == ()
    assert examined.fit is not None and examined.scan is not None
    assert examined.fit.typical_px < 0.3
    assert examined.fit.typical_spread < 0.05


def test_real_captures_with_rough_poses_are_clean(examined):
    assert examined.scan is not None
    frames = [content.correspondences for content in examined.contents if content.correspondences is not None]
    size = 30.0 if examined.scan.units == "mm" else 0.3
    for seed in range(3):
        rough = disturbed(frames, 10, size, 0.5, seed)
        assert list(convention_problems(rough, examined.scan.projector, None)) == []


@pytest.mark.parametrize("how", ["inverted", "OpenCV axes", "inverted, OpenCV axes"])
@pytest.mark.slow
def test_mixed_up_real_captures_are_named(examined, how):
    assert examined.scan is not None
    frames = [content.correspondences for content in examined.contents if content.correspondences is not None]
    interpretation = Interpretation(camera=how, projector=how)  # type: ignore[arg-type]
    projector = examined.scan.projector
    for relative in (0.0, 0.5):
        rough = disturbed(frames, 5, 10 if examined.scan.units == "mm" else 0.1, relative, 1)
        mixed = [replace(undo(interpretation, frame)) for frame in rough]
        found = list(convention_problems(mixed, projector, None))
        assert [(frame, key) for frame, key, _ in found] == [(None, "transform_matrix")]
        assert found[0][2].cause.startswith("camera and projector matrices ")


@pytest.mark.slow
def test_the_memory_of_the_check_does_not_grow_with_the_number_of_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "sl_nerfstudio.parallel._ours", 1
    )  # one thread: else the peaks of several threads meet by chance
    scan = read_scan(folder("elephant"))
    one_frame = scan.frames[0].camera.h * scan.frames[0].camera.w * (8 + 3)  # bytes: coordinates and image
    peaks = []
    for count in (3, 12):
        root = Path(shutil.copytree(scan.root, tmp_path / str(count)))
        edit(root, lambda document, count=count: document.update(frames=document["frames"][:count]))
        tracemalloc.start()
        try:
            assert check_folder(root).faults == ()
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    assert peaks[1] < peaks[0] + one_frame / 2
    assert peaks[1] < 12 * one_frame
