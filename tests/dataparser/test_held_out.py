import numpy as np
import pytest

from sl_nerfstudio.dataparser.dataparser import BLOCK, FRACTION, block_hash, held_out_pixels


def test_share_of_held_out_pixels_over_many_frames() -> None:
    share = np.mean([held_out_pixels(i, 400, 400).mean() for i in range(60)])
    # 60 frames of 2500 blocks: one standard deviation is 0.00036
    assert share == pytest.approx(FRACTION, abs=4 * 0.00036)


def test_blocks_are_whole_and_cut_only_at_the_border() -> None:
    h, w = 5 * BLOCK + 3, 7 * BLOCK + 1
    pixels = held_out_pixels(4, h, w)
    assert pixels.shape == (h, w)
    for r in range(0, h, BLOCK):
        for c in range(0, w, BLOCK):
            block = pixels[r : r + BLOCK, c : c + BLOCK]
            assert block.all() or not block.any()


def test_frames_hold_out_different_blocks_and_hashes_are_uniform() -> None:
    hashes = np.stack([block_hash(i, 800, 800) for i in range(20)])
    assert len(np.unique(hashes)) == hashes.size
    assert np.histogram(hashes, bins=10, range=(0, 1))[0] == pytest.approx(hashes.size / 10, rel=0.05)
    correlation = np.corrcoef(hashes.reshape(20, -1)) - np.eye(20)
    assert abs(correlation).max() < 0.05
    assert abs(np.corrcoef(hashes[:, 1:].ravel(), hashes[:, :-1].ravel())[0, 1]) < 0.01


def test_the_choice_never_changes() -> None:
    # frozen: checkpoints of older runs must not be tested on pixels they were trained on
    held = np.argwhere(held_out_pixels(3, 160, 160)[::BLOCK, ::BLOCK])
    assert held.tolist() == [[3, 1], [6, 16], [7, 8], [10, 11], [18, 13]]
