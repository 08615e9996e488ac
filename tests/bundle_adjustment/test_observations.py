"""Which pixels take part, and which other frames see them: against ray casting of an analytic scene."""

from dataclasses import replace

import pytest
import torch

from sl_nerfstudio.bundle_adjustment.observations import (
    away_from_borders,
    involving,
    observe,
    partners,
    place_anchors,
)
from sl_nerfstudio.geometry.lie import rotate, transform

from .analytic import ExactMaps, cast, rig_of

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


@pytest.mark.parametrize("most", [1, 2])
def test_no_anchor_is_looked_up_more_often_than_wanted(scene, most):
    rig, maps, anchors = scene
    rows = observe(rig, anchors, maps, most, ALL, 0.1, torch.Generator().manual_seed(1))
    count = torch.bincount(rows.anchor)
    assert count.max() == most
    everything = torch.bincount(observe(rig, anchors, maps, FRAMES, ALL, 0.1, torch.Generator().manual_seed(2)).anchor)
    assert torch.equal(count, everything.clamp_max(most))


def test_around_one_frame_selects_all_observations_that_involve_it(scene):
    rig, maps, anchors = scene
    generator = torch.Generator().manual_seed(1)
    rows = observe(rig, anchors, maps, FRAMES, ALL, 0.1, generator)
    around = observe(rig, anchors, maps, FRAMES, ALL, 0.1, generator, involving(2, FRAMES))
    mine = (anchors.frame[rows.anchor] == 2) | (rows.frame == 2)
    wanted = set(zip(rows.anchor[mine].tolist(), rows.frame[mine].tolist(), strict=True))
    assert set(zip(around.anchor.tolist(), around.frame.tolist(), strict=True)) == wanted


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
