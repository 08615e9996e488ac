"""transforms.json: text, keys and types; faults of one kind are one entry, and no time is lost."""

import json
from typing import Any

import pytest
from sphere_scan import NAMES, edit, only_fault, write_sphere

from sl_nerfstudio.errors import ScanError
from sl_nerfstudio.scan import check_scan, read_scan, require_valid
from sl_nerfstudio.scan.document import MAX_DEPTH, FileError, read_document


@pytest.mark.parametrize(
    ("content", "problem", "cause"),
    [
        (b"", "is empty (0 bytes)", "full disk"),
        (b" \n", "is empty (white space only)", "interrupted"),
        (b'{"sl_format": 1, "frames": [', "Expecting value", "truncated"),
        (b'{"sl_format": 1, "uni', "Unterminated string", "truncated"),
        (b'{"sl_format": 1,}', "is not valid JSON", "comma"),
        (b'\xef\xbb\xbf{"sl_format": 1}', "byte-order mark", "UTF-8 with BOM"),
        ('{"a": "ä"}'.encode("latin-1"), "is not UTF-8 (byte 7)", "another encoding"),
        ('{"a": 1}'.encode("utf-16"), "is not UTF-8", "UTF-16"),
        (b"[1, 2]", "holds a list instead of an object", "another kind"),
        (b"null", "holds null instead of an object", "another kind"),
        (b"[" * 100_000, "nested too deeply", "does not describe"),
        (b'{"a": 1' + b"0" * 5000 + b"}", "is not valid JSON", "damaged number"),
    ],
)
def test_unreadable_text(sphere, content, problem, cause):
    (sphere / "transforms.json").write_bytes(content)
    fault = only_fault(sphere)
    assert fault.file == "transforms.json" and problem in fault.problem and cause in fault.cause


def test_missing_folder_file_for_folder_and_missing_transforms(tmp_path):
    assert "does not exist" in only_fault(tmp_path / "nowhere").problem
    (tmp_path / "file").write_text("x")
    assert "is a file, not a folder" in only_fault(tmp_path / "file").problem
    (tmp_path / "empty").mkdir()
    assert only_fault(tmp_path / "empty").problem == f"is missing in {tmp_path / 'empty'}"
    (tmp_path / "folder" / "transforms.json").mkdir(parents=True)
    assert only_fault(tmp_path / "folder").problem == "is not a file"
    (tmp_path / "a").symlink_to(tmp_path / "a")
    assert "is missing" in only_fault(tmp_path / "a").problem  # a link in a circle


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_that_are_none(sphere, number):
    path = sphere / "transforms.json"
    document = json.loads(path.read_text())
    document["frames"][2]["transform_matrix"][1][3] = "@"
    path.write_text(json.dumps(document).replace('"@"', number))
    fault = only_fault(sphere)
    assert (fault.frame, fault.field) == (NAMES[2], "transform_matrix")
    assert fault.problem == f"holds {float(number.replace('1e999', 'inf'))}, which is not a number"
    assert "registration or calibration failed" in fault.cause


def test_a_number_that_is_none_counts_even_where_nothing_reads_it(sphere):
    path = sphere / "transforms.json"
    path.write_text(path.read_text().replace('"sl_format"', '"quality": {"rms": [1, NaN]}, "sl_format"'))
    assert only_fault(sphere).field == "quality.rms"


def test_keys_given_twice(sphere):
    path = sphere / "transforms.json"
    text = path.read_text().replace('"units": "mm"', '"units": "m", "units": "mm"')
    path.write_text(
        text.replace('"file_path": "images/frame_00001.png"', '"file_path": "x", "file_path": "images/frame_00001.png"')
    )
    faults = check_scan(sphere)
    assert [(f.frame, f.field, f.problem) for f in faults] == [
        (None, "units", "occurs more than once"),
        (NAMES[1], "file_path", "occurs more than once"),
    ]


