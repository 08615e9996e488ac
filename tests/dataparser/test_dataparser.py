"""Pixels that are held out, the table of pixels, and the normalised scene."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy import ndarray
from PIL import Image
from scipy.spatial.transform import Rotation

from sl_nerfstudio.dataparser.dataparser import (
    BLOCK,
    FRACTION,
    PixelSamples,
    block_hash,
    build_samples,
    enclosing_sphere,
    held_out_pixels,
    normalisation,
    upright,
    without_lonely,
)
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.scan import Scan, read_scan
from tests.dataparser.tiny_scan import CAMERA, RADIUS, TinyScan


def test_blocks_are_chosen_uniformly_and_in_each_frame_anew() -> None:
    hashes = np.stack([block_hash(i, 800, 800) for i in range(20)])
    assert len(np.unique(hashes)) == hashes.size and np.mean(hashes < FRACTION) == pytest.approx(FRACTION, abs=0.001)
    assert np.histogram(hashes, bins=10, range=(0, 1))[0] == pytest.approx(hashes.size / 10, rel=0.05)
    assert abs(np.corrcoef(hashes.reshape(20, -1)) - np.eye(20)).max() < 0.05
    assert abs(np.corrcoef(hashes[:, 1:].ravel(), hashes[:, :-1].ravel())[0, 1]) < 0.01


def test_blocks_are_whole_and_cut_only_at_the_border() -> None:
    h, w = 5 * BLOCK + 3, 7 * BLOCK + 1
    pixels = held_out_pixels(4, h, w)
    assert pixels.shape == (h, w)
    for r in range(0, h, BLOCK):
        for c in range(0, w, BLOCK):
            block = pixels[r : r + BLOCK, c : c + BLOCK]
            assert block.all() or not block.any()


def test_the_choice_never_changes() -> None:
    # frozen: checkpoints of older runs must not be tested on pixels they were trained on
    held = np.argwhere(held_out_pixels(3, 160, 160)[::BLOCK, ::BLOCK])
    assert held.tolist() == [[3, 1], [6, 16], [7, 8], [10, 11], [18, 13]]


@pytest.fixture(scope="module")
def scan(tiny_root: Path) -> Scan:
    return read_scan(tiny_root)


@pytest.fixture(scope="module")
def samples(scan: Scan) -> PixelSamples:
    return build_samples(scan)


def test_every_masked_pixel_occurs_once_with_its_own_values(scan: Scan, samples: PixelSamples) -> None:
    assert samples.records.is_contiguous() and samples.records.nbytes == 20 * len(samples)  # bytes a pixel
    assert samples.first.tolist() == np.cumsum([0, *(f.read_mask().sum() for f in scan.frames)]).tolist()
    for number, (frame, pixels) in enumerate(zip(scan.frames, samples.in_order(), strict=True)):
        assert (pixels.frame == number).all() and len(pixels.frame) == samples.first.diff()[number]
        row, column = pixels.row.numpy(), pixels.column.numpy()
        seen = np.zeros((frame.camera.h, frame.camera.w), int)
        np.add.at(seen, (row, column), 1)
        np.testing.assert_array_equal(seen, frame.read_mask())
        np.testing.assert_array_equal(pixels.coords.numpy(), frame.read_coords()[row, column])
        np.testing.assert_allclose(pixels.pattern.numpy(), frame.read_pattern()[row, column], rtol=2**-11)
        np.testing.assert_array_equal(pixels.uv.numpy(), np.stack([column, row], -1) + 0.5)
        np.testing.assert_array_equal(pixels.decoded.numpy(), ~np.isnan(frame.read_coords()[row, column]).any(-1))


def test_the_decoded_share_is_that_of_all_pixels(samples: PixelSamples, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sl_nerfstudio.dataparser.dataparser._AT_ONCE", 7)
    assert 0 < samples.decoded_share < 1
    assert samples.decoded_share == pytest.approx(float(samples.coords[:, 0].isfinite().double().mean()), rel=1e-12)


def test_training_draws_never_touch_held_out_pixels_and_reach_all_others(samples: PixelSamples) -> None:
    generator = torch.Generator().manual_seed(0)
    count = 40 * len(samples)
    times = torch.bincount(samples.draw(count, generator), minlength=len(samples))
    assert times[samples.held_out].sum() == 0
    trained = times[~samples.held_out].double()
    assert times.sum() == count
    # uniform: a chi-square of n cells lies within 5 standard deviations of n
    n = len(trained)
    chi2 = ((trained - count / n) ** 2 / (count / n)).sum()
    assert abs(chi2 - n) < 5 * (2 * n) ** 0.5


def test_held_out_draws_and_held_out_of_a_frame(samples: PixelSamples) -> None:
    drawn = samples.draw(5000, torch.Generator().manual_seed(1), held_out=True)
    assert samples.held_out[drawn].all()
    assert set(drawn.tolist()) == set(samples.held_out.nonzero()[:, 0].tolist())
    whole = samples.at(samples.held_out_index)
    for number in range(3):
        part, own = samples.held_out_of(number, 10**6), whole.frame == number
        assert torch.equal(part.row, whole.row[own]) and torch.equal(part.column, whole.column[own])
        assert (part.frame == number).all() and len(samples.held_out_of(number, 5).row) == min(len(part.row), 5)


def test_without_mask_files_the_decoded_pixels_count(tmp_path: Path) -> None:
    scan = read_scan(TinyScan().write(tmp_path / "scan"))
    bare = dataclasses.replace(scan, frames=tuple(dataclasses.replace(f, mask_path=None) for f in scan.frames))
    samples = build_samples(bare)
    assert samples.coords.isfinite().all()
    assert len(samples) == sum(np.isfinite(f.read_coords()).all(-1).sum() for f in scan.frames)


def test_a_scan_too_small_for_the_hash_still_holds_out_one_block(tmp_path: Path) -> None:
    scan = read_scan(TinyScan(frames=2).write(tmp_path / "scan"))
    for number, frame in enumerate(scan.frames):
        assert frame.mask_path is not None
        mask = np.array(Image.open(frame.mask_path))
        mask[held_out_pixels(number, *mask.shape)] = 0
        Image.fromarray(mask).save(frame.mask_path)
    samples = build_samples(scan)
    held = samples.at(samples.held_out.nonzero()[:, 0])
    assert 0 < len(held.row) <= 64
    assert len(held.frame.unique()) == len((held.row // 8).unique()) == len((held.column // 8).unique()) == 1


def test_empty_masks_are_rejected(tmp_path: Path) -> None:
    scan = read_scan(TinyScan().write(tmp_path / "scan"))
    for frame in scan.frames:
        assert frame.mask_path is not None
        Image.fromarray(np.zeros((CAMERA.h, CAMERA.w), np.uint8)).save(frame.mask_path)
    with pytest.raises(UserError, match=r"only 0 masked pixels in 3 frames.*Check masks/"):
        build_samples(scan)


def test_a_table_in_a_file_is_the_same(scan: Scan, samples: PixelSamples, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sl_nerfstudio.dataparser.dataparser.largest_in_memory", lambda: 0)
    mapped = build_samples(scan, show_progress=False)
    assert mapped.in_file and not samples.in_file
    for name in ("records", "first", "held_out_index"):
        assert torch.equal(getattr(mapped, name), getattr(samples, name))
    index = samples.draw(50, torch.Generator().manual_seed(2))
    assert torch.equal(index, mapped.draw(50, torch.Generator().manual_seed(2)))
    assert torch.equal(mapped.at(index).pattern, samples.at(index).pattern)


def test_a_table_in_a_file_says_how_it_is_read(scan, samples, monkeypatch):
    """Else a system that reads megabytes ahead does so for each of a thousand pixels a step."""
    said: list[tuple[str, int, int]] = []
    for name in ("read_at_random", "read_in_order"):
        monkeypatch.setattr(
            f"sl_nerfstudio.dataparser.dataparser.{name}", lambda *at, name=name: said.append((name, *at))
        )
    samples.draw(5)
    list(samples.in_order())
    assert said == []  # in memory
    monkeypatch.setattr("sl_nerfstudio.dataparser.dataparser.largest_in_memory", lambda: 0)
    mapped = build_samples(scan, show_progress=False)
    where = mapped.records.data_ptr(), mapped.records.nbytes
    mapped.draw(5)
    assert said.pop() == ("read_at_random", *where)
    for _ in mapped.in_order():
        assert said == [("read_in_order", *where)]
    assert 0 < mapped.decoded_share < 1 and said == 2 * [("read_in_order", *where)]


def directions(count: int, seed: int) -> ndarray:
    """Unit vectors, uniform over the sphere."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def normalise(root: Path) -> tuple[Scan, Similarity]:
    scan = read_scan(root)
    return scan, normalisation(scan, build_samples(scan))


