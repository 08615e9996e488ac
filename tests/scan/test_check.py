"""Coordinates, masks and pattern images: what the numbers say."""

import io
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from sphere_scan import CAMERA, NAMES, PROJECTOR, edit, edit_coords, only_fault, write_sphere

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan import FileError, check_scan, read_scan
from sl_nerfstudio.scan.coordinates import read_coords, read_coords_size

NAME = NAMES[1]
COORDS = f"coords/{NAME}.npz"
NAN = np.float32(np.nan)


def npy(array, **options):
    stream = io.BytesIO()
    np.save(stream, array, **options)
    return stream.getvalue()


def zipped(**members):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(f"{name}.npy", content)
    return stream.getvalue()


def image_coords(dtype=np.float32):
    return np.random.default_rng(0).uniform(5, 90, (CAMERA.h, CAMERA.w, 2)).astype(dtype)


GOOD = npy(image_coords())


class Mine:
    """A trap: unpickling it would leave a mark."""

    def __reduce__(self):
        import os

        return os.system, ("touch /tmp/unpickled-by-sl-check",)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (zipped(coords=npy(np.array([Mine()], dtype=object), allow_pickle=True)), "holds pickled Python objects"),
        (zipped(coords=npy(image_coords(np.float64))), "holds float64 instead of float32"),
        (zipped(coords=npy(image_coords()[..., 0])), "has the shape (60, 72) instead of (H, W, 2)"),
        (zipped(coords=npy(image_coords().transpose(2, 0, 1))), "has the shape (2, 60, 72) instead of (H, W, 2)"),
        (zipped(coords=npy(image_coords()[:0])), "has the shape (0, 72, 2)"),
        (zipped(arr_0=GOOD), "must hold exactly one array called 'coords', but holds 'arr_0'"),
        (zipped(), "but holds nothing"),
        (zipped(**{f"a{i}": b"" for i in range(100)}), "holds 100 members"),
        (zipped(coords=GOOD[:-100]), "bytes, but its header says"),
        (zipped(coords=GOOD.replace(b"(60, 72, 2)", b"(60000, 72000, 2)", 1)), "bytes, but its header says"),
        (zipped(coords=b"no array"), "cannot be read"),
        (zipped(coords=GOOD)[:200], "cannot be read"),
        (b"", "is empty (0 bytes)"),
    ],
)
def test_files_that_hold_no_coordinates(sphere, content, problem):
    (sphere / COORDS).write_bytes(content)
    fault = only_fault(sphere)
    assert (fault.file, fault.frame) == (COORDS, NAME)
    assert problem in fault.problem
    assert not Path("/tmp/unpickled-by-sl-check").exists()


def test_plain_npy_any_order_any_byte_order(tmp_path):
    coords = image_coords()
    for variant in (coords, np.asfortranarray(coords), coords.astype(">f4")):
        (tmp_path / "a.npy").write_bytes(npy(variant))
        assert read_coords_size(tmp_path / "a.npy") == (CAMERA.w, CAMERA.h)
        found = read_coords(tmp_path / "a.npy")
        assert found.dtype == np.float32 and found.flags.c_contiguous and np.array_equal(found, coords)
    (tmp_path / "a.npy").write_bytes(npy(np.array([Mine()], dtype=object), allow_pickle=True))
    with pytest.raises(FileError, match="holds pickled Python objects, which are never loaded"):
        read_coords(tmp_path / "a.npy")
    (tmp_path / "a.txt").write_bytes(npy(coords))
    with pytest.raises(FileError, match=r"is neither \.npz nor \.npy"):
        read_coords(tmp_path / "a.txt")


def placed(value):
    return lambda coords: np.concatenate([np.full_like(coords[:8], value), coords[8:]])


def scale(x, y):
    return lambda coords: coords * np.array([x, y], np.float32)


def one_pixel(value):
    def change(coords):
        row, column = np.argwhere(np.isfinite(coords[..., 0]))[7]
        coords[row, column] = value
        return coords

    return change


