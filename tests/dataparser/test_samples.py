import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from sl_nerfstudio.dataparser.dataparser import PixelSamples, build_samples, held_out_pixels
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.scan import Scan, read_scan
from tests.dataparser.tiny_scan import CAMERA, TinyScan


@pytest.fixture(scope="module")
def scan(tiny_root: Path) -> Scan:
    return read_scan(tiny_root)


@pytest.fixture(scope="module")
def samples(scan: Scan) -> PixelSamples:
    return build_samples(scan)


def test_every_masked_pixel_occurs_once_with_its_own_values(scan: Scan, samples: PixelSamples) -> None:
    assert samples.records.is_contiguous() and samples.records.nbytes == 20 * len(samples)  # bytes a pixel
    assert samples.first.tolist() == np.cumsum([0, *(f.read_mask().sum() for f in scan.frames)]).tolist()
    for number, frame in enumerate(scan.frames):
        pixels = samples.at(torch.arange(int(samples.first[number]), int(samples.first[number + 1])))
        assert (pixels.frame == number).all()
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
    parts = [samples.held_out_of(i) for i in range(3)]
    assert torch.equal(torch.cat(parts), samples.held_out.nonzero()[:, 0])
    for number, part in enumerate(parts):
        assert (samples.frame[part] == number).all()


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


def test_a_table_in_a_file_says_how_it_is_read(
    scan: Scan, samples: PixelSamples, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_frames_in_order_are_all_pixels(samples: PixelSamples) -> None:
    frames = list(samples.in_order())
    assert [frame.frame.unique().tolist() for frame in frames] == [[0], [1], [2]]
    whole = samples.at(torch.arange(len(samples)))
    for field in dataclasses.fields(whole):
        together = torch.cat([getattr(frame, field.name) for frame in frames])
        assert torch.equal(together.nan_to_num(), getattr(whole, field.name).nan_to_num())
