"""Which pixels take part, which other frames see them (against ray casting), and how the robust kernel weighs them."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.bundle_adjustment import observations
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import (
    Kernel,
    away_from_borders,
    frame_medians,
    noise_of,
    noise_ratios,
    observe,
    partners,
    place_anchors,
    useful_distance,
    visible_rows,
    with_common_normals,
)
from sl_nerfstudio.bundle_adjustment.residuals import Observations, Residuals
from sl_nerfstudio.geometry.lie import rotate, transform

from . import analytic
from .analytic import ExactMaps, cast, images_of, rig_of

FRAMES, SIZE = 5, 90
ALL = float("inf")


@pytest.fixture(scope="module")
def scene():
    rig = rig_of(FRAMES, SIZE)
    maps, generator = ExactMaps.around(rig, SIZE), torch.Generator().manual_seed(0)
    return rig, maps, place_anchors(rig, maps, 60, generator)


def world(rig, anchors):
    return transform(rig.T_world_camera[anchors.frame], anchors.depth[:, None] * anchors.d_camera)


def test_anchors_lie_on_the_surface_with_its_normal(scene):
    rig, _, anchors = scene
    assert (torch.bincount(anchors.frame, minlength=FRAMES) > 20).all()
    origin = rig.T_world_camera[anchors.frame, :3, 3]
    direction = rotate(rig.T_world_camera[anchors.frame], anchors.d_camera)
    depth, _ = cast(origin, direction)
    assert (anchors.depth - depth).abs().max() < 1e-6
    normal, (p, step) = rotate(rig.T_world_camera[anchors.frame], anchors.normal), (world(rig, anchors), 1e-3)
    flat = []
    for axis in torch.eye(3, dtype=torch.float64):  # a step in the tangent plane stays on the surface
        along = torch.linalg.cross(normal, axis.expand_as(normal))
        to = p + step * along - origin
        there, _ = cast(origin, to / to.norm(dim=-1, keepdim=True))
        flat.append((there - to.norm(dim=-1)).abs())
    assert torch.stack(flat).median() < 1e-3 and ((normal * direction).sum(-1) < 0).all()


def test_frames_that_decoded_the_point_are_found_and_no_others(scene):
    rig, maps, anchors = scene
    rows = observe(rig, anchors, maps, FRAMES, ALL, 0.1, torch.Generator().manual_seed(1))
    assert (anchors.frame[rows.anchor] != rows.frame).all()
    pairs = set(zip(rows.anchor.tolist(), rows.frame.tolist(), strict=True))
    assert len(pairs) == len(rows.anchor)  # none twice
    gated = observe(rig, anchors, maps, FRAMES, 4.0, 0.1, torch.Generator().manual_seed(1))
    right = set(zip(gated.anchor.tolist(), gated.frame.tolist(), strict=True))
    assert right < pairs
    p = world(rig, anchors)
    a, j = gated.anchor, gated.frame
    way = p[a] - rig.T_world_camera[j, :3, 3]
    length = way.norm(dim=-1)
    met = cast(rig.T_world_camera[j, :3, 3], way / length[:, None])[0]
    seen = (met - length).abs() < 1e-5  # nothing is between camera and point
    assert seen.double().mean() > 0.97  # the rest is within the gate of an edge


def test_without_a_gate_no_coordinate_is_read(scene):
    """Coordinates of many frames are in a file, from which each choice of rows would read them all."""
    rig, maps, anchors = scene
    blank = replace(maps, values=torch.zeros_like(maps.values))
    a, b = (observe(rig, anchors, m, 3, ALL, 0.1, torch.Generator().manual_seed(1)) for m in (maps, blank))
    assert torch.equal(a.anchor, b.anchor) and torch.equal(a.frame, b.frame) and len(a.anchor) > 100
    gated = observe(rig, anchors, blank, 3, 4.0, 0.1, torch.Generator().manual_seed(1))
    assert len(gated.anchor) < len(a.anchor)  # a gate needs them


def test_single_look_ups_exist_where_frames_find_them(scene):
    rig, maps, anchors = scene
    count = len(anchors.frame)
    every = Observations(torch.arange(count).repeat_interleave(FRAMES), torch.arange(FRAMES).repeat(count))
    found = observe(rig, anchors, maps, FRAMES, ALL, 0.3, torch.Generator().manual_seed(1))
    seen = visible_rows(rig, anchors, every, maps, 0.3).reshape(count, FRAMES)
    seen[torch.arange(count), anchors.frame] = False  # no frame looks up its own
    expected = torch.zeros_like(seen)
    expected[found.anchor, found.frame] = True
    assert torch.equal(seen, expected) and seen.any(0).all() and not seen.all(0).any()


def test_surfaces_seen_at_a_flat_angle_are_left_out(scene):
    rig, maps, anchors = scene
    loose, strict = (
        observe(rig, anchors, maps, FRAMES, ALL, cosine, torch.Generator().manual_seed(1)) for cosine in (0.1, 0.6)
    )
    assert 0 < len(strict.anchor) < len(loose.anchor)
    p, normal = world(rig, anchors), rotate(rig.T_world_camera[anchors.frame], anchors.normal)
    for T in (rig.T_world_camera, rig.T_world_projector):
        way = torch.nn.functional.normalize(T[strict.frame, :3, 3] - p[strict.anchor], dim=-1)
        assert ((way * normal[strict.anchor]).sum(-1) > 0.6).all()


def test_no_anchor_is_looked_up_more_often_than_wanted(scene):
    rig, maps, anchors = scene
    everything = torch.bincount(observe(rig, anchors, maps, FRAMES, ALL, 0.1, torch.Generator().manual_seed(2)).anchor)
    for most in (1, 2):
        rows = observe(rig, anchors, maps, most, ALL, 0.1, torch.Generator().manual_seed(1))
        assert torch.equal(torch.bincount(rows.anchor), everything.clamp_max(most))


def test_partners_see_the_same_surface_and_are_few(scene):
    rig, maps, anchors = scene
    every = partners(rig, anchors, maps, FRAMES - 1, 0.1, torch.Generator().manual_seed(0))
    assert torch.equal(every, ~torch.eye(FRAMES, dtype=torch.bool))
    few = partners(rig, anchors, maps, 2, 0.1, torch.Generator().manual_seed(0))
    assert torch.equal(few, few.T) and not few.diagonal().any()
    assert (few.sum(1) >= 1).all() and few.sum() < every.sum()
    rows = observe(rig, anchors, maps, FRAMES, ALL, 0.1, torch.Generator().manual_seed(1))
    seen = torch.zeros(FRAMES, FRAMES, dtype=torch.bool)
    seen[rows.pairs(anchors)[0], rows.frame] = True
    assert (few <= (seen | seen.T)).all()
    allowed = observe(rig, anchors, maps, FRAMES, ALL, 0.1, torch.Generator().manual_seed(1), few)
    assert few[allowed.pairs(anchors)[0], allowed.frame].all()
    kept = few[rows.pairs(anchors)[0], rows.frame]
    assert torch.equal(allowed.anchor, rows.anchor[kept]) and torch.equal(allowed.frame, rows.frame[kept])


def test_what_is_near_the_border_falls_away_with_its_rows(scene):
    rig, maps, anchors = scene
    rows = observe(rig, anchors, maps, 3, ALL, 0.1, torch.Generator().manual_seed(1))
    own = torch.arange(len(anchors.frame)).double() % 10
    thin = anchors.frame == 1  # all of it is near the border
    own[thin] = 2.0 + torch.arange(int(thin.sum())).double() % 2
    seen = torch.arange(len(rows.anchor)).double() % 7
    kept, left = away_from_borders(anchors, rows, (own, seen), 4.0, FRAMES)
    limit = torch.tensor([4.0, float(own[thin].median()), 4.0, 4.0, 4.0], dtype=torch.float64)
    assert torch.equal(kept.depth, anchors.depth[own >= limit[anchors.frame]])
    assert 0.5 <= float((kept.frame == 1).sum() / (anchors.frame == 1).sum()) < 1.01
    expected = (own >= limit[anchors.frame])[rows.anchor] & (seen >= limit[rows.frame])
    assert torch.equal(left.frame, rows.frame[expected])
    assert torch.equal(kept.depth[left.anchor], anchors.depth[rows.anchor[expected]])


# The robust kernel.

FRAME = torch.tensor([0, 0, 1, 2])  # of four anchors
PAIR = torch.tensor([[0, 0, 1, 2, 2], [1, 2, 0, 0, 1]])  # of five rows


def with_roughness(cross: torch.Tensor, rough: torch.Tensor, valid: torch.Tensor | None = None) -> Residuals:
    valid = torch.ones(len(cross), dtype=torch.bool) if valid is None else valid
    return Residuals(torch.zeros(1, 2).double(), cross, valid, rough)


def residuals(seed: int, size: float = 1.0, invalid: bool = False) -> Residuals:
    generator = torch.Generator().manual_seed(seed)
    own, cross = (size * torch.randn(n, 2, generator=generator, dtype=torch.float64) for n in (4, 5))
    valid = torch.ones(5, dtype=torch.bool)
    valid[3] = not invalid
    return Residuals(own, cross, valid, torch.zeros(5).double())


def kernel(*widths: float) -> Kernel:
    return Kernel(torch.tensor(widths, dtype=torch.float64), FRAME, PAIR)


@given(st.integers(0, 50), st.floats(0.05, 20.0), st.booleans())
def test_weights_are_the_derivative_of_the_cost(seed, size, invalid):
    """Half the gradient of the cost is weight times residual, so a step of the normal equations descends."""
    r, k = residuals(seed, size, invalid), kernel(0.5, 2.0, 1.0)
    own, cross = r.own.clone().requires_grad_(), r.cross.clone().requires_grad_()
    (w_own, w_cross), own2, cross2 = k.weights(r), k.width[FRAME] ** 2, k.width[PAIR].amax(0) ** 2
    squares = ((own**2).sum(-1), own2), ((cross**2).sum(-1)[r.cross_valid], cross2[r.cross_valid])
    cost = k.narrowest**2 * sum((r2 / (w2 + r2)).sum() for r2, w2 in squares)
    assert k.cost(r, r.cross_valid) == pytest.approx(cost.item(), rel=1e-12)
    g_own, g_cross = torch.autograd.grad(cost, (own, cross))
    assert torch.allclose(g_own / 2, w_own[:, None] * r.own, rtol=1e-10, atol=1e-14)
    assert torch.allclose(g_cross / 2, w_cross[:, None] * r.cross, rtol=1e-10, atol=1e-14)


@given(st.integers(0, 50), st.floats(0.05, 1.0), st.booleans())
def test_curvature_is_that_of_the_cost_relative_to_its_weights(seed, size, invalid):
    r, k = residuals(seed, size, invalid), kernel(0.5, 2.0, 1.0)
    squares = torch.cat([k.width[FRAME] ** 2, k.width[PAIR].amax(0)[r.cross_valid] ** 2])
    values = torch.cat([r.own, r.cross[r.cross_valid]])

    def cost(x):
        r2 = (x.reshape(-1, 2) ** 2).sum(-1)
        return k.narrowest**2 * (r2 / (squares + r2)).sum()

    hessian = torch.autograd.functional.hessian(cost, values.reshape(-1))
    weights = torch.cat([k.weights(r)[0], k.weights(r)[1][r.cross_valid]])
    assert k.curvature(r) == pytest.approx(float(hessian.trace() / 4 / weights.sum()), rel=1e-9, abs=1e-12)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=40), st.integers(0, 1000))
def test_medians_are_of_the_residuals_that_involve_a_frame_also_with_equal_values(values, seed):
    """Each row involves frames 0 and 1, half of them in the other order; frame 2 has none."""
    size = torch.tensor(values, dtype=torch.float64)
    valid = torch.rand(len(values), generator=torch.Generator().manual_seed(seed)) < 0.8
    rows = torch.stack([size, torch.zeros_like(size)], -1)
    turned = torch.arange(len(values)) % 2
    found = frame_medians(with_roughness(rows, torch.zeros_like(size), valid), torch.stack([turned, 1 - turned]), 3)
    expected = size[valid].median() if valid.any() else torch.tensor(float("inf")).double()
    assert (found[:2] == expected).all() and torch.isinf(found[2])


def test_the_noise_is_the_robust_sigma_of_the_inliers():
    generator = torch.Generator().manual_seed(0)
    cross = 0.3 * torch.randn(20000, 2, generator=generator, dtype=torch.float64)
    cross[::10] += 50.0
    r = with_roughness(cross, torch.zeros(20000).double())
    assert noise_of(r, 0.9) == pytest.approx(0.3, rel=0.03)
    exact = replace(r, cross=torch.zeros_like(cross))
    assert noise_of(exact, 0.9) == observations.NOISE_FLOOR_PX


def test_residuals_of_rough_coordinates_are_as_noisy_as_they_say():
    """Twice as large where windows are rough: their kernel is as much wider, their weight smaller."""
    generator, n = torch.Generator().manual_seed(3), 20_000
    rough = torch.rand(n, generator=generator, dtype=torch.float64)
    anchor = torch.arange(n) % 2  # one anchor is smooth, the other one rough
    roughness = torch.tensor([0.0, 1.0], dtype=torch.float64)
    noise = torch.where(torch.hypot(rough, roughness[anchor]) > 0.5, 0.2, 0.1).double()
    r = with_roughness(noise[:, None] * torch.randn(n, 2, generator=generator, dtype=torch.float64), rough)
    own, cross = noise_ratios(r, roughness, anchor)
    smooth = (anchor == 0) & (rough < 0.48)
    assert cross[(anchor == 1) | (rough > 0.52)].median() / cross[smooth].median() == pytest.approx(2.0, rel=0.1)
    assert own[1] / own[0] == pytest.approx(2.0, rel=0.1)
    pair = torch.zeros(2, n, dtype=torch.long)
    one = Kernel(torch.tensor([1.0], dtype=torch.float64), torch.tensor([0, 0]), pair, (own, cross))
    exact = replace(r, own=torch.zeros(2, 2).double(), cross=torch.zeros_like(r.cross))
    for weight, ratio in zip(one.weights(exact), (own, cross), strict=True):
        assert torch.allclose(weight, 1 / ratio**2)
    none = with_roughness(torch.zeros(3, 2).double(), torch.zeros(3).double(), torch.zeros(3, dtype=torch.bool))
    assert all((ratio == 1).all() for ratio in noise_ratios(none, torch.zeros(1).double(), torch.zeros(3).long()))


def noisy(worse_below: float, factor: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances up to 40 pixels, and residuals that are larger near the border."""
    generator = torch.Generator().manual_seed(4)
    distance = (40 * torch.rand(20000, generator=generator, dtype=torch.float64)).floor()
    size = torch.randn(20000, 2, generator=generator, dtype=torch.float64).norm(dim=-1)
    return distance, torch.where(distance < worse_below, factor * size, size)


