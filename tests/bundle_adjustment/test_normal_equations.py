"""The normal equations against dense least squares with all depths as unknowns."""

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.parameters import by_frame, by_kind
from sl_nerfstudio.bundle_adjustment.residuals import linearise

from .analytic import ExactMaps, columns_of, dense, disturbed, rig_of, without_prior

FRAMES, SIZE = 3, 60


def linear_system(seed: int):
    """Anchors, rows and derivatives at disturbed poses."""
    true, generator = rig_of(FRAMES, SIZE), torch.Generator().manual_seed(seed)
    maps, rig = ExactMaps.around(true, SIZE), disturbed(true, seed, degrees=0.3, shift=0.01, relative=0.5)
    anchors = place_anchors(rig, maps, 25, generator)
    rows = observe(rig, anchors, maps, 2, float("inf"), 0.1, generator)
    return anchors, rows, linearise(rig, anchors, rows, maps), generator


@pytest.mark.parametrize("seed", [0, 1])
def test_eliminated_depths_change_no_step(seed):
    """Dense equations of poses and depths together, their Schur complement, and the depths that follow from a step."""
    anchors, rows, linear, generator = linear_system(seed)
    own_weight = torch.rand(len(anchors.frame), generator=generator, dtype=torch.float64) + 0.1
    cross_weight = torch.rand(len(rows.anchor), generator=generator, dtype=torch.float64) * linear.residuals.cross_valid
    found = normal_equations(linear, rows, own_weight, cross_weight)

    n, m = linear.unknowns, len(anchors.frame)
    found_H, found_g = dense(found)
    own_columns, cross_columns = columns_of(linear)
    blocks = []
    every = torch.arange(m)
    for J, J_depth, r, w, columns, anchor in (
        (linear.own, linear.own_depth, linear.residuals.own, own_weight, own_columns, every),
        (linear.cross, linear.cross_depth, linear.residuals.cross, cross_weight, cross_columns, rows.anchor),
    ):
        full = torch.zeros(len(w), 2, n + m, dtype=torch.float64)
        for k in range(len(w)):
            full[k][:, columns[k]] += J[k]
            full[k][:, n + anchor[k]] += J_depth[k]
        root = w.sqrt()[:, None]
        blocks.append(((full * root[..., None]).reshape(-1, n + m), (r * root).reshape(-1)))
    A, b = (torch.cat(parts) for parts in zip(*blocks, strict=True))
    H, g = A.T @ A, A.T @ b
    poses, depths = slice(n), slice(n, None)
    over = torch.linalg.solve(H[depths, depths], torch.cat([H[depths, poses], g[depths, None]], 1))
    size = float(H.abs().max())
    assert torch.allclose(found_H, H[poses, poses] - H[poses, depths] @ over[:, :n], rtol=0, atol=1e-12 * size)
    assert torch.allclose(found_g, g[poses] - H[poses, depths] @ over[:, n], rtol=0, atol=1e-12 * size)
    assert torch.allclose(found_H, found_H.T, rtol=0, atol=1e-12 * size)
    x = torch.randn(n, generator=generator, dtype=torch.float64)
    wanted = -torch.linalg.solve(H[depths, depths], g[depths] + H[depths, poses] @ x)
    assert torch.allclose(found.depth_step(by_frame(x)), wanted, rtol=1e-9, atol=1e-9)
    assert torch.allclose(by_kind(found.times(by_frame(x))), found_H @ x, rtol=0, atol=1e-12 * size * float(x.norm()))


@pytest.mark.parametrize("frames", [[2, 0], [1]])
def test_some_frames_have_their_part_of_the_equations(frames):
    anchors, rows, linear, _ = linear_system(3)
    weights = torch.ones(len(anchors.frame), dtype=torch.float64), linear.residuals.cross_valid.double()
    some, n = torch.tensor(frames), 12 * len(frames)
    part, whole = normal_equations(linear, rows, *weights, some), normal_equations(linear, rows, *weights)
    H = without_prior(whole).reshape(FRAMES, 12, FRAMES, 12)[some][:, :, some].reshape(n, n)
    assert torch.allclose(without_prior(part), H, rtol=0, atol=1e-12 * float(H.abs().max()))
    assert torch.equal(part.g, whole.g[some])
