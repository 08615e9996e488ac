"""Device models against OpenCV and the format's formulas; the projection of compiled loops against that of tensors."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from random_geometry import BATCHES, DEVICES, batches, generator, motions, points_in_view, seeds

from sl_nerfstudio.geometry.devices import (
    MODELS,
    Device,
    Intrinsics,
    pixel_of,
    project,
    project_jacobian,
    ray_of,
    unproject,
    view_of,
)
from sl_nerfstudio.geometry.lie import inverse, transform
from sl_nerfstudio.geometry.triangulation import pixel_centres, pixel_rays

names = st.sampled_from(sorted(DEVICES))


def opencv_pixels(device: Device, p: torch.Tensor) -> np.ndarray:
    """The same pixels by OpenCV: its axes are diag(1, -1, -1) of ours, its pixel centres lie at whole numbers."""
    points = p.reshape(-1, 3).numpy() * np.array([1.0, -1, -1])
    if device.model == "DOE":  # a DOE's directions cosines take the place of x/z and y/z
        points = points / np.linalg.norm(points, axis=-1, keepdims=True)
        points[:, 2] = 1
    K = np.array([[device.fl_x, 0, device.cx - 0.5], [0, device.fl_y, device.cy - 0.5], [0, 0, 1]])
    distortion = np.array([device.k1, device.k2, device.p1, device.p2])
    uv, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, distortion)
    return uv.reshape(*p.shape[:-1], 2) + 0.5


@given(seeds, batches, names)
def test_projection_is_opencv_s(seed: int, batch: tuple[int, ...], name: str) -> None:
    p = points_in_view(batch, generator(seed))
    uv, in_front = project(Intrinsics.of(DEVICES[name], torch.float64), p)
    assert in_front.shape == batch
    assert bool(in_front.all())
    assert uv.shape == (*batch, 2)
    assert np.abs(uv.numpy() - opencv_pixels(DEVICES[name], p)).max() < 1e-9


@pytest.mark.parametrize("name", sorted(DEVICES))
def test_every_pixel_of_the_image_comes_back(name: str) -> None:
    intrinsics = Intrinsics.of(DEVICES[name], torch.float64)
    uv = pixel_centres(DEVICES[name], torch.float64)[::20, ::20]
    again, in_front = project(intrinsics, 3.7 * unproject(intrinsics, uv))
    assert bool(in_front.all())
    assert float((again - uv).abs().max()) < 1e-9


@given(seeds, batches, names)
def test_jacobian_is_autograd_s(seed: int, batch: tuple[int, ...], name: str) -> None:
    p = points_in_view(batch, generator(seed)).requires_grad_()
    intrinsics = Intrinsics.of(DEVICES[name], torch.float64)
    uv, _ = project(intrinsics, p)
    rows = [torch.autograd.grad(uv[..., k].sum(), p, retain_graph=True)[0] for k in (0, 1)]
    found = project_jacobian(intrinsics, p)
    assert found.shape == (*batch, 2, 3)
    assert bool(((found - torch.stack(rows, -2)).abs() < 1e-9).all())


@pytest.mark.parametrize("name", sorted(DEVICES))
def test_gradients(name: str) -> None:
    device = DEVICES[name]
    p = points_in_view((4,), generator(0)).requires_grad_()
    params = Intrinsics.of(device, torch.float64).params.clone().requires_grad_()

    def pixels(params: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        return project(Intrinsics(params, device.model, bool(device.k1)), p)[0]

    def rays(params: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
        return unproject(Intrinsics(params, device.model, bool(device.k1)), uv)

    assert torch.autograd.gradcheck(pixels, (params, p), eps=1e-6, atol=1e-5)
    uv = pixels(params, p).detach().requires_grad_()
    assert torch.autograd.gradcheck(rays, (params, uv), eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("name", sorted(DEVICES))
def test_behind_the_device_is_said_and_harmless(name: str) -> None:
    p = torch.tensor(
        [[0.1, 0.2, 1], [0.1, 0.2, 0], [0, 0, 0], [0, 0, 1], [3, 4, 1e-9], [3, 4, -1e-7], [1e-20, 0, 1e-20]]
    ).requires_grad_()
    uv, in_front = project(Intrinsics.of(DEVICES[name]), p)
    assert not in_front.any()
    assert bool(uv.isfinite().all())
    (gradient,) = torch.autograd.grad(uv.sum(), p)
    assert bool(gradient.isfinite().all())
    for q in p[[0, 1, 4, 5]].detach().numpy().astype(np.float64):  # in compiled loops
        *pixel, in_front = pixel_of(MODELS[DEVICES[name].model].code, *q, DEVICES[name].parameters)
        assert not in_front and np.isfinite(pixel).all()


def test_a_lens_that_folds_does_not_light_what_lies_far_outside() -> None:
    """Beyond the turning point of the polynomial a point would be imaged a second time, here at the centre."""
    device = Device(800, 600, 900.0, 900.0, 400.0, 300.0, k1=-0.25)
    intrinsics = Intrinsics.of(device, torch.float64)
    turning = (1 / (3 * 0.25)) ** 0.5
    radius = torch.tensor([0.0, 0.5, turning - 1e-6, turning + 1e-6, 2.0, 2.3], dtype=torch.float64)
    for x, y in ((1.0, 0.0), (0.6, -0.8)):
        p = torch.stack([x * radius, y * radius, -torch.ones_like(radius)], -1)
        uv, has_pixel = project(intrinsics, p)
        assert has_pixel.tolist() == [True, True, True, False, False, False]
        assert abs(float(uv[4, 0]) - 400) < 10  # which is why the flag is needed


def test_doe_beyond_the_horizon_is_nan() -> None:
    device = Device(800, 800, 300.0, 300.0, 400.0, 400.0, model="DOE")
    d = unproject(Intrinsics.of(device), torch.tensor([[400.0, 400], [699, 400], [701, 400], [0, 0]]))
    assert d.isfinite().all(-1).tolist() == [True, True, False, False]


@given(seeds, st.floats(0.1, 4.0), names)
def test_resizing_moves_pixels_by_the_same_factor(seed: int, factor: float, name: str) -> None:
    p = points_in_view((5,), generator(seed))
    device = DEVICES[name]
    scaled = device.scaled(factor)
    assert (scaled.w, scaled.h) == (round(device.w * factor), round(device.h * factor))
    whole, part = (project(Intrinsics.of(d, torch.float64), p)[0] for d in (device, scaled))
    assert float((part - factor * whole).abs().max()) < 1e-9


@pytest.mark.parametrize("batch", BATCHES)
def test_a_batch_of_devices_is_each_device(batch: tuple[int, ...]) -> None:
    devices = [replace(DEVICES["lens"], fl_x=900.0 + i, k1=-0.01 * i) for i in range(3)]
    intrinsics = Intrinsics.of(devices, torch.float64)
    assert intrinsics.params.shape == (3, 8)
    p = points_in_view((3, *batch), generator(1))
    together, _ = project(intrinsics.reshape(3, *[1] * len(batch)), p)
    for i, device in enumerate(devices):
        alone, _ = project(Intrinsics.of(device, torch.float64), p[i])
        assert torch.allclose(together[i], alone, atol=1e-12)
        chosen, _ = project(intrinsics[i], p[i])
        assert torch.allclose(chosen, alone, atol=1e-12)
    assert intrinsics[torch.tensor([2, 0])].params[0, 0] == 902


def test_kinds_do_not_mix() -> None:
    with pytest.raises(ValueError, match=r"must share a model, got \['DOE', 'OPENCV'\]"):
        Intrinsics.of([DEVICES["DOE"], DEVICES["lens"]])


def test_pixel_centres() -> None:
    uv = pixel_centres(Device(3, 2, 1.0, 1.0, 0.0, 0.0))
    assert uv.tolist() == [[[0.5, 0.5], [1.5, 0.5], [2.5, 0.5]], [[0.5, 1.5], [1.5, 1.5], [2.5, 1.5]]]


@given(seeds, batches, names)
def test_rays_meet_the_points_they_come_from(seed: int, batch: tuple[int, ...], name: str) -> None:
    source = generator(seed)
    T_world_device = motions(batch, source, 2.0)
    p_device = points_in_view(batch, source)
    p_world = transform(T_world_device, p_device)
    intrinsics = Intrinsics.of(DEVICES[name], torch.float64)
    uv, _ = project(intrinsics, transform(inverse(T_world_device), p_world))
    o, d = pixel_rays(intrinsics, T_world_device, uv)
    assert o.shape == d.shape == (*batch, 3)
    assert float((d.norm(dim=-1) - 1).abs().max()) < 1e-12
    along = ((p_world - o) * d).sum(-1, keepdim=True)
    assert float((o + along * d - p_world).abs().max()) < 1e-11
    assert bool((along > 0).all())


# The projection of compiled loops, against that of tensors.


@given(seeds, names)
def test_compiled_loops_project_as_tensors_do(seed, name):
    device, rng = DEVICES[name], generator(seed)
    intrinsics = Intrinsics.of(device, torch.float64)
    p = torch.cat([points_in_view((8,), rng), torch.randn(8, 3, generator=rng, dtype=torch.float64)])
    (uv, front), J = project(intrinsics, p), project_jacobian(intrinsics, p)
    for k, (x, y, z) in enumerate(p.tolist()):
        u, v, in_front, *derivatives = view_of(MODELS[device.model].code, x, y, z, device.parameters)
        assert bool(in_front) is bool(front[k])
        assert [u, v] == pytest.approx(uv[k].tolist(), rel=1e-9, abs=1e-9)
        *pixel, before_lens = pixel_of(MODELS[device.model].code, x, y, z, device.parameters)
        assert bool(before_lens) is (-z > 1e-6 * float(p[k].norm()))  # also beyond where the lens folds
        if in_front:
            assert derivatives == pytest.approx(J[k].flatten().tolist(), rel=1e-9, abs=1e-9)
            assert pixel == pytest.approx(uv[k].tolist(), abs=1e-9)
    assert {one.model for one in DEVICES.values()} == MODELS.keys()


@given(seeds, names)
def test_compiled_loops_have_the_rays_of_tensors(seed, name):
    device, rng = DEVICES[name], generator(seed)
    reach = 1.0 if device.k1 else 2.4  # beyond the image, Newton's method need not end anywhere
    uv = torch.rand(8, 2, generator=rng, dtype=torch.float64) * torch.tensor([reach * device.w, reach * device.h])
    rays = unproject(Intrinsics.of(device, torch.float64), uv)  # NaN where a DOE has none
    for k in range(8):
        found = ray_of(MODELS[device.model].code, *uv[k].tolist(), device.parameters)
        assert found == pytest.approx(rays[k].tolist(), rel=1e-9, abs=1e-9, nan_ok=True)
