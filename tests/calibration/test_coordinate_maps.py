"""Look-ups between pixels: exact where a map is plane, refused where it is torn, undecoded or not there."""

import pytest
import torch

from sl_nerfstudio.calibration.coordinate_maps import CoordinateMaps
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.rays import pixel_centres

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


def test_a_plane_is_met_exactly_everywhere_with_its_slope():
    frame, uv = positions()
    found = CoordinateMaps.of(plane_images()).look_up(frame, uv)
    expected = (SLOPES[frame] @ uv[..., None]).squeeze(-1) + CONSTANTS[frame]
    size = torch.tensor(SIZES, dtype=torch.float64)[frame]
    corner = ((uv < 1) | (uv > size - 1)).all(-1)  # nine pixels: too few; the border's fifteen are enough
    assert torch.equal(found.valid, ~corner)
    assert torch.allclose(found.uv_projector[~corner], expected[~corner], rtol=0, atol=1e-9)
    assert torch.allclose(found.jacobian[~corner], SLOPES[frame][~corner], rtol=0, atol=1e-9)


def test_undecoded_pixels_change_nothing_as_long_as_enough_remain():
    images = plane_images()
    images[0][::2, ::2] = NAN
    images[0][7, 9, 1] = NAN  # one component missing: not decoded
    frame, uv = positions(1)
    found = CoordinateMaps.of(images).look_up(frame, uv)
    whole = CoordinateMaps.of(plane_images()).look_up(frame, uv)
    size = torch.tensor(SIZES, dtype=torch.float64)[frame]
    assert found.valid[((uv > 2) & (uv < size - 2)).all(-1)].all()
    ok = found.valid
    assert torch.allclose(found.uv_projector[ok], whole.uv_projector[ok], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "uv", [(-1e-9, 5.0), (5.0, -0.1), (30.0, 5.0), (5.0, 20.0), (NAN, 5.0), (float("inf"), 5.0), (1e300, -1e300)]
)
def test_outside_the_image_nothing_is_valid(uv):
    maps, frame = CoordinateMaps.of(plane_images()), torch.tensor([0])
    at = torch.tensor([uv], dtype=torch.float64)
    assert not maps.look_up(frame, at).valid.any()
    assert maps.decoded_at(frame, at).isnan().all()


def test_torn_undecoded_and_linelike_windows_are_refused():
    images = plane_images()
    images[0][:, 15:] += 40  # a depth edge between columns 14 and 15
    images[1][5:, :] = NAN
    images[1][12, 3:12] = torch.tensor([1.0, 2.0])  # a single row gives no slope across it
    images[1][20:22, 3:8] = images[1].new_tensor([1.0, 2.0])  # ten pixels, two rows: just enough
    maps = CoordinateMaps.of(images)

    def valid(frame: int, u: float, v: float) -> bool:
        return bool(maps.look_up(torch.tensor([frame]), torch.tensor([[u, v]], dtype=torch.float64)).valid[0])

    assert [valid(0, u, 10.5) for u in (12.5, 13.5, 14.5, 15.5, 16.5, 17.5)] == [True, False, False, False, False, True]
    assert valid(1, 8.5, 5.5) and not valid(1, 8.5, 6.5) and not valid(1, 8.5, 12.5)
    assert valid(1, 5.5, 20.5)
    images[1][21, 7] = NAN
    maps = CoordinateMaps.of(images)
    assert not valid(1, 5.5, 20.5)


def test_the_pixel_under_a_position():
    images = plane_images()
    images[1][3, 4] = NAN
    maps = CoordinateMaps.of(images)
    at = torch.tensor([[0.0, 0.0], [16.999, 24.999], [4.2, 3.9], [5.0, 3.9]], dtype=torch.float64)
    found = maps.decoded_at(torch.ones(4, dtype=torch.long), at)
    assert torch.equal(found[0], images[1][0, 0].double()) and torch.equal(found[1], images[1][24, 16].double())
    assert found[2].isnan().all() and torch.equal(found[3], images[1][3, 5].double())


def test_drawn_pixels_are_decoded_spread_out_and_the_same_for_one_seed():
    images = plane_images()
    images[0][:, :10] = NAN
    maps = CoordinateMaps.of(images)
    uv = maps.draw(0, 40, torch.Generator().manual_seed(3))
    assert torch.equal(uv, maps.draw(0, 40, torch.Generator().manual_seed(3)))
    assert len(uv) == 40 and len(torch.unique(uv, dim=0)) == 40
    assert torch.equal(uv.frac(), torch.full_like(uv, 0.5)) and (uv[:, 0] > 10).all()
    squares = torch.unique((uv / 3).long(), dim=0)  # 400 decoded pixels for 40: one of each 3 x 3
    assert len(squares) == 40
    few = maps.draw(0, 1000, torch.Generator())
    assert len(few) == 400
    images[0][:] = NAN
    assert maps.__class__.of(images).draw(0, 40, torch.Generator()).shape == (0, 2)
