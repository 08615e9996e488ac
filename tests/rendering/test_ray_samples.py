"""Where rays meet the scene's sphere, where they are sampled, and where they first meet a surface."""

import pytest
import torch

from sl_nerfstudio.rendering.volume_rendering import first_crossing, sphere_interval, uniform_samples


def random_rays(count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    o = 3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    d = torch.randn(count, 3, generator=generator, dtype=torch.float64) - 0.7 * o
    return o, d / d.norm(dim=-1, keepdim=True)


@pytest.mark.parametrize("radius", [1.0, 2.5])
def test_intervals_end_on_the_sphere(radius):
    o, d = random_rays()
    near, far, meets = sphere_interval(o, d, radius)
    nearest = -(o * d).sum(-1)
    miss = (o + nearest[:, None] * d).norm(dim=-1)
    inside = o.norm(dim=-1) < radius
    assert torch.equal(meets, inside | ((miss < radius) & (nearest > 0)))
    full = meets & (miss < radius * 0.75**0.5)  # chords at least as long as the radius
    assert full.sum() > 50 and (full & inside).any() and (meets & ~full).any() and (~meets).any()
    entry, leave = (o + near[:, None] * d).norm(dim=-1), (o + far[:, None] * d).norm(dim=-1)
    assert torch.allclose(leave[full], torch.full_like(leave[full], radius))
    assert torch.allclose(entry[full & ~inside], torch.full_like(entry[full & ~inside], radius))
    assert torch.equal(near[inside], torch.zeros_like(near[inside]))
    short = ~full & (nearest > radius / 2)
    assert torch.allclose((far - near)[short], torch.full_like(near[short], radius))
    assert torch.allclose((far + near)[short] / 2, nearest[short])
    assert (near >= 0).all() and (far > near).logical_or(~meets).all()


def test_samples_are_ascending_one_in_each_stratum():
    near, far = torch.tensor([1.0, 0.0]), torch.tensor([3.0, 0.5])
    middles = uniform_samples(near, far, 4, jitter=False)
    assert torch.allclose(middles, torch.tensor([[1.25, 1.75, 2.25, 2.75], [0.0625, 0.1875, 0.3125, 0.4375]]))
    torch.manual_seed(0)
    jittered = uniform_samples(near.expand(2), far, 50, jitter=True)
    stratum = ((jittered - near[:, None]) / (far - near)[:, None] * 50).floor()
    assert ((stratum - torch.arange(50)).abs() <= 1e-4).float().mean() > 0.97  # the rest: rounding at a border
    assert (jittered.diff(dim=-1) > 0).all()


def test_the_crossing_of_a_plane_is_exact():
    o, d = random_rays(50)
    normal = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    t_true = (0.2 - o @ normal) / (d @ normal)
    near, far = torch.zeros(50, dtype=torch.float64), torch.full((50,), 20.0, dtype=torch.float64)
    t, found = first_crossing(lambda p: p @ normal - 0.2, o, d, near, far, 64)
    step = 20 / 64
    clear = (t_true > step / 2) & (t_true < 20 - step / 2)  # between the first and the last sample
    expected = clear & (d @ normal < 0)
    assert expected.sum() > 5 and torch.equal(found, expected)
    assert torch.allclose(t[found], t_true[found], atol=1e-9)


def test_the_first_of_two_balls_is_found_and_leaving_one_does_not_count():
    centres = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)

    def sdf(p: torch.Tensor) -> torch.Tensor:
        return (p[:, None] - centres).norm(dim=-1).min(-1).values - 0.4

    o = torch.tensor([[0.0, 0.0, 3.0], [0.0, 0.0, 1.0], [0.0, 0.0, 3.0], [5.0, 0.0, 3.0]], dtype=torch.float64)
    d = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], dtype=torch.float64)
    near, far = torch.zeros(4, dtype=torch.float64), torch.full((4,), 6.0, dtype=torch.float64)
    t, found = first_crossing(sdf, o, d, near, far, 61)
    assert found.tolist() == [True, True, False, False] and t.isfinite().all()
    assert torch.allclose(t[:2], torch.tensor([1.6, 1.6], dtype=torch.float64), atol=1e-9)  # out of one, into the next
