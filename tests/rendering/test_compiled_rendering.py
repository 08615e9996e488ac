"""The compiled loops against the torch operations that define them."""

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.field.field import CachedGrid
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.lie import exp_se3
from sl_nerfstudio.rendering.volume_rendering import (
    Rendered,
    comes_below,
    first_crossing,
    first_crossings,
    render,
    uniform_samples,
)

RAYS = 300


def unit(count: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)


def values(rendered: Rendered) -> list[Tensor]:
    return [value.detach() for value in vars(rendered).values()]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "projector",
    [
        Device(64, 48, 40.0, 44.0, 32.0, 24.0),
        Device(64, 48, 40.0, 44.0, 30.0, 25.0, k1=-0.3, k2=0.05, p1=0.01, p2=-0.02),
        Device(64, 48, 60.0, 60.0, 32.0, 24.0, model="DOE"),
    ],
)
def test_rays_are_rendered_as_with_gradients(projector, dtype):
    """Through surfaces, beside them and behind the projector, in and outside the pattern, before its lens folds."""
    torch.manual_seed(0)
    t = torch.rand(RAYS, 17, dtype=torch.float64).sort().values * 3
    sdf = torch.randn(RAYS, 17, dtype=torch.float64) * 0.3 + 0.2
    sdf[:20] = sdf[:20].abs() + 1  # these meet nothing
    T = exp_se3(torch.randn(RAYS, 6, dtype=torch.float64))
    arguments = [x.to(dtype) for x in (sdf, t, torch.randn(RAYS, 3), unit(RAYS), T)]
    pattern = torch.rand(48, 64).to(dtype)
    intrinsics = Intrinsics.of(projector, dtype)
    with torch.enable_grad():
        wanted = render(*arguments, intrinsics, pattern, 30.0)
    with torch.no_grad():
        found = render(*arguments, intrinsics, pattern, torch.tensor(30.0))
    assert 0.1 < float((wanted.lit > 0.5).float().mean()) < 0.9
    tolerance = 1e-10 if dtype == torch.float64 else 3e-4
    for one, other in zip(values(found), values(wanted), strict=True):
        assert one.dtype == dtype and one.shape == other.shape
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance)


def test_rays_come_below_a_limit_where_the_least_of_their_samples_is_below():
    torch.manual_seed(1)
    cache = CachedGrid(9)
    cache.values.copy_(torch.randn(9, 9, 9))
    o, d = torch.randn(RAYS, 3), unit(RAYS).float()  # many leave the box
    near, far = torch.rand(RAYS), 1 + torch.rand(RAYS)
    t = uniform_samples(near, far, 11, jitter=False)
    least = cache.look_up((o[:, None] + t[..., None] * d[:, None]).reshape(-1, 3)).reshape(t.shape).amin(-1)
    off = torch.where(torch.arange(RAYS) % 2 == 0, 1e-4, -1e-4)
    assert torch.equal(comes_below(cache.values, o, d, near, far, 11, least + off), off > 0)


def test_crossings_are_those_of_the_samples():
    torch.manual_seed(2)
    cache = CachedGrid(9)
    cache.values.copy_(torch.randn(9, 9, 9))
    o, d = torch.rand(RAYS, 3) - 0.5, unit(RAYS).float()
    near, far = torch.zeros(RAYS), 1 + torch.rand(RAYS)
    t, found = first_crossings(cache.values, o, d, near, far, 13)
    wanted_t, wanted = first_crossing(cache.look_up, o, d, near, far, 13)
    assert torch.equal(found, wanted) and 0.1 < float(found.float().mean()) < 0.95
    torch.testing.assert_close(t, wanted_t, rtol=1e-4, atol=1e-4)
