"""The known length of a scan: what is written is read again, old scans keep their meaning, and faults are named."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sphere_scan import CAMERA, NAMES, RADIUS, edit, only_fault, poses, write_sphere

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.scan import (
    PickedPixel,
    Scale,
    ScaleBar,
    check_scan,
    measured_length,
    read_scan,
    write_transforms,
)
from tests.formulas import on_ball, rays

BAR = ScaleBar((PickedPixel(NAMES[1], (30.25, 20.0)), PickedPixel(NAMES[3], (40.5, 33.5))), 51.5)
BASELINE = Scale(True, "a ruler", baseline_of=NAMES[2])


def with_scale(scale):
    return lambda document: document.update(scale=scale)


def remove(*names):
    """The frames are removed from transforms.json, as a user would do it by hand."""

    def change(document):
        document["frames"] = [f for f in document["frames"] if Path(f["file_path"]).stem not in names]

    return change


@pytest.mark.parametrize("scale", [Scale(False), Scale(True, "given"), BASELINE, Scale(True, "", bar=BAR)])
def test_both_kinds_of_known_length_come_back_as_they_were_written(tmp_path, scale):
    root = write_sphere(tmp_path / "scan", scale=scale)
    assert check_scan(root) == []
    scan = read_scan(root)
    assert scan.scale == scale
    write_transforms(tmp_path / "refined.json", scan, scan.poses)
    before, after = (json.loads(p.read_text())["scale"] for p in (root / "transforms.json", tmp_path / "refined.json"))
    assert before == after
    (tmp_path / "refined.json").replace(root / "transforms.json")
    assert read_scan(root).scale == scale


def test_the_file_states_names_pixels_and_length(tmp_path):
    root = write_sphere(tmp_path / "bar", scale=Scale(True, "two marks", bar=BAR))
    assert json.loads((root / "transforms.json").read_text())["scale"] == {
        "known": True,
        "source": "two marks",
        "distance_between": [{"frame": NAMES[1], "pixel": [30.25, 20.0]}, {"frame": NAMES[3], "pixel": [40.5, 33.5]}],
        "length": 51.5,
    }
    root = write_sphere(tmp_path / "baseline", scale=BASELINE)
    stated = json.loads((root / "transforms.json").read_text())["scale"]
    assert stated == {"known": True, "source": "a ruler", "baseline_of": NAMES[2]}


def test_a_known_length_in_a_frame_that_is_not_written_is_refused(tmp_path):
    with pytest.raises(ValueError, match="the known length was measured in 'another', which was not written"):
        write_sphere(tmp_path / "scan", scale=Scale(True, baseline_of="another"))
    assert list(tmp_path.iterdir()) == []


def test_removing_an_earlier_frame_keeps_the_frame_with_the_known_baseline(tmp_path):
    root = write_sphere(tmp_path / "scan", scale=BASELINE)
    edit(root, remove(NAMES[0]))
    scan = read_scan(root)
    assert scan.scale.baseline_of == NAMES[2] and scan.index_of(NAMES[2]) == 1
    T_camera, T_projector = poses()[2]
    true = np.linalg.norm(T_camera[:3, 3] - T_projector[:3, 3])
    assert scan.poses.baseline[scan.index_of(NAMES[2])] == pytest.approx(true, rel=1e-12)


@pytest.mark.parametrize("scale, key", [(BASELINE, "baseline_of"), (Scale(True, bar=BAR), "distance_between")])
def test_removing_the_frame_with_the_known_length_is_a_fault(tmp_path, scale, key):
    root = write_sphere(tmp_path / "scan", scale=scale)
    edit(root, remove(scale.frames[0]))
    fault = only_fault(root)
    assert (fault.file, fault.frame, fault.field) == ("transforms.json", None, f"scale.{key}")
    assert fault.problem == f"names frame {scale.frames[0]!r}, which is not in the scan"
    assert fault.cause == "the frame was removed or renamed after the scan was made"
    assert fault.remedy == f"put the frame back, or remove {key}: then all lengths count alike"
    with pytest.raises(ScanError, match=f"scale.{key}: names frame"):
        read_scan(root)


@pytest.mark.parametrize(
    ("source", "frame"),
    [
        ("baseline of frame 1", NAMES[1]),
        ("measured baseline of frame 3 (ruler)", NAMES[3]),
        (f"baseline of frame 1 ({NAMES[3]})", NAMES[3]),  # the name counts, not the number
        ("given camera poses", None),
        ("", None),
    ],
)
def test_scans_with_a_sentence_only_keep_their_meaning(sphere, source, frame):
    edit(sphere, with_scale({"known": True, "source": source}))
    assert check_scan(sphere) == []
    assert read_scan(sphere).scale == Scale(True, source, baseline_of=frame)


@pytest.mark.parametrize("number", [0, 4])
def test_a_number_alone_is_refused_once_frames_were_removed(sphere, number):
    """Without frame 0, number 0 would be frame 1; whoever removes only baseline_of is left with such a sentence."""
    edit(sphere, with_scale({"known": True, "source": f"baseline of frame {number}"}))
    if number == 0:
        assert read_scan(sphere).scale.baseline_of == NAMES[0]
        edit(sphere, remove(NAMES[0]))
    fault = only_fault(sphere)
    assert (fault.file, fault.field) == ("transforms.json", "scale.source")
    assert f"names frame number {number}" in fault.problem and "removed" in fault.cause


def test_a_sentence_is_not_read_where_data_say_otherwise_or_nothing_is_known(sphere):
    edit(sphere, with_scale({"known": True, "source": "baseline of frame 1", "baseline_of": NAMES[0]}))
    assert read_scan(sphere).scale.baseline_of == NAMES[0]
    edit(sphere, with_scale({"known": False, "source": "baseline of frame 1"}))
    assert read_scan(sphere).scale == Scale(False, "baseline of frame 1")


END = {"frame": NAMES[0], "pixel": [30.0, 30.0]}


def at(*pixel):
    return {"frame": NAMES[1], "pixel": [*pixel]}


OTHER = at(30.0, 30.0)


def bar(other=OTHER, length=5.0):
    return {"distance_between": [END, other], "length": length}


@pytest.mark.parametrize(
    ("scale", "field", "problem"),
    [
        ({"baseline_of": 3}, "baseline_of", "is 3 instead of a text"),
        ({"known": False, "baseline_of": NAMES[0]}, "known", "is false, although a known length is given"),
        ({**bar(), "baseline_of": NAMES[0]}, "baseline_of", "is given together with distance_between"),
        ({"distance_between": [END, OTHER]}, "length", "is missing"),
        ({"length": 5.0}, "distance_between", "is missing"),
        (bar(length=0), "length", "is 0"),
        (bar(length="5 mm"), "length", "is '5 mm' instead of a number"),
        ({"distance_between": [END], "length": 5}, "distance_between", "is not a list of two pixels"),
        (bar(END), "distance_between", "is twice the same pixel"),
        (bar(7), "distance_between[1]", "is not an object { .. }"),
        (bar({"frame": NAMES[1]}), "distance_between[1].pixel", "is missing"),
        (bar(at(1, 2, 3)), "distance_between[1].pixel", "is [1, 2, 3] instead of a list of 2 numbers"),
        (
            bar(at(30, 61)),
            "distance_between",
            f"has the pixel (30, 61), outside the 72 x 60 pixels of frame {NAMES[1]!r}",
        ),
        ({"baseline_off": NAMES[0]}, "baseline_off", "is not a key of a scan"),
    ],
)
def test_a_faulty_known_length_is_named(sphere, scale, field, problem):
    edit(sphere, with_scale({"known": True, **scale}))
    fault = only_fault(sphere)
    assert (fault.file, fault.frame, fault.field) == ("transforms.json", None, f"scale.{field}")
    assert fault.problem == problem and fault.cause and fault.remedy


def test_a_bar_where_nothing_was_decoded_is_found_by_the_full_check(sphere):
    edit(sphere, with_scale({"known": True, **bar(at(1.5, 2.5))}))
    fault = only_fault(sphere)
    assert (fault.frame, fault.field) == (NAMES[1], "scale.distance_between")
    assert fault.problem == "has no decoded coordinates within 3 pixels of (1.5, 2.5)"
    scan = read_scan(sphere)  # which looks at no pixel
    assert scan.scale.bar is not None
    with pytest.raises(ScanError, match="no decoded coordinates within 3 pixels"):
        measured_length(scan, scan.scale.bar, scan.poses)


def on_sphere(index, pixel):
    """Where the ray of a pixel meets the sphere, by formula."""
    return on_ball(*rays(CAMERA, poses()[index][0], np.array(pixel)), RADIUS)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_sphere(tmp_path_factory.mktemp("scale") / "scan")


PIXEL = st.tuples(st.floats(-6, 6), st.floats(-6, 6))


@given(st.sampled_from(range(4)), PIXEL, st.sampled_from(range(4)), PIXEL)
def test_the_length_of_a_bar_is_that_between_the_points_on_the_surface(root, first, a, second, b):
    """Pixels well inside the sphere; within 3 pixels its depth varies by little, and evenly to either side."""
    scan, ends = read_scan(root), []
    for index, (dx, dy) in ((first, a), (second, b)):
        row, column = np.nonzero(scan.frames[index].read_mask())
        ends.append(PickedPixel(NAMES[index], (float(column.mean() + dx), float(row.mean() + dy))))
    true = np.linalg.norm(on_sphere(first, ends[0].pixel) - on_sphere(second, ends[1].pixel))
    bar = ScaleBar((ends[0], ends[1]), 1.0)
    assert measured_length(scan, bar, scan.poses) == pytest.approx(true, abs=1.0)  # of a sphere of radius 40


def test_the_length_grows_with_the_poses_and_does_not_depend_on_the_world(root):
    scan = read_scan(root)
    length = measured_length(scan, BAR, scan.poses)
    S = Similarity(2.5, np.diag([-1.0, -1.0, 1.0]), np.array([30.0, -500.0, 7.0]))
    assert measured_length(scan, BAR, scan.poses.mapped(S)) == pytest.approx(2.5 * length, rel=1e-9)