def exchange(coords):
    """Of an oblong pattern."""
    return np.ascontiguousarray(coords[..., ::-1]) + np.array([0, 40], np.float32)


def lose_x(coords):
    coords[25:35, 30:40, 0] = NAN
    return coords


@pytest.mark.parametrize(
    ("change", "problem", "cause", "remedy"),
    [
        (lambda c: c * NAN, "is NaN everywhere", "decoding failed", "leave the frame out"),
        (placed(np.inf), "holds infinities at 576 pixels", "division by zero", "write NaN"),
        (placed(0), "has the value (0, 0) at 576 pixels", "stands for 'not decoded'", "write NaN"),
        (lambda c: c * 0 + 50, "has the value (50, 50) at", "placeholder", "write NaN"),
        (lose_x, "has only one of x_p and y_p at 100 pixels", "decoded separately", "NaN for both"),
        (np.floor, "holds whole numbers only", "Gray-code", "add 0.5"),
        (scale(1 / PROJECTOR.w, 1 / PROJECTOR.h), "lies between -1 and 1", "normalised", "multiply"),
        (scale(4, 4), "outside the pattern", "another size", "pixels of pattern.png"),
        (exchange, "outside the pattern", "x and y are swapped", "pixels of pattern.png"),
        (one_pixel(-9999), "puts 1 pixel outside the pattern", "marker", "NaN where not decoded"),
        (one_pixel(1e30), "puts 1 pixel outside the pattern", "diverged", "NaN where not decoded"),
    ],
)
def test_coordinates(sphere, change, problem, cause, remedy):
    edit_coords(sphere, NAME, change)
    fault = only_fault(sphere)
    assert (fault.file, fault.frame) == (COORDS, NAME)
    assert problem in fault.problem and cause in fault.cause and remedy in fault.remedy


def test_a_few_wrong_decodings_outside_the_pattern_are_no_fault(sphere):
    def stray(coords):
        rows, columns = np.nonzero(np.isfinite(coords[..., 0]))
        some = np.random.default_rng(0).random(len(rows)) < 0.04
        coords[rows[some], columns[some]] += np.float32(0.3) * np.array([PROJECTOR.w, PROJECTOR.h], np.float32)
        return coords

    edit_coords(sphere, NAME, stray)
    assert check_scan(sphere) == []


@pytest.mark.parametrize(
    ("shift", "cause", "remedy"),
    [(-0.5, "OpenCV", "add 0.5 to"), (0.5, "half a pixel was added", "subtract 0.5 from")],
)
def test_coordinates_half_a_pixel_off_are_seen_in_the_pattern(sphere, shift, cause, remedy):
    for name in NAMES:
        edit_coords(sphere, name, lambda coords: coords + np.float32(shift))
    fault = only_fault(sphere)
    assert (fault.file, fault.frame, fault.field) == ("transforms.json", None, "sl_coords_path")
    assert fault.problem == "are shifted relative to the pattern by half a pixel in x and y, in 4 of 4 frames"
    assert cause in fault.cause and remedy in fault.remedy


