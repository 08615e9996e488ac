"""The grid's layout and its plain torch interpolation, against independent formulas."""

import itertools

import pytest
import torch

from sl_nerfstudio.field.hash_grid import PRIMES, GridLayout
from sl_nerfstudio.field.torch_backend import corner_rows, corner_weights, encode

LAYOUT = GridLayout.build(5, 16, 256, 19)


def test_the_papers_grid_has_levels_16_to_256_and_hashes_the_two_finest() -> None:
    assert LAYOUT.resolutions == (16, 32, 64, 128, 256)
    assert LAYOUT.hashed == (False, False, False, True, True)
    assert LAYOUT.sizes[3:] == (2**19, 2**19)
    assert LAYOUT.width == 40
    ends = [offset + size for offset, size in zip(LAYOUT.offsets, LAYOUT.sizes, strict=True)]
    assert LAYOUT.offsets == (0, *ends[:-1]) and ends[-1] == LAYOUT.rows
    assert all(offset % 8 == 0 for offset in LAYOUT.offsets)  # whole cache lines


@pytest.mark.parametrize("level", range(3))
def test_dense_rows_are_all_different_and_inside_their_level(level: int) -> None:
    r = LAYOUT.resolutions[level]
    cells = torch.cartesian_prod(*[torch.arange(0, r, 2)] * 3)  # every other cell: each corner once
    rows = corner_rows(LAYOUT, level, cells)
    assert len(rows.unique()) == rows.numel() == r**3
    assert int(rows.min()) >= LAYOUT.offsets[level]
    assert int(rows.max()) < LAYOUT.offsets[level] + LAYOUT.sizes[level]


def test_hashed_rows_are_those_of_the_published_hash() -> None:
    cell = torch.tensor([[3, 7, 250], [255, 0, 1]])
    rows = corner_rows(LAYOUT, 4, cell)
    for i, (x, y, z) in enumerate(cell.tolist()):
        for c, (dz, dy, dx) in enumerate(itertools.product((0, 1), repeat=3)):
            h = ((x + dx) ^ ((y + dy) * PRIMES[1]) ^ ((z + dz) * PRIMES[2])) % 2**19
            assert int(rows[i, c]) == LAYOUT.offsets[4] + h


def test_a_dense_level_reproduces_a_trilinear_function_exactly() -> None:
    layout = GridLayout.build(1, 8, 8, 19)
    axis = torch.linspace(-1, 1, 9, dtype=torch.float64)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")

    def function(x: torch.Tensor, y: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        return 0.3 + x - 2 * y + 3 * z + 0.5 * x * y - y * z + 2 * x * y * z

    table = torch.zeros(layout.rows, 1, dtype=torch.float64)
    table[: 9**3, 0] = function(x, y, z).flatten()
    p = torch.rand(200, 3, dtype=torch.float64) * 2 - 1
    p[:3] = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 0.0]])
    assert corner_weights(layout, 0, p[:3])[0].tolist() == [[0, 0, 0], [7, 7, 7], [7, 0, 4]]
    value = encode(layout, table, torch.ones(1, dtype=torch.float64), p)[:, 0]
    torch.testing.assert_close(value, function(*p.unbind(-1)), atol=1e-12, rtol=0)


def test_level_weights_scale_their_own_features_only() -> None:
    layout = GridLayout.build(3, 4, 16, 9)
    table = torch.randn(layout.rows, 2, dtype=torch.float64)
    p = torch.rand(20, 3, dtype=torch.float64) * 2 - 1
    full = encode(layout, table, torch.ones(3, dtype=torch.float64), p).view(20, 3, 2)
    faded = encode(layout, table, torch.tensor([1, 0.25, 0], dtype=torch.float64), p).view(20, 3, 2)
    torch.testing.assert_close(faded, full * torch.tensor([1, 0.25, 0], dtype=torch.float64)[:, None])


@pytest.mark.parametrize("arguments", [(0, 16, 256), (5, 16, 8), (5, 0, 8)])
def test_an_invalid_grid_is_rejected(arguments: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="invalid grid"):
        GridLayout.build(*arguments, 19)
