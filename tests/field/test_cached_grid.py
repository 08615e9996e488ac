"""A grid of a field's values: a plane is reproduced exactly, and only values near the surface are updated."""

import torch
from torch import Tensor, nn

from sl_nerfstudio.field.field import CachedGrid, SDFField


class PlaneField(SDFField):
    """An analytic field, linear in the point, that counts the points at which it is evaluated."""

    def __init__(self, normal: tuple[float, float, float], offset: float) -> None:
        nn.Module.__init__(self)
        self.normal, self.offset, self.evaluated = torch.tensor(normal), offset, 0

    def sdf(self, p: Tensor) -> Tensor:
        self.evaluated += len(p)
        return p @ self.normal - self.offset


NORMAL = (0.48, 0.6, 0.64)


def points(half: float = 1.0) -> Tensor:
    return (torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1) * half


def test_a_plane_is_reproduced_exactly_in_the_whole_box():
    cache, field = CachedGrid(12), PlaneField(NORMAL, 0.1)
    cache.refresh(field)
    p = torch.cat([points(), torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0], [0.0, 0.0, 0.0]])])
    assert torch.allclose(cache.look_up(p), p @ field.normal - 0.1, atol=2e-6)  # each axis has its own slope
    assert torch.allclose(
        cache.look_up(3 * p), (3 * p).clamp(-1, 1) @ field.normal - 0.1, atol=2e-6
    )  # as at the border
    assert field.evaluated == 12**3 and cache.cell == 2 / 11


def test_later_only_the_neighbourhood_of_the_surface_is_updated():
    cache, before = CachedGrid(20), PlaneField((0.0, 0.0, 1.0), 0.0)
    cache.refresh(before)
    after = PlaneField((0.0, 0.0, 1.0), 0.05)
    cache.refresh(after)
    z = torch.linspace(-1, 1, 20)
    near = z.abs() < 3 * cache.cell
    assert torch.allclose(cache.values[near][:, 0, 0], z[near] - 0.05, atol=1e-6)
    assert torch.allclose(cache.values[~near][:, 0, 0], z[~near], atol=1e-6)
    assert after.evaluated == int(near.sum()) * 400


def test_it_is_saved_in_a_checkpoint():
    """A resumed run continues with the same values, and updates only those that an uninterrupted one would."""
    cache, field = CachedGrid(20), PlaneField((0.0, 0.0, 1.0), 0.0)
    cache.refresh(field)
    resumed = CachedGrid(20)
    resumed.load_state_dict(cache.state_dict())
    assert torch.equal(resumed.values, cache.values)
    for one in (cache, resumed):
        one.refresh(PlaneField((0.0, 0.0, 1.0), 0.05))
    assert torch.equal(resumed.values, cache.values)