def set_key(key, value):
    def change(document):
        *path, last = key.split(".")
        place: Any = document
        for part in path:
            place = place[int(part) if part.isdigit() else part]
        if value is KeyError:
            del place[last]
        elif callable(value):
            place[last] = value(place[last])
        else:
            place[last] = value

    return change


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("sl_format", 2, "is 2"),
        ("sl_format", "1", "is '1' instead of a number"),
        ("units", KeyError, "is missing"),
        ("units", "inch", "is 'inch'"),
        ("units", None, "is null instead of a value"),
        ("scale.known", "yes", "is 'yes' instead of true or false"),
        ("scale.source", 3, "is 3 instead of a text"),
        ("projector", [1], "is [1] instead of an object { .. }"),
        ("projector.model", "FISHEYE", "is 'FISHEYE'"),
        ("camera_model", "OPENCV_FISHEYE", "is 'OPENCV_FISHEYE'"),
        ("camera_model", "DOE", "is 'DOE'"),
        ("projector.fl_y", "12", "is '12' instead of a number"),
        ("w", 72.5, "is 72.5, not a whole number greater than 0"),
        ("projector.cy", -1e9, "is -1e+09, far outside an image of 96 pixels"),
        ("k3", 0.1, "is not 0"),
        ("frames", KeyError, "is missing or is not a list"),
        ("frames", [], "is empty"),
        ("frames", lambda frames: frames[:1], "holds only one frame"),
        ("frames", lambda frames: [*frames, "frame"], "is not an object { .. }"),
        ("projector.pattern_path", "../pattern.png", "leaves the scan folder"),
        ("sl_pose_sigma", {"camera_translation": 1}, "is missing"),
    ],
)
def test_wrong_or_missing_values(sphere, key, value, problem):
    edit(sphere, set_key(key, value))
    faults = check_scan(sphere)
    expected = f"{key}.camera_rotation_deg" if key == "sl_pose_sigma" else key
    assert (faults[0].file, faults[0].field or "frames") == ("transforms.json", expected)
    assert problem in faults[0].problem and faults[0].cause and faults[0].remedy
    assert len(faults) == (3 if key == "sl_pose_sigma" else 1)


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("file_path", KeyError, "is missing"),
        ("sl_coords_path", KeyError, "is missing"),
        ("mask_path", 0, "is 0 instead of a text"),
        ("transform_matrix", [[1, 2], [3]], "is [[1, 2], [3]] instead of a list of four rows"),
        ("projector_transform_matrix", [["1"] * 4] * 4, "instead of a list of four rows of four numbers"),
    ],
)
def test_wrong_or_missing_values_of_a_frame(sphere, key, value, problem):
    edit(sphere, set_key(f"frames.1.{key}", value))
    fault = only_fault(sphere)
    assert (fault.file, fault.field) == ("transforms.json", key)
    assert fault.frame == ("#1" if key == "file_path" else NAMES[1])
    assert problem in fault.problem


def test_a_misspelt_key_is_not_passed_over(sphere):
    def misspell(document):
        frame = document["frames"][1]
        frame["sl_patern_path"] = frame.pop("sl_pattern_path")

    edit(sphere, misspell)
    fault = only_fault(sphere)
    assert (fault.frame, fault.field, fault.remedy) == (NAMES[1], "sl_patern_path", "did you mean 'sl_pattern_path'?")


def test_unknown_keys_are_welcome(sphere):
    edit(sphere, lambda document: document.update(applied_scale=1.0, sl_posterior={"a": [1, {"b": 2}]}, comment="ä€"))
    assert check_scan(sphere) == []


def test_everything_at_once_and_training_refuses_the_same(sphere):
    def spoil(document):
        document["units"] = "parsec"
        document["projector"]["fl_x"] = 0
        document["frames"][0]["transform_matrix"][3][3] = 2
        document["frames"][1]["file_path"] = "/tmp/x.png"

    edit(sphere, spoil)
    (sphere / "masks" / f"{NAMES[2]}.png").unlink()
    (sphere / "coords" / f"{NAMES[3]}.npz").write_bytes(b"PK\x03\x04")
    faults = check_scan(sphere)
    assert {(f.file, f.field) for f in faults} == {
        ("transforms.json", "units"),
        ("transforms.json", "projector.fl_x"),
        ("transforms.json", "transform_matrix"),
        ("transforms.json", "file_path"),
        (f"masks/{NAMES[2]}.png", None),
        (f"coords/{NAMES[3]}.npz", None),
    }
    with pytest.raises(ScanError) as refused:
        require_valid(sphere)
    assert refused.value.faults == faults
    assert str(refused.value).startswith(f"6 faults in {sphere}\n")
    for fault in faults:
        assert str(fault) in str(refused.value)
    with pytest.raises(ScanError) as quick:
        read_scan(sphere)
    assert set(map(str, quick.value.faults)) == set(map(str, faults))


