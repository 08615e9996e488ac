"""The projection of compiled loops, against that of tensors."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from random_geometry import DEVICES, generator, points_in_view, seeds

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


def compiled_pixel(device: Device, p: np.ndarray) -> tuple[float, float, bool]:
    return pixel_of(MODELS[device.model].code, *p, device.parameters)


@given(seeds, st.sampled_from(sorted(DEVICES)))
def test_points_in_view_have_the_same_pixel(seed, name):
    device = DEVICES[name]
    p = points_in_view((8,), generator(seed))
    uv, front = project(Intrinsics.of(device, torch.float64), p)
    for k in range(8):
        column, row, in_front = compiled_pixel(device, p[k].numpy())
        assert in_front and front[k]
        assert [column, row] == pytest.approx(uv[k].tolist(), abs=1e-9)


@given(seeds, st.sampled_from(sorted(DEVICES)))
def test_derivatives_are_those_of_tensors_in_view_and_the_rest_everywhere(seed, name):
    device, rng = DEVICES[name], generator(seed)
    intrinsics = Intrinsics.of(device, torch.float64)
    p = torch.cat([points_in_view((8,), rng), torch.randn(8, 3, generator=rng, dtype=torch.float64)])
    (uv, front), J = project(intrinsics, p), project_jacobian(intrinsics, p)
    for k in range(16):
        u, v, in_front, *derivatives = view_of(MODELS[device.model].code, *p[k].numpy(), device.parameters)
        assert bool(in_front) is bool(front[k])
        assert [u, v] == pytest.approx(uv[k].tolist(), rel=1e-9, abs=1e-9)
        if in_front:
            assert derivatives == pytest.approx(J[k].flatten().tolist(), rel=1e-9, abs=1e-9)


@given(seeds, st.sampled_from(sorted(DEVICES)))
def test_pixels_have_the_same_rays(seed, name):
    device, rng = DEVICES[name], generator(seed)
    reach = 1.0 if device.k1 else 2.4  # beyond the image, Newton's method need not end anywhere
    uv = torch.rand(8, 2, generator=rng, dtype=torch.float64) * torch.tensor([reach * device.w, reach * device.h])
    rays = unproject(Intrinsics.of(device, torch.float64), uv)  # NaN where a DOE has none
    for k in range(8):
        found = ray_of(MODELS[device.model].code, *uv[k].tolist(), device.parameters)
        assert found == pytest.approx(rays[k].tolist(), rel=1e-9, abs=1e-9, nan_ok=True)


@given(st.sampled_from(sorted(DEVICES)), st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_a_point_is_in_front_where_the_tensors_say_so(name, x, y, z):
    device = DEVICES[name]
    without_lens = Device(device.w, device.h, device.fl_x, device.fl_y, device.cx, device.cy, model=device.model)
    p = torch.tensor([x, y, z], dtype=torch.float64)
    if p.norm() < 1e-3 or abs(float(-z - 1e-6 * p.norm())) < 1e-9:
        return  # at the limit both answers are right
    _, front = project(Intrinsics.of(without_lens, torch.float64), p)
    column, row, in_front = compiled_pixel(without_lens, p.numpy())
    assert bool(in_front) is bool(front)
    assert bool(in_front) is (z < 0 and -z > 1e-6 * float(p.norm()))
    assert np.isfinite([column, row]).all()


@pytest.mark.parametrize("name", sorted(DEVICES))
def test_points_behind_are_flagged_and_finite(name):
    for p in ([0.1, 0.2, 1.0], [0.1, 0.2, 0.0], [3.0, 4.0, 1e-9], [3.0, 4.0, -1e-7]):
        column, row, in_front = compiled_pixel(DEVICES[name], np.array(p))
        assert not in_front
        assert np.isfinite([column, row]).all()


def test_every_model_has_a_code_of_its_own():
    codes = [model.code for model in MODELS.values()]
    assert len(set(codes)) == len(codes)
    assert {device.model for device in DEVICES.values()} == MODELS.keys()