def test_the_object_is_inside_the_sphere_of_radius_08(tiny_root: Path) -> None:
    _, S = normalise(tiny_root)
    sphere = RADIUS * directions(2000, 0)
    r = np.linalg.norm(S.points(sphere), axis=1)
    assert 0.6 < r.max() < 1.0  # only the lit half was seen, so the centre is off by part of the radius
    assert S.scale == pytest.approx(0.8 / RADIUS, rel=0.15)


@pytest.mark.parametrize(
    "units, S_world_mm",
    [
        ("m", Similarity(1e-3, np.eye(3), np.zeros(3))),
        ("um", Similarity(1e3, Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix(), np.array([5e4, -2e5, 1e5]))),
        ("mm", Similarity(1.0, Rotation.from_rotvec([2.0, 1.0, -0.5]).as_matrix(), np.array([1e3, 2e3, -3e3]))),
    ],
)
def test_unit_and_world_frame_do_not_matter(tmp_path, tiny_root, units, S_world_mm):
    reference, S_reference = normalise(tiny_root)
    scan, S = normalise(TinyScan(units=units, S_world_mm=S_world_mm).write(tmp_path / "scan"))
    composed = S @ S_world_mm
    np.testing.assert_allclose(composed.matrix(), S_reference.matrix(), rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        S.poses(scan.poses.T_world_projector), S_reference.poses(reference.poses.T_world_projector), rtol=0, atol=1e-9
    )


