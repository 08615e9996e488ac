"""Sentences for what relative pose estimation and registration found out about frames."""

from sl_nerfstudio.registration.result import (
    CoordinatesDisagree,
    Exclusion,
    NoCommonSurface,
    PairsContradict,
    SeparateComponent,
    SurfaceDisagrees,
    UncertainRotation,
    UndecidedProjector,
)
from sl_nerfstudio.relative_pose.degeneracy import Degeneracy, DegeneracyKind
from sl_nerfstudio.verdict.verdict import listed

_LISTED = 3  # other frames of a group in a sentence
_DEGENERACIES: dict[DegeneracyKind, str] = {
    "few points": "only {:.0f} decoded pixels agree with each other; capture the object larger in the image, or with "
    "more light",
    "small part of the pattern": "decoded pixels cover only {:.0f} of {:.0f} squares of the pattern; let more of the "
    "pattern fall on the object",
    "pure rotation": "a rotation of the projector alone, without any distance to the camera, explains the coordinates "
    "to within {:.2g} px; hold the projector farther from the camera",
    "small parallax": "camera rays and projector rays meet at only {:.2g} degrees; hold the projector farther from the "
    "camera",
    "planar": "all points lie in one plane to within {:.2g} px, and a plane does not determine the pose; show parts at "
    "other depths in this view",
    "epipole in view": "one device is in the other's view of the object, and depth cannot be measured around that "
    "place; move the projector to the side",
    "ambiguous": "a second pose explains {:.0%} of the coordinates, and this one {:.0%}; show parts at other depths in "
    "this view",
    "many outliers": "{:.0%} of the coordinates contradict the rest; check the pattern file and the light",
    "poor fit": "coordinates miss their epipolar curves by {:.2g} px; check the intrinsics of both devices and the "
    "projector's model (OPENCV or DOE)",
    "uncertain": "the pose is known only to {:.2g} degrees (rotation) and {:.2g} degrees (direction of the baseline)",
}


def degeneracy_sentence(degeneracy: Degeneracy) -> str:
    """What was found in a frame, and what to do about it."""
    return _DEGENERACIES[degeneracy.kind].format(*degeneracy.figures)


def exclusion_sentence(exclusion: Exclusion) -> str:
    """Why a frame was not registered, and what to do about it."""
    if isinstance(exclusion, SurfaceDisagrees):
        return (
            f"only {exclusion.fitness:.0%} of its surface agrees with that of the other frames where its pairs place "
            "it; the object moved, or the relative pose of this frame is wrong: capture this view again"
        )
    if isinstance(exclusion, NoCommonSurface):
        return "no other frame shows any of its surface; capture views in between"
    if isinstance(exclusion, PairsContradict):
        return (
            f"{exclusion.contradicting} of its {exclusion.pairs} pairs with other frames contradict the pose that the "
            "rest of them say; capture this view again, and views beside it"
        )
    if isinstance(exclusion, UndecidedProjector):
        return (
            f"two poses of the projector, {exclusion.angle_deg:.0f} degrees apart, explain its coordinates, and the "
            "other frames do not decide between them; show parts at other depths in this view"
        )
    if isinstance(exclusion, CoordinatesDisagree):
        others = [name for name in exclusion.group if name != exclusion.frame]
        with_others = f" and those of {listed(others, _LISTED)} agree with each other but" if others else ""
        who = f"its coordinates{with_others}"
        return f"{who} contradict those of the other frames wherever these place it; capture this view again"
    if isinstance(exclusion, SeparateComponent):
        others = [name for name in exclusion.component if name != exclusion.frame]
        group = f"it and {listed(others, _LISTED)} form a group whose" if others else "its"
        remedy = f"between it and {exclusion.partner}" if exclusion.partner else "between it and the other frames"
        why = "may slip along the surface (of revolution, or a plane)" if exclusion.slips else "is not certain"
        more = (
            ", with marks on the object (chalk, tape) or something beside it that does not look the same from all sides"
        )
        return f"{group} connection to the other frames {why}; capture views {remedy}{more if exclusion.slips else ''}"
    return (
        f"its best partner, {exclusion.partner}, shares {exclusion.overlap:.0%} of the surface, and "
        f"{exclusion.fitness:.0%} of what both saw agrees (needed: {exclusion.least_overlap:.0%} and "
        f"{exclusion.least_fitness:.0%}); capture views in between"
    )


def uncertainty_sentence(uncertainty: UncertainRotation) -> str:
    """What is uncertain about a registered frame."""
    return (
        f"{uncertainty.frame}: it may slip along the surface; its rotation is known only to "
        f"{uncertainty.sigma_deg:.1f} degrees (surface of revolution, or plane?)"
    )
