"""Components of frames: which are joined, and where."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.assembly import Assembly
from sl_nerfstudio.registration.evidence import (
    Commonness,
    Comparison,
    FrameEvidence,
    KeptResiduals,
    ScanEvidence,
    frame_evidence,
)
from sl_nerfstudio.registration.pairs import LEAST_ODDS, PairMatch, Rival
from sl_nerfstudio.registration.pose_graph import Pivots
from sl_nerfstudio.registration.surfaces import frame_cloud
from tests.bundle_adjustment.analytic import camera_of, images_of, rig_of
from tests.registration.analytic_clouds import clouds_of, difference, part_of, rolled, similarities_of
from tests.registration.graph_edges import edge, turned
from tests.registration.shaped_clouds import cloud_of_depth, relief

SIZE, FRAMES = 70, 8
RIG = part_of(rig_of(18, SIZE), list(range(FRAMES)))  # 20 degrees from frame to frame
TRUE = similarities_of(RIG.T_world_camera.numpy(), RIG.T_camera_projector[:, :3, 3].norm(dim=-1).numpy())
FIRST, SECOND = [(0, 1), (1, 2), (2, 3), (0, 2)], [(4, 5), (5, 6), (6, 7), (5, 7)]  # two blocks


@pytest.fixture(scope="module")
def frames() -> list[FrameEvidence]:
    return [frame_evidence(c) for c in clouds_of(RIG, SIZE, noise=0.1)]


def evidence_of(frames) -> ScanEvidence:
    """Of frames of whose points no pair has shown anything."""
    return ScanEvidence(KeptResiduals(frames), [Commonness.none(len(f.points)) for f in frames], np.ones(len(frames)))


def assembly_of(frames, edges, **kwargs) -> Assembly:
    pivots = Pivots(np.stack([f.centroid for f in frames]), np.array([f.radius for f in frames]))
    return Assembly(evidence_of(frames), pivots, edges, **kwargs)


def assembled(frames, edges, **kwargs):
    return assembly_of(frames, edges, **kwargs).grow()


def right(pairs, **kwargs) -> list[PairMatch]:
    return [edge(TRUE, i, j, **kwargs) for i, j in pairs]


def wrong(frames, i: int, j: int, degrees: float = 40.0, **kwargs) -> PairMatch:
    """A registration that is off by a rotation about the object."""
    true = edge(TRUE, i, j, **kwargs)
    return replace(true, S_target_source=turned(true.S_target_source, degrees, frames[j].centroid))


def rival(frames, i: int, j: int, degrees: float, log_odds: float = 0.0) -> Rival:
    return Rival(wrong(frames, i, j, degrees).S_target_source, log_odds)


def frames_of(components) -> list[list[int]]:
    return [sorted(c) for c in components]


def assert_right(component) -> None:
    """All frames of a component are where they belong, to the first of them."""
    first = next(iter(component))
    for k, S in component.items():
        expected = component[first] @ TRUE[first].inverse() @ TRUE[k]
        angle, shift, scale = difference(S, expected, np.zeros(3))
        assert angle < 0.5 and shift < 0.05 and scale < 0.01


@pytest.mark.parametrize("across", [[(3, 4)], [(3, 4), (2, 4), (3, 5)]], ids=["one pair", "several pairs"])
def test_pairs_that_determine_everything_join_two_blocks_in_either_direction(frames, across):
    edges = right([*FIRST, *SECOND, *across])
    edges[::2] = [
        replace(e, source=e.target, target=e.source, S_target_source=e.S_target_source.inverse()) for e in edges[::2]
    ]
    (whole,) = assembled(frames, edges)
    assert sorted(whole) == list(range(FRAMES))
    assert_right(whole)


@pytest.mark.parametrize("degrees", [15, 25, 40, 90, 180])
def test_two_blocks_with_one_wrong_pair_between_them_stay_apart(frames, degrees):
    """The pair is as good as any by its own figures; the frames across contradict it."""
    components = assembled(frames, [*right([*FIRST, *SECOND]), wrong(frames, 3, 4, degrees)])
    assert frames_of(components) == [[0, 1, 2, 3], [4, 5, 6, 7]]
    for component in components:
        assert_right(component)


@pytest.mark.parametrize("degrees", [0, 40])
@pytest.mark.parametrize("factor", [70.0, 300.0])
def test_a_surface_of_a_giant_holds_nothing_together(frames, factor, degrees):
    """It hides all that the others saw, and contradicts none of it."""
    e = wrong(frames, 3, 4, degrees)
    R, source, target = e.S_target_source.R, frames[3].centroid, frames[4].centroid
    giant = Similarity(factor, R, target - factor * R @ source)
    edges = [*right([*FIRST, *SECOND]), replace(e, S_target_source=giant)]
    assert frames_of(assembled(frames, edges)) == [[0, 1, 2, 3], [4, 5, 6, 7]]


def test_frames_agree_as_far_as_their_relative_poses_may_err(frames):
    """A projector that is off by 1.5 sigma bends and moves its frame's surface by more than its noise."""
    coords, cloud = images_of(RIG, SIZE)[4].numpy(), clouds_of(RIG, SIZE, noise=0.1)[4]
    T, off_deg = cloud.pose.T_camera_projector.copy(), 0.5
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("y", off_deg, degrees=True).as_matrix()
    covariance = np.diag([np.radians(off_deg / 1.5) ** 2] * 3 + [1e-8] * 2)
    pose = replace(cloud.pose, T_camera_projector=T, covariance=covariance)
    bent = frame_evidence(frame_cloud("bent", coords, camera_of(SIZE), cloud.projector, pose))
    scan = evidence_of([*frames[:4], bent, *frames[5:]])
    for partner in (2, 3, 5):
        odds, agreeing, expected = scan.agreement(4, partner, TRUE[partner].inverse() @ TRUE[4])
        assert odds > LEAST_ODDS and agreeing > 0.95 * expected > 0.5