def test_look_ups_are_useful_from_where_residuals_are_no_larger_than_usual():
    """Classes are an eighth of all, five pixels wide."""
    assert useful_distance(*noisy(10, 2.0)) == pytest.approx(10, abs=1)
    assert useful_distance(*noisy(0, 1.0)) == 0
    assert useful_distance(torch.zeros(0), torch.zeros(0)) == 0
    # at most half of the look-ups fall away
    distance, size = noisy(30, 3.0)
    least = useful_distance(distance, torch.where(distance < 20, 3 * size, size))
    assert least == pytest.approx(20, abs=1)
    distance, size = noisy(0, 1.0)
    assert useful_distance(distance, torch.where(distance > 30, 9 * size, size)) == 0


def test_normals_of_all_frames_have_a_fraction_of_the_error_of_those_of_one(monkeypatch):
    """Of a disk whose coordinates are noisy; without noise they are exact."""
    monkeypatch.setattr(analytic, "BALLS", ())
    rig, size = rig_of(6, 200), 200
    errors = []
    for noise in (0.0, 0.3):
        generator = torch.Generator().manual_seed(0)
        images = [image + noise * torch.randn(image.shape, generator=generator) for image in images_of(rig, size)]
        maps = CoordinateMaps.of(images)
        anchors = place_anchors(rig, maps, 100, generator)
        rows = observe(rig, anchors, maps, 5, float("inf"), 0.1, generator)
        for found in (anchors, with_common_normals(rig, anchors, rows, maps)):
            up = rotate(rig.T_world_camera[found.frame], found.normal)[:, 2]
            errors.append(float(torch.rad2deg(torch.arccos(up.clamp(-1, 1))).square().mean().sqrt()))
    of_one, of_all = errors[2:]
    assert max(errors[:2]) < 0.05 and of_one > 3
    assert of_all < of_one / 6