def test_the_viewers_up_is_the_cameras_up(tiny_root: Path) -> None:
    # the cameras are around the y axis and look down by 0.3 rad
    scan, S = normalise(tiny_root)
    ups = scan.poses.T_world_camera[:, :3, 1]
    np.testing.assert_allclose(S.R @ ups.mean(0) / np.linalg.norm(ups.mean(0)), [0, 0, 1], atol=1e-12)
    assert (S.R @ [0.0, 1.0, 0.0])[2] > 0.95
    right = S.poses(scan.poses.T_world_camera)[0, :3, 0]
    assert right[0] > 0.9 and abs(right[1]) < 1e-12


@given(arrays(np.float64, (4, 3), elements=st.floats(-3, 3)), st.integers(1, 4))
def test_upright_is_a_rotation_and_turns_with_the_world(vectors: ndarray, count: int) -> None:
    R = Rotation.from_rotvec(vectors).as_matrix()
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = R[:count]
    axes = upright(T)
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    turned = T.copy()
    turned[:, :3, :3] = turn @ T[:, :3, :3]
    assume(abs(np.linalg.norm(T[:, :3, 1].mean(0)) - 0.3) > 1e-9)
    np.testing.assert_allclose(upright(turned) @ turn, axes, atol=1e-9)
    T[-1, :3, :3] = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]  # its right is what is up for others
    for some in (axes, upright(T), upright(T[::-1])):
        np.testing.assert_allclose(some @ some.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(some) > 0
    opposite = np.stack([np.eye(4), np.diag([-1.0, -1.0, 1.0, 1.0])])  # without a common up, that of the first counts
    np.testing.assert_allclose(upright(opposite), [[1, 0, 0], [0, 0, -1], [0, 1, 0]])


def test_one_wrong_pixel_in_ten_changes_little(tmp_path: Path, tiny_root: Path) -> None:
    _, clean = normalise(tiny_root)
    _, noisy = normalise(TinyScan(wrong=0.1).write(tmp_path / "scan"))
    assert noisy.scale == pytest.approx(clean.scale, rel=0.1)
    moved = noisy.points(clean.inverse().points(np.zeros(3)))
    assert np.linalg.norm(moved) < 0.1


def test_enclosing_sphere_of_an_asymmetric_cloud() -> None:
    # a unit sphere and, with most of the points, a unit disc at z = 0.9: the smallest ball around both has its
    # centre at z = c with c + 1 = sqrt(1 + (0.9 - c)^2)
    disc = directions(8000, 2) * [1, 1, 0] + [0, 0, 0.9]
    c = 0.81 / 3.8
    centre, radius = enclosing_sphere(3 * np.concatenate([directions(4000, 1), disc]) + [10, 20, 30])
    np.testing.assert_allclose(centre, [10, 20, 30 + 3 * c], atol=0.05)
    assert 0.97 < radius / (3 * (1 + c)) < 1.01


def test_isolated_points_are_dropped_and_no_others() -> None:
    rng = np.random.default_rng(0)
    plane = np.concatenate([rng.random((3000, 2)), np.zeros((3000, 1))], 1)
    isolated = rng.random((60, 3)) * 20 + [0, 0, 1]
    kept = without_lonely(np.concatenate([plane, isolated]))
    assert (kept[:, 2] == 0).all()
    assert len(kept) > 2980


def test_poses_that_look_away_are_rejected_with_the_likely_cause(scan: Scan, samples: PixelSamples) -> None:
    turn = np.diag([1.0, -1, -1, 1])
    frames = tuple(dataclasses.replace(f, T_world_camera=f.T_world_camera @ turn) for f in scan.frames)
    with pytest.raises(UserError, match=r"only \d+ of \d+ pixels .*OpenCV axes.*sl-process"):
        normalisation(dataclasses.replace(scan, frames=frames), samples)