def test_right_pairs_outvote_a_wrong_one_that_seems_better(frames):
    edges = [*right([*FIRST, *SECOND, (3, 4), (2, 4)]), wrong(frames, 3, 5, 40, log_odds=300.0)]
    (whole,) = assembled(frames, edges)
    assert sorted(whole) == list(range(FRAMES))
    assert_right(whole)


@pytest.mark.parametrize("said", [0.0, -60.0], ids=["as good", "worse"])
def test_a_rival_counts_by_what_the_frames_saw(frames, said):
    """Not by what its pair says: only what is the same after half a turn is not decided."""
    doubtful = edge(TRUE, 3, 4, rivals=(rival(frames, 3, 4, 30, said),))
    (whole,) = assembled(frames, [*right([*FIRST, *SECOND]), doubtful])
    assert_right(whole)
    half = Rival(Similarity(1.0, rolled(180), np.zeros(3)), said)
    for odd, decided in ((0.0, False), (0.35, True)):
        both = [frame_evidence(cloud_of_depth(lambda x, y, odd=odd: relief(x, y, odd)))] * 2
        alike = edge([Similarity.identity()] * 2, 0, 1, rivals=(half,))
        assert (assembly_of(both, [alike]).decide(*({k: Similarity.identity()} for k in (1, 0))) is not None) is decided


def test_the_order_of_capture_decides_only_what_surfaces_do_not():
    same, half = Similarity.identity(), Similarity(1.0, rolled(180), np.zeros(3))
    for odd, usual, true in ((0.0, same, same), (0.0, half, half), (0.35, half, same)):
        frames = [frame_evidence(cloud_of_depth(lambda x, y, odd=odd: relief(x, y, odd)))] * 2
        found = assembly_of(
            frames,
            [edge([same, same], 0, 1, rivals=(Rival(half, 0.0),))],
            prior=lambda i, j, S, usual=usual: -25.0 * float(np.linalg.norm(S.R - usual.R) > 1),
        )
        (whole,) = found.grow()
        np.testing.assert_allclose((whole[1].inverse() @ whole[0]).R, true.R, atol=1e-9)


