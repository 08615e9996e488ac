"""Coordinates that are not those of their image are named; pictures without the pattern."""

import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from sphere_scan import CAMERA, NAMES, edit, edit_coords, only_fault, pattern_image, write_sphere

from sl_nerfstudio.scan import check_scan, read_scan
from sl_nerfstudio.scan.check_geometry import OtherClouds
from sl_nerfstudio.scan.check_images import match_image
from sl_nerfstudio.scan.images import encode_png

NAME = NAMES[1]
PATTERN = pattern_image().astype(np.float32) / 255


def noise(coords):
    values = np.random.default_rng(0).uniform(0, 90, coords.shape)
    return np.where(np.isfinite(coords), values, np.nan).astype(np.float32)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: np.roll(c, (2, -3), (0, 1)), "is shifted against the image: moved by 3 pixels to the right and -2"),
        (lambda c: np.roll(c, 1, 1), "is shifted against the image: moved by -1 pixels to the right and 0 down"),
        (lambda c: c[::-1, ::-1], "does not fit the image"),
        (noise, "is noise"),
    ],
)
def test_coordinates_of_another_place_are_named(sphere, change, words):
    edit_coords(sphere, NAME, change)
    fault = only_fault(sphere)
    assert fault.frame == NAME and words in fault.problem


@pytest.mark.parametrize("without_pattern_images", [False, True])
def test_coordinates_of_another_frame_are_named_with_that_frame(sphere, without_pattern_images):
    if without_pattern_images:
        edit(sphere, lambda document: [frame.pop("sl_pattern_path") for frame in document["frames"]])
    shutil.copy(sphere / "coords" / f"{NAMES[2]}.npz", sphere / "coords" / f"{NAME}.npz")
    fault = only_fault(sphere)
    assert (fault.frame, fault.field) == (NAME, "sl_coords_path")
    assert f"fits the image of frame {NAMES[2]} instead" in fault.problem


def test_an_image_of_another_frame_is_named(sphere):
    shutil.copy(sphere / "images" / f"{NAMES[3]}.png", sphere / "images" / f"{NAME}.png")
    fault = only_fault(sphere)
    assert fault.frame == NAME and "does not fit the image" in fault.problem


def test_two_frames_whose_coordinates_were_exchanged(tmp_path):
    root = write_sphere(tmp_path / "scan", frames=2)
    one, two = (root / "coords" / f"{name}.npz" for name in NAMES[:2])
    content = one.read_bytes()
    one.write_bytes(two.read_bytes())
    two.write_bytes(content)
    assert [fault.frame for fault in check_scan(root)] == list(NAMES[:2])


fields = st.integers(0, 2**31 - 1)


def smooth_coords(seed):
    """Smooth coordinates over the whole pattern, (60, 80, 2)."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(60, 80, 2)), (9, 9, 0))
    size = (PATTERN.shape[1], PATTERN.shape[0])
    return ((field - field.min((0, 1))) / np.ptp(field, (0, 1)) * size).astype(np.float32)


def shown_at(coords):
    """The pattern at the coordinates, by nearest neighbour."""
    x, y = np.clip(coords.astype(int), 0, (PATTERN.shape[1] - 1, PATTERN.shape[0] - 1)).transpose(2, 0, 1)
    return PATTERN[y, x]


@settings(max_examples=25)
@given(fields, st.integers(-20, 20), st.integers(-20, 20))
def test_any_move_is_measured(seed, x, y):
    coords = smooth_coords(seed)
    everywhere = np.ones(coords.shape[:2], dtype=bool)
    moved = np.roll(coords, (-y, -x), (0, 1))
    match = match_image(moved, everywhere, PATTERN, shown_at(coords), everywhere)
    assert match is not None and (match.x, match.y) == (x, y)
    assert match.moved > 0.9


@settings(max_examples=25)
@given(fields, st.floats(0, 0.5))
def test_right_coordinates_need_no_move(seed, missing):
    coords = smooth_coords(seed)
    where = np.random.default_rng(seed).random(coords.shape[:2]) >= missing
    match = match_image(coords, where, PATTERN, 0.3 + 0.2 * shown_at(coords), np.ones(where.shape, dtype=bool))
    assert match is not None and (match.x, match.y) == (0, 0)
    assert match.moved == match.correlation > max(0.9, match.interpreted)


@settings(max_examples=25)
@given(fields, st.integers(2, 9))
def test_distances_to_other_clouds_are_exact(seed, count):
    """Against a search through all points."""
    rng = np.random.default_rng(seed)
    clouds = [rng.normal(size=(int(rng.integers(0, 30)), 3)) for _ in range(count)]
    others = OtherClouds(clouds)
    for index, cloud in enumerate(clouds):
        rest = np.concatenate([c for k, c in enumerate(clouds) if k != index])
        if len(cloud) < 10 or len(rest) < 10:
            assert others.distance(cloud, index) == np.inf
        else:
            expected = np.median(np.linalg.norm(cloud[:, None] - rest[None], axis=-1).min(1))
            assert others.distance(cloud, index) == pytest.approx(expected)


def gradient():
    y, x = np.mgrid[: CAMERA.h, : CAMERA.w]
    return np.stack([x, y, x + y], -1).astype(np.uint8)


def put(root, picture, path="color/one.png"):
    (root / path).parent.mkdir(exist_ok=True)
    (root / path).write_bytes(encode_png(picture))
    edit(root, lambda document: document["frames"][1].update(sl_color_path=path))


def test_a_picture_is_read_and_other_frames_have_none(sphere):
    put(sphere, gradient())
    assert check_scan(sphere) == []
    scan = read_scan(sphere)
    assert [frame.color_path is None for frame in scan.frames] == [True, False, True, True]
    assert np.array_equal(scan.frames[1].read_color(), gradient()) and scan.frames[0].read_color() is None


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
