"""Where rays are sampled, and volume rendering: against its formula, ray casting, and in compiled loops."""

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from sl_nerfstudio.field.field import CachedGrid
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import exp_se3, inverse, transform
from sl_nerfstudio.rendering.volume_rendering import (
    Rendered,
    comes_below,
    first_crossing,
    first_crossings,
    interval_weights,
    look_up,
    render,
    sphere_interval,
    uniform_samples,
)


def random_rays(count: int = 400) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    o = 3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    d = torch.randn(count, 3, generator=generator, dtype=torch.float64) - 0.7 * o
    return o, d / d.norm(dim=-1, keepdim=True)


def test_intervals_end_on_the_sphere():
    o, d = random_rays(1000)
    near, far = sphere_interval(o, d)
    nearest = -(o * d).sum(-1)
    miss = (o + nearest[:, None] * d).norm(dim=-1)
    inside = o.norm(dim=-1) < 1
    meets = inside | ((miss < 1) & (nearest > 0))
    full = meets & (miss < 0.75**0.5)  # chords at least as long as the radius
    assert full.sum() > 50 and (full & inside).any() and (meets & ~full).any() and (~meets).any()
    entry, leave = (o + near[:, None] * d).norm(dim=-1), (o + far[:, None] * d).norm(dim=-1)
    assert torch.allclose(leave[full], torch.ones_like(leave[full]))
    assert torch.allclose(entry[full & ~inside], torch.ones_like(entry[full & ~inside]))
    assert not near[inside].any()
    short = ~full & (nearest > 0.5)
    assert torch.allclose((far - near)[short], torch.ones_like(near[short]))
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


PROJECTOR = Intrinsics.of(Device(64, 48, 100.0, 100.0, 32.0, 24.0), torch.float64)
RADIUS = 0.5


def random_sdf(rays: int = 20, samples: int = 30) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(rays, samples, generator=generator, dtype=torch.float64) * 0.1


@pytest.mark.parametrize("kappa", [0.5, 20.0, 100.0])
def test_weights_are_those_of_the_formula(kappa):
    f = random_sdf().numpy()
    phi = 1 / (1 + np.exp(-kappa * f))
    expected = np.zeros((len(f), f.shape[1] - 1))
    for ray in range(len(f)):
        transparency = 1.0
        for i in range(f.shape[1] - 1):
            alpha = max((phi[ray, i] - phi[ray, i + 1]) / phi[ray, i], 0)
            expected[ray, i] = transparency * alpha
            transparency *= 1 - alpha
    assert np.abs(interval_weights(torch.from_numpy(f), kappa).numpy() - expected).max() < 1e-13


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kappa", [1.0, 100.0, 1e4])
def test_weights_are_shares_of_one_without_overflow(dtype, kappa):
    f = (random_sdf() * 10).to(dtype).requires_grad_()
    weights = interval_weights(f, kappa)
    assert (weights >= 0).all() and (weights.sum(-1) <= 1 + 1e-5).all()
    weights.square().sum().backward()
    assert f.grad is not None and f.grad.isfinite().all()
    wall = torch.tensor([[3.0, 2.0, 1.0, -1.0, -2.0, 1.0, -1.0]], dtype=dtype)  # infinitely sharp: one interval
    assert torch.equal(interval_weights(wall, 1e4), torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]], dtype=dtype))
    assert not interval_weights(wall.abs() + 1, 1e4).any()


