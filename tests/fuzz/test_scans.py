"""Damaged scans: the check names faults or finds the same scan, and never fails itself."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sl_nerfstudio.errors import ScanError, UserError
from sl_nerfstudio.scan import PickedPixel, PoseSigma, Scale, ScaleBar, check_scan, read_scan
from tests.fuzz.damage import IMPOSSIBLE, at, damaged, places, removed, replaced
from tests.scan.sphere_scan import NAMES, write_sphere

SIGMA = PoseSigma(3.0, 1.0, 2.0, 0.25)
BAR = ScaleBar((PickedPixel(NAMES[1], (30.25, 20.0)), PickedPixel(NAMES[3], (40.5, 33.5))), 51.5)
OPTIONAL = {"source", "mask_path", "sl_pattern_path", "sl_pose_sigma", "k1", "k2", "p1", "p2"}
few = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    root = write_sphere(tmp_path_factory.mktemp("fuzz") / "scan", frames=4, scale=Scale(True, "a ruler", bar=BAR))
    path = root / "transforms.json"
    document = json.loads(path.read_text())
    document["sl_pose_sigma"] = {key: getattr(SIGMA, key) for key in SIGMA.__dataclass_fields__}
    path.write_text(json.dumps(document))
    return root


@pytest.fixture(scope="module")
def root(original, tmp_path_factory):
    """A copy to be damaged; every test puts back what it changed."""
    return Path(shutil.copytree(original, tmp_path_factory.mktemp("damaged") / "scan"))


def pixels(scan):
    frames = [
        array for f in scan.frames for array in (f.read_image(), f.read_pattern(), f.read_coords(), f.read_mask())
    ]
    return [scan.read_pattern(), *frames]


@few
@given(data=st.data())
def test_impossible_values_are_refused(original, root, data):
    document = json.loads((original / "transforms.json").read_text())
    place = data.draw(st.sampled_from(list(places(document))))
    value = data.draw(st.sampled_from(IMPOSSIBLE))
    (root / "transforms.json").write_text(json.dumps(replaced(document, place, value)))
    faults = check_scan(root)
    assert faults or may_stay(place, value), f"{place} = {value!r:.60} was accepted"
    str(ScanError(faults)) if faults else read_scan(root)


def may_stay(place, value):
    """Texts for people may be anything, what is optional may be absent, and -1 is a number like others."""
    key = place[-1]
    return (
        key == "source"
        or (value is None and key in OPTIONAL)
        or (value == -1 and (isinstance(key, int) or key in ("k1", "k2", "cx", "cy")))
        or (key == "units" and value == "arbitrary")
    )


@few
@given(data=st.data())
def test_missing_values_are_refused(original, root, data):
    document = json.loads((original / "transforms.json").read_text())
    place = data.draw(st.sampled_from(list(places(document))))
    (root / "transforms.json").write_text(json.dumps(removed(document, place)))
    faults = check_scan(root)
    frame = len(place) == 2 and place[0] == "frames" and place[1] not in (1, 3)  # the known length is in 1 and 3
    bar_is_gone = place == ("scale", "source")
    assert faults or frame or bar_is_gone or place[-1] in OPTIONAL, f"without {place} it was accepted"


@few
@given(data=st.data())
def test_a_damaged_file_is_refused_or_holds_the_same(original, root, data):
    files = sorted(p.relative_to(original) for p in original.rglob("*.*") if p.suffix in (".png", ".npz"))
    name = data.draw(st.sampled_from(files))
    content = (original / name).read_bytes()
    (root / "transforms.json").write_bytes((original / "transforms.json").read_bytes())
    try:
        (root / name).write_bytes(data.draw(damaged(content)))
        if not check_scan(root):
            same = zip(pixels(read_scan(root)), pixels(read_scan(original)), strict=True)
            assert all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in same), name
    finally:
        (root / name).write_bytes(content)


@few
@given(data=st.data())
def test_a_damaged_document_is_no_crash(original, root, data):
    (root / "transforms.json").write_bytes(data.draw(damaged((original / "transforms.json").read_bytes())))
    if check_scan(root):
        with pytest.raises(UserError):
            read_scan(root)
            raise ScanError(check_scan(root))


def test_the_places_are_those_of_the_document(original):
    document = json.loads((original / "transforms.json").read_text())
    assert at(document, ("frames", 2, "transform_matrix", 0, 3)) in document["frames"][2]["transform_matrix"][0]
    assert len(list(places(document))) > 200
