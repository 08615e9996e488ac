"""Coordinates as images: what comes back, in which unit, and what is refused."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy import ndarray
from sphere_scan import CAMERA, NAMES, PROJECTOR, edit, only_fault

from sl_nerfstudio.cli.check import CheckArguments, check
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan import FileError, check_scan, read_scan
from sl_nerfstudio.scan.coordinates import CoordinateFiles
from tests.dataparser.coordinate_images import one_tiff, pair_of_indices, pair_of_parts, replace_coords

NAME = NAMES[1]
SIZE = np.array([PROJECTOR.w, PROJECTOR.h], dtype=np.float64)
X, Y, BOTH = (f"coords/{NAME}{ending}" for ending in ("_x.png", "_y.png", ".tif"))


@pytest.fixture
def pairs(sphere: Path) -> Path:
    return replace_coords(sphere, pair_of_parts, "parts_of_65535")


@pytest.fixture
def tiffs(sphere: Path) -> Path:
    return replace_coords(sphere, one_tiff, "pixels")


def coords_of(root: Path) -> ndarray:
    return np.stack([frame.read_coords() for frame in read_scan(root).frames])


def change(root: Path, path: str, function: Callable[[ndarray], ndarray]) -> None:
    image = cv2.imread(str(root / path), cv2.IMREAD_UNCHANGED)
    assert cv2.imwrite(str(root / path), function(image))


# ---- what comes back


@pytest.mark.parametrize("in_frames", [False, True])
def test_pairs_come_back_to_half_a_step(sphere, in_frames):
    exact = coords_of(sphere)
    replace_coords(sphere, pair_of_parts, "parts_of_65535", in_frames)
    assert check_scan(sphere) == []
    found = coords_of(sphere)
    assert np.array_equal(np.isnan(found), np.isnan(exact)) and np.isfinite(exact).any()
    off = np.abs(found - exact)[np.isfinite(exact).all(-1)]
    half = SIZE / 65535 / 2
    assert (off <= half + 1e-5).all(), "more than rounding to 16 bit, and then to float32"
    assert (off.max(0) > 0.9 * half).all(), "the bound is not met by chance"


def test_whole_numbers_of_pixels_stand_for_their_centres(sphere):
    exact = coords_of(sphere)
    replace_coords(sphere, pair_of_indices, "pixels")
    expected = np.where((exact >= 1).all(-1, keepdims=True), np.floor(exact) + 0.5, np.nan).astype(np.float32)
    assert np.array_equal(coords_of(sphere), expected, equal_nan=True)


def test_floating_point_tiff_comes_back_bit_for_bit(sphere_original, tiffs):
    assert check_scan(tiffs) == []
    assert coords_of(tiffs).tobytes() == coords_of(sphere_original).tobytes()


@pytest.mark.parametrize("third", [0.0, 1.0])
@pytest.mark.parametrize(
    "write",
    [
        lambda path, a: tifffile.imwrite(path, a, photometric="rgb", compression="zlib"),
        lambda path, a: tifffile.imwrite(path, np.moveaxis(a, -1, 0), photometric="rgb", planarconfig="separate"),
        lambda path, a: tifffile.imwrite(path, a, photometric="rgb", byteorder=">", rowsperstrip=7),
        lambda path, a: cv2.imwrite(str(path), a[..., ::-1], [cv2.IMWRITE_TIFF_COMPRESSION, 1]),
    ],
)
def test_a_third_channel_without_content_is_passed_over(tmp_path, write, third):
    coords = np.random.default_rng(0).uniform(1, 90, (20, 30, 3)).astype(np.float32)
    coords[..., 2], coords[3:5, 2:9, :2] = third, np.nan
    write(tmp_path / "a.tif", coords)
    found = CoordinateFiles((tmp_path / "a.tif",)).read()
    assert found.tobytes() == np.ascontiguousarray(coords[..., :2]).tobytes()


def test_16_bit_tiff_as_opencv_writes_it(tmp_path):
    values = np.random.default_rng(0).integers(1, 65536, (20, 30, 3)).astype(np.uint16)
    values[..., 2], values[4, 5] = 0, 0
    values[7, 8, 1] = 0  # x alone is no coordinate
    assert cv2.imwrite(str(tmp_path / "a.tif"), values[..., ::-1])  # LZW
    found = CoordinateFiles((tmp_path / "a.tif",), "parts_of_65535", (128, 96)).read()
    expected = values[..., :2] / 65535 * (128, 96)
    expected[[4, 7], [5, 8]] = np.nan
    np.testing.assert_allclose(found, expected, rtol=1e-6)


# ---- through sl-check


def test_sl_check_writes_arrays_to_a_new_folder(pairs, tmp_path, capsys):
    before = {path: path.read_bytes() for path in pairs.rglob("*") if path.is_file()}
    check(CheckArguments(pairs, tmp_path / "new"))
    assert f"written             {tmp_path / 'new'}" in capsys.readouterr().out
    assert {path: path.read_bytes() for path in pairs.rglob("*") if path.is_file()} == before
    new = read_scan(tmp_path / "new")
    assert [f.coords_paths for f in new.frames] == [(new.root / f"coords/{name}.npz",) for name in NAMES]
    assert coords_of(tmp_path / "new").tobytes() == coords_of(pairs).tobytes()
    assert "sl_coords_units" not in (tmp_path / "new/transforms.json").read_text()
    others = {p.relative_to(pairs) for p in before} - {Path(f"coords/{n}_{a}.png") for n in NAMES for a in "xy"}
    for path in others - {Path("transforms.json")}:
        assert (tmp_path / "new" / path).read_bytes() == before[pairs / path]
    assert check_scan(tmp_path / "new") == []
    with pytest.raises(UserError, match="is not empty"):
        check(CheckArguments(pairs, tmp_path / "new"))
    with pytest.raises(UserError, match="is not empty"):
        check(CheckArguments(pairs, pairs))


def test_of_a_training_run_no_copy_is_written(tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.yml").write_text("{}")
    with pytest.raises(UserError, match="is a training run, of which no copy is written"):
        check(CheckArguments(tmp_path / "run", tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_a_faulty_scan_is_not_written(pairs, tmp_path):
    (pairs / X).unlink()
    with pytest.raises(UserError, match=r"coords/frame_00001_x\.png: is missing"):
        check(CheckArguments(pairs, tmp_path / "new"))
    assert not (tmp_path / "new").exists()


# ---- what is refused


def frame_keys(root: Path, **keys: object) -> None:
    """Set keys of a frame, or remove them (None)."""

    def put(document: dict) -> None:
        document["frames"][1].update(keys)
        for key in [key for key, value in keys.items() if value is None]:
            del document["frames"][1][key]

    edit(root, put)


def test_every_fault_of_the_keys_at_once(pairs):
    def spoil(document: dict) -> None:
        del document["sl_coords_units"]
        frames = document["frames"]
        for frame in frames:
            frame["sl_coords_units"] = "parts_of_65535"
        del frames[0]["coords_y"]
        del frames[1]["sl_coords_units"]
        frames[2]["sl_coords_path"] = "coords/both.tif"
        frames[3]["sl_coords_units"] = "percent"

    edit(pairs, spoil)
    faults = check_scan(pairs)
    said = {(fault.frame, fault.field): fault.problem for fault in faults}
    assert said == {
        (NAMES[0], "coords_y"): "is missing, although coords_x is given",
        (NAMES[1], "sl_coords_units"): "is missing, although the coordinates are images",
        (NAMES[2], "coords_x"): "is given together with sl_coords_path",
        (NAMES[3], "sl_coords_units"): "is 'percent'",
    }
    assert any(f.remedy.startswith('state "sl_coords_units": "pixels" or "parts_of_65535"') for f in faults)


def test_contradicting_units(pairs):
    frame_keys(pairs, sl_coords_units="pixels")
    fault = only_fault(pairs)
    assert (fault.frame, fault.field) == (NAME, "sl_coords_units")
    assert fault.problem == "is pixels here but parts_of_65535 for all frames"


def test_arrays_are_pixels_always(sphere):
    frame_keys(sphere, sl_coords_units="parts_of_65535")
    assert only_fault(sphere).problem == "is parts_of_65535, although the coordinates are an array"
    frame_keys(sphere, sl_coords_units="pixels")
    assert check_scan(sphere) == []


@pytest.mark.parametrize(
    ("spoil", "path", "problem"),
    [
        (lambda a: a[:-1], Y, "is 72 x 59 pixels, but the camera has 72 x 60"),
        (lambda a: (a // 256).astype(np.uint8), Y, "has 8 bits a pixel instead of 16"),
        (lambda a: np.stack([a] * 3, -1), Y, "is in colour"),
        (lambda a: a * 0, X, "is NaN everywhere"),
        (lambda a: np.where(a == 0, 65535, a).astype(np.uint16), X, "has the value"),
    ],
)
def test_images_that_are_no_pair(pairs, spoil, path, problem):
    change(pairs, path, spoil)
    if "value" in problem:
        change(pairs, Y, spoil)
    fault = only_fault(pairs)
    assert (fault.file, fault.frame) == (path, NAME) and problem in fault.problem
    assert "value" not in problem or fault.remedy == "write 0 in the images of x and y where a pixel was not decoded"


def test_two_sizes_without_a_camera_to_compare_with(pairs):
    change(pairs, X, lambda image: image[:-1])
    path_x, path_y = pairs / X, pairs / Y
    with pytest.raises(FileError, match=f"is {CAMERA.w} x {CAMERA.h} pixels, but that of x is 72 x 59"):
        CoordinateFiles((path_x, path_y)).read()


def test_a_wrong_unit_is_found_in_either_direction(sphere_original, tmp_path):
    root = replace_coords(Path(shutil.copytree(sphere_original, tmp_path / "a")), pair_of_parts, "pixels")
    faults = check_scan(root)
    assert [fault.file for fault in faults] == [f"coords/{name}_x.png" for name in NAMES]
    assert all("outside the pattern" in f.problem and '"parts_of_65535"' in f.remedy for f in faults)
    root = replace_coords(Path(shutil.copytree(sphere_original, tmp_path / "b")), pair_of_indices, "parts_of_65535")
    faults = check_scan(root)
    assert len(faults) == len(NAMES)
    assert all("of the pattern (x_p" in f.problem and '"pixels"' in f.remedy for f in faults)


GOOD = np.random.default_rng(0).uniform(5, 90, (CAMERA.h, CAMERA.w, 2)).astype(np.float32)
PLANE = {"photometric": "minisblack", "planarconfig": "contig"}


@pytest.mark.parametrize(
    ("write", "problem"),
    [
        (lambda path: tifffile.imwrite(path, GOOD), "holds 60 images"),
        (lambda path: tifffile.imwrite(path, GOOD[..., 0]), "has 1 channel instead of 2 or 3"),
        (lambda path: tifffile.imwrite(path, np.dstack([GOOD, GOOD]), **PLANE), "has 4 channels instead of 2 or 3"),
        (lambda path: tifffile.imwrite(path, GOOD.astype(np.float16), **PLANE), "holds float16 instead of float32"),
        (lambda path: tifffile.imwrite(path, GOOD.astype(np.uint8), **PLANE), "holds uint8 instead of float32"),
        (lambda path: tifffile.imwrite(path, np.dstack([GOOD, GOOD[..., :1]]), photometric="rgb"),
         "has a third channel that is not the same at all decoded pixels"),
        (lambda path: cv2.imwrite(str(path), np.dstack([GOOD, GOOD[..., :1] * 0])[..., ::-1]),
         "is compressed as a photograph, which changes its numbers"),
        (lambda path: tifffile.imwrite(path, GOOD[:-2], **PLANE), "is 72 x 58 pixels, but the camera has 72 x 60"),
        (lambda path: path.write_bytes(b"II*\0 and then nothing of use"), "cannot be read"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1000]), "cannot be read"),
        (lambda path: path.write_bytes(b""), "is empty"),
    ],
)  # fmt: skip
def test_tiffs_that_hold_no_coordinates(tiffs, write, problem):
    write(tiffs / BOTH)
    fault = only_fault(tiffs)
    assert (fault.file, fault.frame) == (BOTH, NAME)
    assert problem in fault.problem and fault.remedy


@settings(max_examples=200, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(data=st.data())
@pytest.mark.parametrize("kind", [{}, {"compression": "zlib"}, {"tile": (16, 16)}])
def test_a_damaged_header_is_refused_or_read(tmp_path_factory, capfd, kind, data):
    """Whatever its bytes say, there is an array or a message, and no word of the library's own."""
    path = tmp_path_factory.getbasetemp() / "damaged.tif"
    tifffile.imwrite(path, GOOD, **PLANE, **kind)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, 300))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    try:
        found = CoordinateFiles((path,)).read()
    except FileError as error:
        assert error.problem and error.remedy
    else:
        assert found.dtype == np.float32 and found.shape[2] == 2
    assert capfd.readouterr() == ("", "")


def test_exr_is_refused_with_the_command_that_converts_it(tiffs):
    (tiffs / BOTH).rename((tiffs / BOTH).with_suffix(".exr"))
    frame_keys(tiffs, sl_coords_path=BOTH.replace(".tif", ".exr"))
    fault = only_fault(tiffs)
    assert fault.problem == "is an EXR file, a format that is not read"
    assert "OPENCV_IO_ENABLE_OPENEXR=1 python -c" in fault.remedy
