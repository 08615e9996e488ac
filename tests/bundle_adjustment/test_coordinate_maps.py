"""Look-ups between pixels: exact where a map is a plane, invalid where it is discontinuous, undecoded or missing."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.bundle_adjustment.coordinate_maps import (
    CoordinateMaps,
    WindowMemory,
    is_known,
    known_pixels,
    place_of,
    words_of,
)
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.triangulation import pixel_centres

SIZES = ((30, 20), (17, 25))
SLOPES = torch.tensor([[[2.0, -0.5], [0.25, 1.5]], [[-1.0, 0.125], [0.5, 3.0]]], dtype=torch.float64)
CONSTANTS = torch.tensor([[100.0, 50.0], [300.0, 7.0]], dtype=torch.float64)
NAN = float("nan")


def plane_images() -> list[torch.Tensor]:
    """Values that float32 holds exactly, another plane and size for each frame."""
    out = []
    for (w, h), J, c in zip(SIZES, SLOPES, CONSTANTS, strict=True):
        uv = pixel_centres(Device(w, h, 1.0, 1.0, 0.0, 0.0), torch.float64)
        out.append((uv @ J.T + c).float())
    return out


def positions(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    frame = torch.randint(2, (300,), generator=generator)
    size = torch.tensor(SIZES, dtype=torch.float64)[frame]
    return frame, torch.rand(300, 2, generator=generator, dtype=torch.float64) * size


def window_pixels(frame: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """Pixels of a 7 x 7 window that are inside the image."""
    size, at = torch.tensor(SIZES)[frame], uv.long()
    return ((at + 4).minimum(size) - (at - 3).clamp_min(0)).prod(-1)


@pytest.mark.parametrize("bend", [0.0, 1.0])
def test_planes_and_paraboloids_are_reproduced_exactly_everywhere_with_their_slopes(bend):
    curvature = bend * torch.tensor([[0.25, -0.125, 0.0625], [-0.5, 0.25, 0.125]], dtype=torch.float64)  # xx, xy, yy

    def curved(uv: torch.Tensor) -> torch.Tensor:
        x, y = uv[..., :1], uv[..., 1:]
        return curvature[:, 0] * x * x + curvature[:, 1] * x * y + curvature[:, 2] * y * y

    images = plane_images()
    for image, (w, h) in zip(images, SIZES, strict=True):
        image += curved(pixel_centres(Device(w, h, 1.0, 1.0, 0.0, 0.0), torch.float64)).float()
    frame, uv = positions()
    found = CoordinateMaps.of(images).look_up(frame, uv)
    expected = (SLOPES[frame] @ uv[..., None]).squeeze(-1) + CONSTANTS[frame] + curved(uv)
    x, y = uv[:, 0], uv[:, 1]
    slopes = torch.stack([torch.stack([2 * a * x + b * y, b * x + 2 * c * y], -1) for a, b, c in curvature], 1)
    enough = window_pixels(frame, uv) >= 24
    assert torch.equal(found.valid, enough) and 0 < int(enough.sum()) < len(uv)
    assert torch.allclose(found.uv_projector[enough], expected[enough], rtol=0, atol=1e-8)
    assert torch.allclose(found.jacobian[enough], (SLOPES[frame] + slopes)[enough], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "uv", [(-1e-9, 5.0), (5.0, -0.1), (30.0, 5.0), (5.0, 20.0), (NAN, 5.0), (float("inf"), 5.0), (1e300, -1e300)]
)
def test_outside_the_image_nothing_is_valid(uv):
    maps, frame = CoordinateMaps.of(plane_images()), torch.tensor([0])
    at = torch.tensor([uv], dtype=torch.float64)
    assert not maps.look_up(frame, at).valid.any()


def test_discontinuous_undecoded_and_narrow_windows_are_invalid():
    images = plane_images()
    images[0][:, 15:] += 40  # a depth edge between columns 14 and 15
    images[1][5:, :] = NAN
    images[1][16:20, 3:9] = images[1].new_tensor([1.0, 2.0])  # twenty-four pixels: just enough
    maps = CoordinateMaps.of(images)

    def valid(frame: int, u: float, v: float) -> bool:
        return bool(maps.look_up(torch.tensor([frame]), torch.tensor([[u, v]], dtype=torch.float64)).valid[0])

    across = [valid(0, u + 0.5, 10.5) for u in range(10, 20)]
    assert across == [True, True, False, False, False, False, False, False, True, True]
    assert valid(1, 8.5, 1.5) and not valid(1, 8.5, 6.5) and not valid(1, 8.5, 12.5)
    assert valid(1, 6.5, 17.5)
    images[1][17, 7] = NAN
    maps = CoordinateMaps.of(images)
    assert not valid(1, 6.5, 17.5)
    rows = torch.full((9, 40, 2), NAN)  # two of them, on a conic: curvature across cannot be told from a slope
    rows[3:5] = 1.0
    maps = CoordinateMaps.of([rows])
    assert not valid(0, 20.0, 4.0)


def test_drawn_pixels_are_decoded_spread_out_and_the_same_for_one_seed():
    images = plane_images()
    images[0][:, :10] = NAN
    maps = CoordinateMaps.of(images)
    both = maps.draw(torch.arange(2), 40, torch.Generator().manual_seed(3))
    again = maps.draw(torch.tensor([1, 0]), 40, torch.Generator().manual_seed(3))
    uv = both[1][both[0] == 0]
    assert torch.equal(uv, again[1][again[0] == 0])
    assert not torch.equal(uv, maps.draw(torch.tensor([0]), 40, torch.Generator().manual_seed(4))[1])
    assert len(both[0]) == 80 and both[1][both[0] == 1].amax() > 17  # the second frame is higher than wide
    assert len(uv) == 40 and len(torch.unique(uv, dim=0)) == 40
    assert torch.equal(uv.frac(), torch.full_like(uv, 0.5)) and (uv[:, 0] > 10).all()
    squares = torch.unique((uv / 3).long(), dim=0)  # 400 decoded pixels for 40: one of each 3 x 3
    assert len(squares) == 40
    assert len(maps.draw(torch.tensor([0]), 1000, torch.Generator())[0]) == 400
    images[0][:] = NAN
    assert CoordinateMaps.of(images).draw(torch.tensor([0]), 40, torch.Generator())[1].shape == (0, 2)


def test_maps_that_are_noisy_everywhere_are_used_and_their_discontinuities_still_found():
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:80, :80]
    image = np.stack([2.0 * x + 0.01 * x * y, 2.0 * y], -1) + rng.normal(0, 2.0, (80, 80, 2))
    image[:, 40:] += 60  # a discontinuity
    maps = CoordinateMaps.of([torch.from_numpy(image)])
    uv = torch.from_numpy(rng.uniform(5, 75, (500, 2)))
    valid = maps.look_up(torch.zeros(500, dtype=torch.int64), uv).valid
    discontinuous = (uv[:, 0] - 40).abs() < 2
    assert valid[(uv[:, 0] - 40).abs() > 5].float().mean() > 0.99
    assert not valid[discontinuous].any()


def test_slopes_of_wide_windows_have_the_smaller_errors_of_more_pixels():
    """With n x n pixels of equal noise, the variance of a slope is 12 / (n^2 (n^2 - 1)) of theirs."""
    generator = torch.Generator().manual_seed(0)
    maps = CoordinateMaps.of([0.3 * torch.randn(200, 200, 2, generator=generator)])
    uv = pixel_centres(Device(150, 150, 1.0, 1.0, 0.0, 0.0), torch.float64).reshape(-1, 2) + 25
    frame = torch.zeros(len(uv), dtype=torch.long)
    for half_window in (3, 12):
        slopes = maps.with_windows(half_window).look_up(frame, uv).jacobian
        n2 = (2 * half_window + 1) ** 2
        assert float(slopes.square().mean().sqrt()) == pytest.approx(0.3 * (12 / n2 / (n2 - 1)) ** 0.5, rel=0.1)


def test_distances_from_the_border_count_steps_to_the_nearest_pixel_without_a_coordinate():
    """Against all pixels compared with all, outside of the image included."""
    generator, images = torch.Generator().manual_seed(3), plane_images()
    for image in images:
        image[torch.rand(image.shape[:2], generator=generator) < 0.03] = NAN
    maps = CoordinateMaps.of(images)
    for frame, image in enumerate(images):
        known = torch.isfinite(torch.nn.functional.pad(image[..., 0], (1, 1, 1, 1), value=NAN))
        holes = torch.nonzero(~known) - 1
        cells = torch.nonzero(torch.ones(image.shape[:2]))
        steps = (cells[:, None] - holes).abs().amax(-1).amin(-1)
        found = maps.border_distance(torch.full((len(cells),), frame), cells.flip(1) + 0.5)
        assert torch.equal(found, steps.double())
        assert steps.max() > 3
    maps = CoordinateMaps.of(plane_images())
    at = torch.tensor([[-0.1, 5.0], [30.0, 5.0], [5.0, 20.0], [NAN, 5.0], [29.9, 5.0], [15.0, 10.0]]).double()
    assert maps.border_distance(torch.zeros(6, dtype=torch.int64), at).tolist() == [0, 0, 0, 0, 1, 10]


@given(st.lists(st.tuples(st.integers(1, 4), st.integers(1, 150)), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
def test_every_pixel_is_found_among_the_decoded_ones(sizes, seed):
    """Sizes beside the borders of words; images with nothing, something and everything decoded."""
    rng, images = np.random.default_rng(seed), []
    for size in sizes:
        images.append(rng.random((*size, 2)).astype(np.float32))
        images[-1][rng.random(size) < rng.choice([0, 0.5, 1])] = NAN
    maps = CoordinateMaps.of([torch.from_numpy(image) for image in images])
    values, (words, first_words, _, _) = maps.arrays
    for frame, image in enumerate(images):
        assert np.array_equal(maps.image(frame).numpy(), image, equal_nan=True)
        count = known_pixels(words, first_words[frame], image.shape[1], image.shape[0])
        assert count == np.isfinite(image[..., 0]).sum()
        for row, column in np.ndindex(*image.shape[:2]):
            row_word = first_words[frame] + row * words_of(image.shape[1])
            place, known = place_of(words, row_word, column), np.isfinite(image[row, column, 0])
            assert is_known(words, row_word, column) == (place >= 0) == known
            assert place < 0 or (values[place] == image[row, column]).all()
        rows, columns = np.indices(image.shape[:2])
        uv = np.stack([columns, rows], -1).reshape(-1, 2) + rng.random((rows.size, 2))
        at = torch.full((len(uv),), frame)
        assert np.array_equal(maps.decoded(at, torch.from_numpy(uv)).numpy(), np.isfinite(image[..., 0]).ravel())
    assert len(values) == sum(np.isfinite(image[..., 0]).sum() for image in images)
    h, w = images[0].shape[:2]
    outside = torch.tensor([[-0.1, 0.5], [0.5, -0.1], [w, 0.5], [0.5, h], [NAN, 0.5]], dtype=torch.float64)
    assert not maps.decoded(torch.zeros(5, dtype=torch.int64), outside).any()


def test_images_are_visited_one_after_the_other():
    """Else a look-up would read images that do not fit into memory again and again."""
    frame, uv = positions()
    memory = WindowMemory.empty(frame.numpy())
    assert sorted(memory.order.tolist()) == list(range(len(frame)))
    assert (np.diff(frame.numpy()[memory.order]) >= 0).all()
    maps = CoordinateMaps.of(plane_images())
    once, alone = maps.look_up(frame, uv), [maps.look_up(frame[k : k + 1], uv[k : k + 1]) for k in range(len(frame))]
    assert torch.equal(once.uv_projector, torch.cat([a.uv_projector for a in alone]))
    assert torch.equal(once.valid, torch.cat([a.valid for a in alone]))
