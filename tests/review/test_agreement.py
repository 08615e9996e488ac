"""Verdicts on scans from sl-synth: right ones are good, whatever their unit; every planted fault is named."""

import itertools
from dataclasses import replace

import networkx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.review.agreement import agreeing_groups, bridges, compare_scan_frames
from sl_nerfstudio.review.verdict import (
    FrameFacts,
    ScanFacts,
    departed_frames,
    departed_reasons,
    describe_departed,
    judge_scan,
)
from sl_nerfstudio.scan import PoseSigma, read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise
from tests.review.cases import ring, turned

FRAMES = 16


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Right poses, noisy coordinates: 0.3 px, 15 % missing, 2 % wrong."""
    root = tmp_path_factory.mktemp("verdict") / "scan"
    exact = {"pose_error": (0.0, 0.0), "autocalibration_error": (0.0, 0.0, 0.0)}
    synthesise(SynthConfig(scene="frog", frames=FRAMES, resolution=160, **exact), root)
    return read_scan(root)


def verdict_on(scan, poses, sigma=None):
    cross = compare_scan_frames(scan, poses, [sigma] * FRAMES)
    return judge_scan(ScanFacts(tuple(FrameFacts(f.name) for f in scan.frames), cross=cross))


def named(scan, reason):
    return [f.name for f in scan.frames if f.name in reason.split(":")[0]]


def test_a_right_scan_is_good_in_every_unit_and_place(scan):
    found = compare_scan_frames(scan, scan.poses, [None] * FRAMES)
    assert verdict_on(scan, scan.poses).band == "good" and verdict_on(scan, scan.poses).reasons == ()
    assert 0.03 < found.noise_px < 0.3  # look-ups average 0.3 px over a window
    assert found.share > 0.98 and min(f.seen for f in found.frames) > 0.8
    S = Similarity(1e-3, np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]), np.array([3.0, -2.0, 7.0]))
    metres = compare_scan_frames(scan, scan.poses.mapped(S), [None] * FRAMES)
    assert metres.noise_px == pytest.approx(found.noise_px, rel=1e-3)
    assert metres.px_p95 == pytest.approx(found.px_p95, rel=1e-3)
    assert [p.frames for p in metres.pairs] == [p.frames for p in found.pairs]


@pytest.mark.parametrize("degrees", [5.0, 170.0])
def test_one_wrong_frame_makes_the_scan_poor_and_is_named(scan, degrees):
    verdict = verdict_on(scan, turned(scan.poses, [5], degrees))
    assert verdict.band == "poor"
    assert named(scan, verdict.reasons[0]) == ["frame_00005"]
    assert "contradicts the frames that saw the same surface" in verdict.reasons[0]
    assert all(named(scan, reason) in ([], ["frame_00005"]) for reason in verdict.reasons)


def test_two_halves_are_told_apart(scan):
    half = list(range(FRAMES // 2, FRAMES))
    verdict = verdict_on(scan, turned(scan.poses, half, 10.0))
    assert verdict.band == "poor"
    assert "agree with each other and contradict the other frames" in verdict.reasons[0]
    assert "frame_00008, frame_00009" in verdict.reasons[0] and "and 2 more" in verdict.reasons[0]


def test_frames_that_are_all_wrong_are_not_taken_for_noise(scan):
    poses = scan.poses
    for k in range(FRAMES):
        poses = turned(poses, [k], 20.0 + 17.0 * k)
    verdict = verdict_on(scan, poses)
    assert verdict.band == "poor" and "the frames contradict each other" in verdict.reasons[0]


def test_stated_uncertainty_explains_what_it_covers_and_no_more(scan):
    """Right poses stay good with any stated uncertainty; a frame far beyond it is still named."""
    sigma = PoseSigma(0.5, 0.3, 0.5, 0.1)
    assert verdict_on(scan, scan.poses, sigma).band == "good"
    verdict = verdict_on(scan, turned(scan.poses, [5], 60.0), sigma)
    assert verdict.band == "poor" and named(scan, verdict.reasons[0]) == ["frame_00005"]
    slightly = turned(scan.poses, [5], 2.0)
    exact, rough = (
        compare_scan_frames(scan, slightly, [s] * FRAMES).frames[5] for s in (None, PoseSigma(3.0, 2.0, 1.0, 0.2))
    )
    assert rough.excess < exact.excess and rough.share >= exact.share


def test_noise_does_not_grow_with_wrong_poses(scan):
    """Projectors half a degree off have large epipolar residuals, but no more noise."""
    poses = scan.poses
    right = compare_scan_frames(scan, poses, [None] * FRAMES).noise_px
    projector = poses.T_world_projector.copy()
    turn = turned(poses, list(range(FRAMES)), 0.5)
    projector[:, :3, :3] = turn.T_world_projector[:, :3, :3]
    wrong = compare_scan_frames(scan, type(poses)(poses.T_world_camera, projector), [None] * FRAMES).noise_px
    assert wrong < 3 * right


def test_a_frame_that_nobody_else_saw_is_unconfirmed(scan):
    poses = turned(scan.poses, [5], 0.0)
    for T in (poses.T_world_camera, poses.T_world_projector):
        T[5, :3, 3] += 1e4
    verdict = verdict_on(scan, poses)
    assert verdict.band != "good"
    assert any("frame_00005: no other frame shows enough of the same surface" in reason for reason in verdict.reasons)


@pytest.mark.parametrize("axis, sigmas", [(0, 9.0), (1, 9.0), (2, 9.0), (1, 4.0)])
def test_frames_far_from_their_starts_are_named_by_how_far_they_turned(scan, axis, sigmas, monkeypatch):
    """Positions do not count; where no uncertainty was stated, the usual one does."""
    stated, angle = 0.5, sigmas * np.sqrt(3) * 0.5
    frames = tuple(replace(f, pose_sigma=PoseSigma(0.001, stated, 0.001, stated)) for f in scan.frames[:-1])
    frames += (replace(scan.frames[-1], pose_sigma=None),)
    T = scan.poses.T_world_camera.copy()
    turn = Rotation.from_rotvec(np.radians(angle) * np.eye(3)[axis]).as_matrix()
    T[[3, -1], :3, :3] = T[[3, -1], :3, :3] @ turn
    T[:, :3, 3] += 40.0
    found = departed_frames(replace(scan, frames=frames), DevicePoses(T, scan.poses.T_world_projector))
    assert [one.name for one in found] == ([scan.frames[3].name] if sigmas > 6 else [])
    for one in found:
        assert one.turned_deg == pytest.approx(angle, rel=1e-6) and one.sigma_deg == stated
        assert [r.band for r in departed_reasons(found)] == ["acceptable"]
        assert f"{one.name} ({angle:.1f} deg, stated 0.5)" in describe_departed(found)
    monkeypatch.setattr("sl_nerfstudio.review.verdict.USUAL_FRAME_ROTATION_DEG", stated)
    usual = departed_frames(replace(scan, frames=frames), DevicePoses(T, scan.poses.T_world_projector))
    assert [one.name for one in usual] == ([scan.frames[k].name for k in (3, -1)] if sigmas > 6 else [])
    for one in usual[1:]:
        assert f"{one.name} ({angle:.1f} deg, usual 0.5)" in describe_departed(usual)


# Groups that contradict each other, and weak places in a graph, against brute force.

edges_of_eight = st.lists(
    st.tuples(st.integers(0, 7), st.integers(0, 7)).filter(lambda e: e[0] < e[1]), max_size=16, unique=True
)


@given(edges_of_eight)
def test_bridges_are_those_of_graph_theory(edges):
    graph = networkx.Graph(edges)
    graph.add_nodes_from(range(8))
    found = bridges(edges, 8)
    assert {frozenset(edge) for edge, _ in found} == set(map(frozenset, networkx.bridges(graph)))
    for edge, part in found:
        graph.remove_edge(*edge)
        halves = sorted((networkx.node_connected_component(graph, end) for end in edge), key=lambda h: (len(h), min(h)))
        assert set(part) == halves[0]
        graph.add_edge(*edge)


@pytest.mark.parametrize("sizes", [(8,), (5, 3), (4, 4), (7, 1), (3, 3, 2)])
def test_groups_are_found_in_spite_of_pairs_that_agree_by_accident(sizes):
    label = np.repeat(np.arange(len(sizes)), sizes)
    rng = np.random.default_rng(0)
    excess = np.where(label[:, None] == label[None], 1.0, 8.0)
    for a, b in itertools.combinations(range(len(sizes)), 2):  # one accident between every two groups
        i, j = rng.choice(np.flatnonzero(label == a)), rng.choice(np.flatnonzero(label == b))
        if sizes[a] * sizes[b] > 3:
            excess[i, j] = excess[j, i] = 1.0
    groups = agreeing_groups(ring(excess))
    assert sorted(map(len, groups), reverse=True) == sorted(sizes, reverse=True)
    assert all(len(set(label[group])) == 1 for group in groups)


def test_frames_without_pairs_are_in_no_group():
    excess = np.full((4, 4), np.nan)
    excess[0, 1] = 1.0
    assert agreeing_groups(ring(excess)) == [[0, 1]]
    assert agreeing_groups(ring(np.full((3, 3), np.nan))) == []