def camera_rays() -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from (0, 0, 3) down onto the ball, well inside its outline."""
    x, y = torch.meshgrid(*(torch.linspace(-0.08, 0.08, 7, dtype=torch.float64),) * 2, indexing="ij")
    d = torch.stack([x, y, -torch.ones_like(x)], -1).reshape(-1, 3)
    return torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64).expand_as(d), d / d.norm(dim=-1, keepdim=True)


def projector_pose(x: float = 0.8, z: float = 3.0, flip: bool = False) -> torch.Tensor:
    """T_projector_scene of a projector at (x, 0, z) that looks down (or, flipped, up)."""
    T = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0] if flip else [1.0] * 4, dtype=torch.float64))
    T[:3, 3] = torch.tensor([x, 0.0, z], dtype=torch.float64)
    return inverse(T)


def exact_depth(o: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
    b = (o * d).sum(-1)
    return -b - (b * b - (o * o).sum(-1) + RADIUS**2).sqrt()


def rendered(kappa: float, samples: int, T: torch.Tensor, pattern: torch.Tensor | None = None):
    o, d = camera_rays()
    t = torch.linspace(2.2, 3.2, samples, dtype=torch.float64).expand(len(o), -1)
    sdf = (o[:, None] + t[..., None] * d[:, None]).norm(dim=-1) - RADIUS
    pattern = torch.ones(48, 64, dtype=torch.float64) if pattern is None else pattern
    return render(sdf, t, o, d, T.expand(len(o), 4, 4), PROJECTOR, pattern, kappa)


def test_a_ball_converges_to_ray_casting():
    o, d = camera_rays()
    depth, T = exact_depth(o, d), projector_pose()
    uv, in_front = project(PROJECTOR, transform(T[None], o + depth[:, None] * d))
    pattern = torch.rand(48, 64, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert in_front.all() and ((uv > 0) & (uv < uv.new_tensor([64.0, 48.0]))).all(-1).any()
    errors = []  # the last one is mostly the 1e-6 that keeps empty rays finite
    for kappa, samples in ((50.0, 100), (400.0, 800), (4000.0, 8000)):
        r = rendered(kappa, samples, T, pattern)
        errors.append([float((r.depth - depth).abs().max()), float((r.coordinates - uv).abs().max())])
        assert (r.accumulation > 0.99).all() and (r.accumulation <= 1 + 1e-9).all()
    assert all(
        b < a / 3 for fine, coarse in zip(errors[1:], errors, strict=False) for a, b in zip(coarse, fine, strict=True)
    )
    assert errors[-1][0] < 1e-3 and errors[-1][1] < 1e-2
    assert (r.pattern - look_up(pattern, uv)).abs().max() < 1e-2


@pytest.mark.parametrize("flip", [True, False])
def test_without_light_there_is_depth_and_no_intensity(flip):
    """Behind the projector there are no coordinates; outside the pattern they continue."""
    r = rendered(400.0, 400, projector_pose(x=0.8 if flip else 2.5, flip=flip))
    assert not r.pattern.any()
    if flip:
        assert not r.lit.any() and not r.coordinates.any()
    else:
        assert (r.coordinates[:, 0] < -2).all() and (r.lit > 0.999).all()
    assert (r.accumulation > 0.99).all() and (r.depth - exact_depth(*camera_rays())).abs().max() < 1e-2


def test_only_what_is_in_front_of_the_projector_makes_the_coordinate():
    """Two walls of weight about one half: the near one behind the projector, the far one in front of it."""
    t = torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    o, d = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    sdf = torch.tensor([[0.0, -np.log(3.0), -9e9]], dtype=torch.float64)  # Phi: 1/2, 1/4, 0
    T = projector_pose(x=0.1, z=-2.0)  # between the interval's middles at 1.5 and 2.5
    r = render(sdf, t, o, d, T[None], PROJECTOR, torch.ones(48, 64, dtype=torch.float64), 1.0)
    expected, _ = project(PROJECTOR, torch.tensor([[-0.1, 0.0, -0.5]], dtype=torch.float64))
    assert float(r.accumulation) == pytest.approx(1.0) and float(r.depth) == pytest.approx(2.0, abs=1e-5)
    assert float(r.lit) == pytest.approx(0.5, abs=1e-5)
    assert torch.allclose(r.coordinates, expected, rtol=1e-5)
    assert float(r.pattern) == pytest.approx(0.5, abs=1e-5)


def test_a_ray_through_nothing_has_no_weight_and_no_nan():
    o, d = camera_rays()
    t = torch.linspace(2.2, 3.2, 50, dtype=torch.float64).expand(len(o), -1)
    sdf = torch.full_like(t, 5.0).requires_grad_()
    r = render(
        sdf, t, o, d, projector_pose().expand(len(o), 4, 4), PROJECTOR, torch.ones(48, 64, dtype=torch.float64), 400.0
    )
    assert r.accumulation.abs().max() < 1e-9 and r.coordinates.isfinite().all() and r.depth.isfinite().all()
    (r.coordinates.sum() + r.depth.sum() + r.pattern.sum()).backward()
    assert sdf.grad is not None and sdf.grad.isfinite().all()


def test_the_pattern_between_pixels_equals_scipys():
    pattern = torch.rand(7, 11, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    uv = torch.rand(500, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 16 - 2.5
    expected = map_coordinates(
        pattern.numpy(), [uv[:, 1].numpy() - 0.5, uv[:, 0].numpy() - 0.5], order=1, mode="grid-constant", cval=0.0
    )
    assert np.abs(look_up(pattern, uv).numpy() - expected).max() < 1e-12
    assert torch.equal(look_up(pattern, uv.reshape(5, 100, 2)), look_up(pattern, uv).reshape(5, 100))
    centre = torch.tensor([[0.5, 0.5], [10.5, 6.5]], dtype=torch.float64)
    assert torch.allclose(look_up(pattern, centre), torch.stack([pattern[0, 0], pattern[6, 10]]))


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
