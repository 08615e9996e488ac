"""Every fact about a frame has a sentence, with its figures, and with what to do about it."""

import typing

import pytest

from sl_nerfstudio.processing.result import degeneracy_sentence, exclusion_sentence, uncertainty_sentence
from sl_nerfstudio.registration.result import (
    CoordinatesDisagree,
    Exclusion,
    NoCommonSurface,
    PairsContradict,
    PoorPair,
    SeparateComponent,
    SurfaceDisagrees,
    UncertainRotation,
    UndecidedProjector,
)
from sl_nerfstudio.relative_pose.estimation import Degeneracy, DegeneracyKind, estimate_relative_pose
from tests.relative_pose.two_views import view

DEGENERACIES: dict[str, tuple[Degeneracy, str]] = {
    "few points": (
        Degeneracy("few points", (37.0,)),
        "only 37 decoded pixels agree with each other; capture the object larger in the image, or with more light",
    ),
    "small part of the pattern": (
        Degeneracy("small part of the pattern", (12.0, 375.0)),
        "decoded pixels cover only 12 of 375 squares of the pattern; let more of the pattern fall on the object",
    ),
    "pure rotation": (
        Degeneracy("pure rotation", (0.4321,)),
        "a rotation of the projector alone, without any distance to the camera, explains the coordinates to within "
        "0.43 px; hold the projector farther from the camera",
    ),
    "small parallax": (
        Degeneracy("small parallax", (1.234,)),
        "camera rays and projector rays meet at only 1.2 degrees; hold the projector farther from the camera",
    ),
    "planar": (
        Degeneracy("planar", (0.5678,)),
        "all points lie in one plane to within 0.57 px, and a plane does not determine the pose; show parts at other "
        "depths in this view",
    ),
    "epipole in view": (
        Degeneracy("epipole in view", ()),
        "one device is in the other's view of the object, and depth cannot be measured around that place; move the "
        "projector to the side",
    ),
    "ambiguous": (
        Degeneracy("ambiguous", (0.874, 0.891)),
        "a second pose explains 87% of the coordinates, and this one 89%; show parts at other depths in this view",
    ),
    "many outliers": (
        Degeneracy("many outliers", (0.412,)),
        "41% of the coordinates contradict the rest; check the pattern file and the light",
    ),
    "poor fit": (
        Degeneracy("poor fit", (3.14,)),
        "coordinates miss their epipolar curves by 3.1 px; check the intrinsics of both devices and the projector's "
        "model (OPENCV or DOE)",
    ),
    "uncertain": (
        Degeneracy("uncertain", (0.614, 1.87)),
        "the pose is known only to 0.61 degrees (rotation) and 1.9 degrees (direction of the baseline)",
    ),
}

EXCLUSIONS: list[tuple[Exclusion, str]] = [
    (
        SurfaceDisagrees("a", 0.42),
        "only 42% of its surface agrees with that of the other frames where its pairs place it; the object moved, or "
        "the relative pose of this frame is wrong: capture this view again",
    ),
    (NoCommonSurface("a"), "no other frame shows any of its surface; capture views in between"),
    (
        SeparateComponent("a", ("a",), False, "b"),
        "its connection to the other frames is not certain; capture views between it and b",
    ),
    (
        SeparateComponent("a", ("a",), False, None),
        "its connection to the other frames is not certain; capture views between it and the other frames",
    ),
    (
        SeparateComponent("a", ("a", "c", "d"), False, "b"),
        "it and c, d form a group whose connection to the other frames is not certain; capture views between it and b",
    ),
    (
        SeparateComponent("a", ("a", "c", "d", "e", "f", "g"), False, None),
        "it and c, d, e and 2 more form a group whose connection to the other frames is not certain; capture views "
        "between it and the other frames",
    ),
    (
        SeparateComponent("a", ("a",), True, "b"),
        "its connection to the other frames may slip along the surface (of revolution, or a plane); capture views "
        "between it and b, with marks on the object (chalk, tape) or something beside it that does not look the same "
        "from all sides",
    ),
    (
        PairsContradict("a", 9, 6),
        "6 of its 9 pairs with other frames contradict the pose that the rest of them say; capture this view again, "
        "and views beside it",
    ),
    (
        CoordinatesDisagree("a", ("a",)),
        "its coordinates contradict those of the other frames wherever these place it; capture this view again",
    ),
    (
        CoordinatesDisagree("a", ("a", "b")),
        "its coordinates and those of b agree with each other but contradict those of the other frames wherever these "
        "place it; capture this view again",
    ),
    (
        PoorPair("a", "b", 0.11, 0.23, 0.15, 0.6),
        "its best partner, b, shares 11% of the surface, and 23% of what both saw agrees (needed: 15% and 60%); "
        "capture views in between",
    ),
    (
        UndecidedProjector("a", 12.3),
        "two poses of the projector, 12 degrees apart, explain its coordinates, and the other frames do not decide "
        "between them; show parts at other depths in this view",
    ),
]


def test_every_kind_is_here():
    assert DEGENERACIES.keys() == set(typing.get_args(DegeneracyKind))
    assert {type(fact) for fact, _ in EXCLUSIONS} == set(typing.get_args(Exclusion))


@pytest.mark.parametrize("kind", sorted(DEGENERACIES))
def test_degeneracies(kind):
    degeneracy, expected = DEGENERACIES[kind]
    assert degeneracy_sentence(degeneracy) == expected


@pytest.mark.parametrize(("exclusion", "expected"), EXCLUSIONS)
def test_exclusions(exclusion, expected):
    assert exclusion_sentence(exclusion) == expected


def test_a_frame_that_may_slip():
    assert uncertainty_sentence(UncertainRotation("a", 3.14)) == (
        "a: it may slip along the surface; its rotation is known only to 3.1 degrees (surface of revolution, or plane?)"
    )


def test_the_figures_that_a_frame_has_fit_their_sentences():
    kinds = set()
    for offset, relief in (((0.004, 0.0, 0.0), 1.0), ((1.0, 0.2, 0.0), 0.0), ((0.05, 0.04, -2.0), 1.0)):
        frame = view(offset=offset, relief=relief).noisy(0.3, seed=0)
        for degeneracy in estimate_relative_pose(*frame.arguments).degeneracies:
            assert len(degeneracy_sentence(degeneracy)) > 30
            kinds.add(degeneracy.kind)
    assert {"pure rotation", "planar", "epipole in view"} <= kinds