@pytest.mark.parametrize("known", [False, True])
def test_frames_that_agree_across_two_sides_that_look_the_same_say_nothing(frames, known):
    """Where a turn is known to show the same, frames that face each other after it do not lead for that."""
    assembly, half = assembly_of(frames, right(FIRST)), turned(Similarity.identity(), 180, np.zeros(3))
    first, second = {0: TRUE[0]}, {1: TRUE[1]}
    nodes = [assembly.settled(first, second, S) for S in (Similarity.identity(), half)]
    leads = assembly.compare(first, second, nodes, alike=known).leads
    assert (leads[0, 1] > 5 * LEAST_ODDS) is not known
    assert abs(leads[0, 1]) < 1e-9 or not known


def test_pairs_that_are_undecided_alone_decide_together(frames):
    """What one takes for possible, the others do not: only the truth is said by all."""
    edges = right([*FIRST, *SECOND])
    edges += [edge(TRUE, i, j, rivals=(rival(frames, i, j, turn),))
              for (i, j), turn in zip([(3, 4), (2, 4), (3, 5)], (30, -35, 60), strict=True)]  # fmt: skip
    (whole,) = assembled(frames, edges)
    assert_right(whole)


@settings(max_examples=2)
@given(st.randoms(use_true_random=False))
def test_the_result_does_not_depend_on_the_order_of_the_edges(frames, random):
    edges = right([*FIRST, *SECOND, (2, 4)])
    edges.append(wrong(frames, 3, 4, 50))
    edges = [replace(e, log_odds=100.0 + k) for k, e in enumerate(edges)]
    expected = assembled(frames, edges)
    found = assembled(frames, random.sample(edges, len(edges)))
    assert frames_of(found) == frames_of(expected)
    for a, b in zip(found, expected, strict=True):
        first = min(a)
        for k in a:
            relative = [(c[first].inverse() @ c[k]).matrix() for c in (a, b)]
            np.testing.assert_allclose(relative[0], relative[1], atol=1e-6)


@pytest.mark.parametrize("odd", [0.0, 0.35], ids=["the same", "another"])
def test_an_object_looks_alike_after_a_turn_if_its_frames_say_so_and_not_for_what_a_pair_says(odd):
    same, half = Similarity.identity(), Similarity(1.0, rolled(180), np.zeros(3))
    frames = [frame_evidence(cloud_of_depth(lambda x, y: relief(x, y, odd)))] * 2
    for known, alike in ((half, odd == 0), (Similarity(1.0, rolled(90), np.zeros(3)), False)):
        assembly = assembly_of(frames, [edge([same, same], 0, 1, rivals=(Rival(known, 0.0),))])
        assert assembly.looks_alike({0: same, 1: same}, half) is alike


class OneFrameIsWrong(ScanEvidence):
    """Every pair says by 15 nats that the first place is right, those of the last frame by 500 that the second is."""

    def comparison(self, source, target, places):
        lead = -500.0 if FRAMES - 1 in (source, target) else 15.0
        shared = lead * np.sign(np.arange(len(places)) - np.arange(len(places))[:, None])
        return replace(Comparison.none(len(places)), shared=shared, odds=np.full(len(places), 50.0))


def test_one_frame_whose_own_shape_is_wrong_decides_nothing_against_all_others(frames):
    """By a wrong pose of its projector: what it contradicts by hundreds of nats is no more than that."""
    assembly = assembly_of(frames, right(FIRST + SECOND))
    scan = assembly_of(frames, [])._scan
    assembly._scan = OneFrameIsWrong(scan._residuals, scan.common, scan.noise)
    first, second = ({k: TRUE[k] for k in part} for part in (range(4), range(4, FRAMES)))
    aside = {k: turned(S, 20.0, np.zeros(3)) for k, S in second.items()}
    found = assembly.compare(first, second, [{**first, **second}, {**first, **aside}])
    assert found.leads[0, 1] > LEAST_ODDS