@pytest.mark.parametrize(
    ("change", "problem", "remedy"),
    [
        (lambda m: m * 0, "is 0 everywhere", "leave the frame out"),
        (lambda m: m // 255, "has 0 and 1 instead of 0 and 255", "multiply it by 255"),
        (lambda m: m // 2, "has grey levels between black and white (127)", "0 and 255 only"),
        (lambda m: 255 - m, "excludes every pixel that has coordinates", "255 where the pattern falls"),
    ],
)
def test_masks(sphere, change, problem, remedy):
    path = sphere / "masks" / f"{NAME}.png"
    Image.fromarray(change(np.array(Image.open(path)))).save(path)
    fault = only_fault(sphere)
    assert (fault.file, fault.frame) == (f"masks/{NAME}.png", NAME)
    assert fault.problem == problem and remedy in fault.remedy


def test_sizes_are_compared_with_the_coordinates_where_the_camera_is_not_known(sphere):
    path = sphere / "masks" / f"{NAME}.png"
    Image.new("L", (CAMERA.w, CAMERA.h + 3), 255).save(path)
    edit(sphere, lambda document: document.update(fl_x=-1.0))
    faults = check_scan(sphere)
    assert [fault.field for fault in faults[:-1]] == ["fl_x"] and faults[-1].file == f"masks/{NAME}.png"
    assert f"but its coordinates are {CAMERA.w} x {CAMERA.h}" in faults[-1].problem


def test_a_mask_of_255_everywhere_and_none_at_all_are_no_faults(sphere):
    Image.new("L", (CAMERA.w, CAMERA.h), 255).save(sphere / "masks" / f"{NAME}.png")
    edit(sphere, lambda document: document["frames"][2].pop("mask_path"))
    edit(sphere, lambda document: document["frames"][3].update(mask_path=None))
    assert check_scan(sphere) == []
    scan = read_scan(sphere)
    assert scan.frames[1].read_mask().all()
    assert np.array_equal(scan.frames[2].read_mask(), np.isfinite(scan.frames[2].read_coords()[..., 0]))


def test_pictures_of_nothing(sphere):
    Image.new("L", (CAMERA.w, CAMERA.h), 7).save(sphere / "patterns" / f"{NAME}.png")
    fault = only_fault(sphere)
    assert fault.file == f"patterns/{NAME}.png"
    assert "the same value everywhere" in fault.problem
    edit(sphere, lambda document: document["frames"][1].pop("sl_pattern_path"))
    assert check_scan(sphere) == []  # then the image is compared with the pattern
    Image.new("L", (CAMERA.w, CAMERA.h), 7).save(sphere / "images" / f"{NAME}.png")
    assert only_fault(sphere).file == f"images/{NAME}.png"
    Image.new("L", (PROJECTOR.w, PROJECTOR.h), 200).save(sphere / "pattern.png")
    said = {fault.file: fault.problem for fault in check_scan(sphere)}
    assert said["pattern.png"] == "has the same value everywhere in the pattern"


def test_a_frame_copied_under_another_name(sphere):
    for folder, suffix in (("images", "png"), ("coords", "npz"), ("patterns", "png"), ("masks", "png")):
        shutil.copy(sphere / folder / f"{NAMES[0]}.{suffix}", sphere / folder / f"copy.{suffix}")

    def copy(document):
        frame = {k: v.replace(NAMES[0], "copy") if isinstance(v, str) else v for k, v in document["frames"][0].items()}
        document["frames"].append(frame)

    edit(sphere, copy)
    fault = only_fault(sphere)
    assert fault.frame == "copy"
    assert fault.problem == f"has the same image and coordinates as frame {NAMES[0]}"
    edit(sphere, lambda document: document["frames"].__setitem__(4, document["frames"][0]))
    fault = only_fault(sphere)
    assert (fault.frame, fault.problem) == (NAMES[0], "occurs more than once")


def test_doe_coordinates_beyond_the_horizon(tmp_path):
    steep = Device(PROJECTOR.w, PROJECTOR.h, 15.0, 15.0, 60.0, 45.0, model="DOE")
    root = write_sphere(tmp_path / "scan", projector=steep)
    said = [fault.problem for fault in check_scan(root) if fault.file.startswith("coords/")]
    assert ["pixels more than 90 degrees from the axis" in problem for problem in said] == [True] * len(NAMES)


def test_faults_come_in_the_order_of_the_frames_however_many_threads_there_are(sphere):
    for name in NAMES[1:]:
        edit_coords(sphere, name, lambda coords: coords * NAN)
    found = []
    before = torch.get_num_threads()
    for count in (1, 3):
        torch.set_num_threads(count)
        found.append(check_scan(sphere))
    torch.set_num_threads(before)
    assert found[0] == found[1]
    assert [fault.frame for fault in found[0]] == list(NAMES[1:])
