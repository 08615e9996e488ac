"""Where surfaces of single frames fit together: a start that is near the truth however far off the given one is."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sl_nerfstudio.bundle_adjustment import adjust as hops
from sl_nerfstudio.bundle_adjustment.adjust import adjust, registered_start
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.parameters import baseline_scale, restore
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings, HopSettings, problem_of, search
from sl_nerfstudio.geometry.lie import inverse, log_so3

from .analytic import disturbed, images_of, rig_of, rough_prior, turned

FRAMES, SIZE, LOST = 6, 100, 2
_EXACT = 0.5  # degrees: what images of 100 pixels and 100 look-ups of each frame allow
SETTINGS = AdjustmentSettings(anchors_per_frame=100, frames_per_anchor=3, max_iterations=20, other_minima=0)


@pytest.fixture(scope="module")
def true():
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def maps(true):
    return CoordinateMaps.of(images_of(true, SIZE))


def turns_deg(rig, true) -> list[float]:
    """Of each frame from where it truly is, when all are aligned as one."""
    aligned = restore(true, rig, baseline_scale(true, rig, None))
    turn = inverse(true.T_world_camera) @ aligned.T_world_camera
    return torch.rad2deg(log_so3(turn[:, :3, :3]).norm(dim=-1)).tolist()


@pytest.mark.parametrize("refine", ["free", "known-rig"])
def test_frames_that_are_8_degrees_off_begin_within_one(true, maps, refine):
    start = disturbed(true, 3, degrees=8.0, shift=0.1, relative=0.03)
    problem = problem_of(start, maps, rough_prior(FRAMES, 8.0), SETTINGS)
    found = registered_start(problem, refine, start, range(FRAMES))
    assert found is not None
    assert max(turns_deg(start, true)) > 5 and max(turns_deg(found, true)) < 1
    if refine != "free":
        assert torch.equal(found.T_camera_projector, start.T_camera_projector)
    lengths = found.T_camera_projector[:, :3, 3].norm(dim=-1) / start.T_camera_projector[:, :3, 3].norm(dim=-1)
    assert lengths.numpy() == pytest.approx(np.ones(FRAMES), abs=0.02)  # the scene keeps its size
    # and its place: what all starts share is where the scene is
    assert max(turns_deg(replace(start, T_world_camera=found.T_world_camera), start)) < 12


def test_frames_of_which_hardly_anything_was_decoded_stay_where_they_are(true, maps):
    images = [maps.image(k).clone() for k in range(FRAMES)]
    images[LOST][:] = float("nan")
    start = disturbed(true, 3, degrees=4.0, shift=0.05)
    problem = problem_of(start, CoordinateMaps.of(images), rough_prior(FRAMES, 4.0), SETTINGS)
    found = registered_start(problem, "free", start, range(FRAMES))
    assert found is not None
    assert torch.equal(found.T_world_camera[LOST], start.T_world_camera[LOST])
    empty = CoordinateMaps.of([torch.full_like(image, float("nan")) for image in images])
    nothing = replace(problem, maps=empty)
    assert registered_start(nothing, "free", start, range(FRAMES)) is None


def test_the_first_hop_begins_there(true, maps, monkeypatch):
    """A start from which a search ends elsewhere is left at once, and drawn poses only confirm the new end."""
    begun = []

    def counted(problem, refine):
        begun.append(problem.begin)
        return search(problem, refine)

    monkeypatch.setattr(hops, "search", counted)
    start = disturbed(true, 5, degrees=12.0, shift=0.2)
    problem = problem_of(start, maps, rough_prior(FRAMES, 12.0), replace(SETTINGS, hops=HopSettings(most=2)))
    first = search(problem, "known-rig")
    assert first is not None
    found = hops.hopped(problem, "known-rig", first[0]).best
    assert max(turns_deg(begun[0], true)) < 1 < max(turns_deg(start, true))
    assert max(turns_deg(found.state.rig, true)) < _EXACT < 5 < max(turns_deg(first[0].state.rig, true))


@pytest.mark.parametrize("degrees", [90.0, 150.0])
def test_a_frame_that_is_far_off_is_found_by_its_surface(true, maps, degrees):
    start = turned(disturbed(true, 4, degrees=0.5, shift=0.01), LOST, degrees)
    prior = rough_prior(FRAMES, 1.0)
    named = adjust(start, maps, prior, "free", replace(SETTINGS, hops=HopSettings(lost_by_surface=False)))
    assert named.unplaced == (LOST,)
    found = adjust(start, maps, prior, "free", SETTINGS)
    assert found.unplaced == () and max(turns_deg(found.rig, true)) < _EXACT
    others = torch.arange(FRAMES) != LOST
    assert torch.equal(found.start.T_world_camera[others], start.T_world_camera[others])
    assert torch.equal(found.start.T_camera_projector, start.T_camera_projector)
    # the scene is put where the others were given, whatever was said about the lost one
    rig = restore(found.start, found.rig, baseline_scale(found.start, found.rig, None))
    away = (inverse(start.T_world_camera) @ rig.T_world_camera)[others]
    assert float(torch.rad2deg(log_so3(away[:, :3, :3]).norm(dim=-1)).max()) < 1.5