def test_names_may_have_any_letters(tmp_path):
    root = write_sphere(tmp_path / "Ωμέγα 扫描 é", frames=2)
    (root / "images" / "frame_00000.png").rename(root / "images" / "bild_ä日本.png")
    edit(root, set_key("frames.0.file_path", "images/bild_ä日本.png"))
    assert check_scan(root) == []
    assert read_scan(root).frames[0].name == "bild_ä日本"


def ordinary(document):
    """A data set of nerfstudio."""
    for key in ("projector", "sl_format", "scale", "units"):
        del document[key]
    keys = ("file_path", "transform_matrix")
    document["frames"] = [{key: frame[key] for key in keys} for frame in document["frames"]] * 150


def test_an_ordinary_data_set_gets_one_sentence(sphere):
    edit(sphere, ordinary)
    fault = only_fault(sphere)
    assert "there is no projector in this data set" in fault.problem and "sl-process" in fault.remedy
    with pytest.raises(ScanError, match="no projector"):
        read_scan(sphere)


def test_faults_of_one_kind_are_one_entry(sphere):
    edit(sphere, lambda document: [frame.pop("transform_matrix") for frame in document["frames"]])
    (sphere / "masks" / f"{NAMES[0]}.png").unlink()
    faults = check_scan(sphere)
    assert [fault.frame for fault in faults] == [*NAMES, NAMES[0]]
    lines = str(ScanError(faults, "scan")).splitlines()
    assert lines[0] == "5 faults in scan"
    assert lines[1] == f"transforms.json: frame {NAMES[0]}: transform_matrix: is missing"
    assert lines[4] == f"    and 3 more frames: {', '.join(NAMES[1:])}"
    assert lines[5] == f"masks/{NAMES[0]}.png: is missing" and len(lines) == 8


def test_faults_that_differ_in_numbers_are_of_one_kind(sphere):
    edit(sphere, lambda document: document.update({key: -float(k) for k, key in enumerate(("fl_x", "fl_y"), 1)}))
    edit(sphere, lambda document: [frame.update(transform_matrix=k) for k, frame in enumerate(document["frames"])])
    text = str(ScanError(check_scan(sphere), "scan"))
    assert text.count("instead of a list of four rows") == 1 and "and 3 more frames" in text


def many_frames(document):
    frame = document["frames"][0]
    document["frames"] = [
        {k: v.replace(NAMES[0], f"frame_{n:05d}") if isinstance(v, str) else v for k, v in frame.items()}
        for n in range(500)
    ]


@pytest.mark.parametrize(
    ("change", "count"),
    [
        (many_frames, 500 * 4 - 4 * 4 + 2),  # files that are missing, one that is there, poses that are the same
        (lambda document: document.update(frames=document["frames"][:1] * 300), 2),
        (lambda document: document.update({f"frames{k}": k for k in range(20_000)}), 0),
    ],
)
def test_many_frames_and_keys_make_few_lines(sphere, change, count):
    edit(sphere, change)
    faults = check_scan(sphere)
    assert len(faults) == count
    assert not faults or len(str(ScanError(faults)).splitlines()) < 40


def test_keys_given_twice_are_counted_once_through(sphere):
    path = sphere / "transforms.json"
    twice = ", ".join(f'"key_{k % 10_000}": {k}' for k in range(20_000))
    path.write_text("{" + twice + "," + path.read_text().strip()[1:])
    assert len(check_scan(sphere)) == 10_000


@pytest.mark.parametrize(("depth", "right"), [(MAX_DEPTH, True), (MAX_DEPTH + 1, False), (900, False)])
def test_depth_is_limited(tmp_path, depth, right):
    path = tmp_path / "a.json"
    path.write_text('{"a": ' * depth + "1" + "}" * depth)
    if right:
        assert json.dumps(read_document(path)).count("{") == depth
        return
    with pytest.raises(FileError, match="nested too deeply"):
        read_document(path)


@pytest.mark.parametrize("x", [1e5, 1e8, 1e30, 1e308])
@pytest.mark.parametrize("key", ["transform_matrix", "projector_transform_matrix"])
def test_a_device_far_from_all_others(sphere, key, x):
    """The object has a radius of 40, the devices are 250 away."""

    def move(document):
        document["frames"][1][key][0][3] += x

    edit(sphere, move)
    fault = only_fault(sphere)
    assert (fault.frame, fault.field) == (NAMES[1], key)
    assert "puts the device" in fault.problem
