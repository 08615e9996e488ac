"""A frame that looks into empty space contradicts what would fill it."""

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.geometry.lie import Similarity, angle_deg
from sl_nerfstudio.registration.agreement import Tolerance, agreement_at
from sl_nerfstudio.registration.pairs import register_pair
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surfaces import build_surface_map
from tests.registration.shaped_clouds import rendered

FRAMES = (0, 2, 6, 8)


def seen_by(clouds):
    """The frames with what they saw of the pattern: here, all that has coordinates."""
    return [replace(cloud, seen=np.isfinite(cloud.coords).all(-1)) for cloud in clouds]


def compared(maps, poses, change=None):
    """Agreement of all pairs of frames; `change` of the world is done to the first of each."""
    out = []
    for i, j in permutations(range(len(maps)), 2):
        moved = poses[i] if change is None else change @ poses[i]
        S, rng = poses[j].inverse() @ moved, np.random.default_rng(0)
        tolerance = Tolerance(0.0, REGISTRATION_DEFAULTS.pair.tolerance_sigmas)
        out.append(agreement_at((maps[i], maps[j]), S, rng, tolerance, REGISTRATION_DEFAULTS.pair))
    return out


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """A box whose three sides differ; the longest is along x."""
    file = tmp_path_factory.mktemp("box") / "box.ply"
    trimesh.creation.box((110, 70, 50)).subdivide_to_size(8.0).export(file)
    return rendered(str(file), FRAMES)


@pytest.mark.parametrize("scene", ["chair", "vase"])
def test_right_frames_miss_nothing_of_each_other(scene):
    found = rendered(scene, FRAMES)
    maps = [build_surface_map(cloud) for cloud in seen_by(found.clouds)]
    assert max(one.absent[0] for one in compared(maps, found.S_world_camera)) < 0.005


def test_what_is_larger_than_it_was_seen_is_missed(box):
    maps = [build_surface_map(cloud) for cloud in seen_by(box.clouds)]
    larger = compared(maps, box.S_world_camera, Similarity(1.3, np.eye(3), np.zeros(3)))
    assert min(one.absent[0] for one in larger) > 0.02


def test_a_side_of_a_box_does_not_pass_for_another(box):
    """Wherever faces overlap they agree, at several sides; only where one ends do frames contradict each other."""
    true, settings = box.S_world_camera, REGISTRATION_DEFAULTS.pair
    blind, seeing = ([build_surface_map(c) for c in some] for some in (box.clouds, seen_by(box.clouds)))
    right, wrong = [], []
    for i, j in combinations(range(len(FRAMES)), 2):
        match = register_pair((blind[i], blind[j]), (i, j), settings.anywhere, np.random.default_rng(0))
        S, rng = match.S_target_source, np.random.default_rng(0)
        known = agreement_at((seeing[i], seeing[j]), S, rng, Tolerance(0.0, settings.tolerance_sigmas), settings)
        off_deg = angle_deg(S.R @ (true[j].inverse() @ true[i]).R.T)
        same = min(off_deg, abs(180 - off_deg)) < 3  # half a turn leaves the box as it is
        (right if same else wrong).append((match.fitness, known.absent[0]))
    assert min(len(right), len(wrong)) > 0
    assert min(fitness for fitness, _ in (*right, *wrong)) > 0.99  # nothing that both saw contradicts
    assert max(absent for _, absent in right) < 0.01
    assert min(absent for _, absent in wrong) > 0.02


def test_frames_of_which_nothing_is_known_say_nothing(box):
    maps = [build_surface_map(cloud) for cloud in box.clouds]
    larger = compared(maps, box.S_world_camera, Similarity(1.3, np.eye(3), np.zeros(3)))
    assert max(one.absent[0] for one in larger) == 0
