"""Volume rendering against its formula, against ray casting, and what is lit."""

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import inverse, transform
from sl_nerfstudio.rendering.volume_rendering import interval_weights, look_up, render

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


def test_an_infinitely_sharp_wall_is_one_interval():
    f = torch.tensor([[3.0, 2.0, 1.0, -1.0, -2.0, 1.0, -1.0]])
    assert torch.equal(interval_weights(f, 1e4), torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]))
    outside = interval_weights(f.abs() + 1, 1e4)
    assert outside.sum() == 0


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


def test_behind_the_projector_nothing_is_lit_but_there_is_depth():
    r = rendered(400.0, 400, projector_pose(flip=True))
    assert torch.equal(r.lit, torch.zeros_like(r.lit)) and torch.equal(r.pattern, torch.zeros_like(r.pattern))
    assert torch.equal(r.coordinates, torch.zeros_like(r.coordinates)) and r.coordinates.isfinite().all()
    assert (r.accumulation > 0.99).all()
    o, d = camera_rays()
    assert (r.depth - exact_depth(o, d)).abs().max() < 1e-2


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


def test_outside_the_pattern_coordinates_continue_and_the_intensity_is_zero():
    r = rendered(400.0, 400, projector_pose(x=2.5))
    assert (r.coordinates[:, 0] < -2).all() and (r.lit > 0.999).all()
    assert torch.equal(r.pattern, torch.zeros_like(r.pattern))


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
