"""Large, deep and foreign transforms.json: one message for each kind of fault, and no time lost."""

import json
from pathlib import Path
from typing import Any

import pytest
from sphere_scan import NAMES, edit, only_fault

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.scan import check_scan, read_scan
from sl_nerfstudio.scan.document import MAX_DEPTH, FileError, read_document


def ordinary(document: dict[str, Any]) -> None:
    """A data set of nerfstudio."""
    for key in ("projector", "sl_format", "scale", "units"):
        del document[key]
    keys = ("file_path", "transform_matrix")
    document["frames"] = [{key: frame[key] for key in keys} for frame in document["frames"]] * 150


def test_an_ordinary_data_set_gets_one_sentence(sphere: Path) -> None:
    edit(sphere, ordinary)
    fault = only_fault(sphere)
    assert "there is no projector in this data set" in fault.problem and "sl-process" in fault.remedy
    with pytest.raises(ScanError, match="no projector"):
        read_scan(sphere)


def test_faults_of_one_kind_are_one_entry(sphere: Path) -> None:
    edit(sphere, lambda document: [frame.pop("transform_matrix") for frame in document["frames"]])
    (sphere / "masks" / f"{NAMES[0]}.png").unlink()
    faults = check_scan(sphere)
    assert [fault.frame for fault in faults] == [*NAMES, NAMES[0]]
    lines = str(ScanError(faults, "scan")).splitlines()
    assert lines[0] == "5 faults in scan"
    assert lines[1] == f"transforms.json: frame {NAMES[0]}: transform_matrix: is missing"
    assert lines[4] == f"    and 3 more frames: {', '.join(NAMES[1:])}"
    assert lines[5] == f"masks/{NAMES[0]}.png: is missing" and len(lines) == 8


def test_faults_that_differ_in_numbers_are_of_one_kind(sphere: Path) -> None:
    edit(sphere, lambda document: document.update({key: -float(k) for k, key in enumerate(("fl_x", "fl_y"), 1)}))
    edit(sphere, lambda document: [frame.update(transform_matrix=k) for k, frame in enumerate(document["frames"])])
    text = str(ScanError(check_scan(sphere), "scan"))
    assert text.count("instead of a list of four rows") == 1 and "and 3 more frames" in text


def many_frames(document: dict[str, Any]) -> None:
    frame = document["frames"][0]
    document["frames"] = [
        {k: v.replace(NAMES[0], f"frame_{n:05d}") if isinstance(v, str) else v for k, v in frame.items()}
        for n in range(500)
    ]


@pytest.mark.parametrize(
    ("change", "count"),
    [
        (many_frames, 500 * 4 - 4 * 4 + 1),
        (lambda document: document.update(frames=document["frames"][:1] * 300), 2),
        (lambda document: document.update({f"frames{k}": k for k in range(20_000)}), 0),
    ],
)
def test_many_frames_and_keys_make_few_lines(sphere: Path, change: Any, count: int) -> None:
    edit(sphere, change)
    faults = check_scan(sphere)
    assert len(faults) == count
    assert not faults or len(str(ScanError(faults)).splitlines()) < 40


def test_keys_given_twice_are_counted_once_through(sphere: Path) -> None:
    path = sphere / "transforms.json"
    twice = ", ".join(f'"key_{k % 10_000}": {k}' for k in range(20_000))
    path.write_text("{" + twice + "," + path.read_text().strip()[1:])
    assert len(check_scan(sphere)) == 10_000


@pytest.mark.parametrize(("depth", "right"), [(MAX_DEPTH, True), (MAX_DEPTH + 1, False), (900, False)])
def test_depth_is_limited(tmp_path: Path, depth: int, right: bool) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a": ' * depth + "1" + "}" * depth)
    if right:
        assert json.dumps(read_document(path)).count("{") == depth
        return
    with pytest.raises(FileError, match="nested too deeply"):
        read_document(path)


@pytest.mark.parametrize("x", [1e5, 1e8, 1e30, 1e308])
@pytest.mark.parametrize("key", ["transform_matrix", "projector_transform_matrix"])
def test_a_device_far_from_all_others(sphere: Path, key: str, x: float) -> None:
    """The object has a radius of 40, the devices are 250 away."""

    def move(document: dict[str, Any]) -> None:
        document["frames"][1][key][0][3] += x

    edit(sphere, move)
    fault = only_fault(sphere)
    assert (fault.frame, fault.field) == (NAMES[1], key)
    assert "puts the device" in fault.problem
