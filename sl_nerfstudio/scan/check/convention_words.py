"""The words in which wrong conventions are reported."""

import numpy as np

from sl_nerfstudio.scan.check.interpretations import GeometricFit, Interpretation, PoseConvention
from sl_nerfstudio.scan.problem import Problem

APART = 0.2  # suspicious distance between the surfaces of frames, in working distances

_CAUSES = {
    "inverted": "map world to device instead of device to world",
    "OpenCV axes": "have OpenCV's device axes (y down, looking along +z)",
    "inverted, OpenCV axes": "are OpenCV extrinsics (world to device, y down, looking along +z)",
}
_REMEDIES = {
    "inverted": "invert them",
    "OpenCV axes": "multiply them on the right by diag(1, -1, -1, 1)",
    "inverted, OpenCV axes": "invert them, then multiply on the right by diag(1, -1, -1, 1)",
}


def key_of(interpretation: Interpretation) -> str:
    """The key of transforms.json that a mistake concerns."""
    if interpretation.swapped or interpretation.mirrored_x or interpretation.mirrored_y:
        return "sl_coords_path"
    return "projector_transform_matrix" if interpretation.camera == "as given" else "transform_matrix"


def describe(interpretation: Interpretation, given: GeometricFit, index: int | None = None) -> Problem:
    """The mistake that `interpretation` undoes, in all frames or in frame `index`; `given` is the fit before."""
    residual = given.typical_px if index is None else float(given.residual_px[index])
    spread = given.typical_spread if index is None else float(given.spread[index])
    which = "all frames" if index is None else "this frame"
    symptom = _symptom(residual, spread)
    if interpretation.swapped or interpretation.mirrored_x or interpretation.mirrored_y:
        return describe_coords(interpretation, f"do not fit the poses in {which}: {symptom}")
    problem = f"does not fit the coordinates in {which}: {symptom}"
    if interpretation.projector_unit != 1:
        return Problem(
            problem,
            f"the projector's position is in another unit than the camera's: multiplied by "
            f"{interpretation.projector_unit:g} it fits",
            "give all positions in the scan's unit",
        )
    whose: list[tuple[str, PoseConvention]]
    if interpretation.camera == interpretation.projector:
        whose = [("camera and projector matrices", interpretation.camera)]
    else:
        whose = [("the camera matrices", interpretation.camera), ("the projector matrices", interpretation.projector)]
    wrong = [(who, how) for who, how in whose if how != "as given"]
    cause = " and ".join(f"{who} {_CAUSES[how]}" for who, how in wrong)
    remedy = "; ".join(f"{who}: {_REMEDIES[how]}" for who, how in wrong)
    return Problem(
        problem, f"{cause}: interpreted that way they fit", f"store device to world in OpenGL axes ({remedy})"
    )


def _symptom(residual: float, spread: float) -> str:
    if np.isinf(residual):
        return "most points triangulate behind the camera or the projector"
    if spread > APART:
        return f"the surfaces of the frames are {spread:.1f} times the working distance apart"
    return f"camera rays and projector rays miss each other by {residual:.0f} px"


def describe_coords(interpretation: Interpretation, problem: str) -> Problem:
    """Coordinates with exchanged or mirrored axes; `problem` says how it shows."""
    done = [
        *(["x and y swapped"] if interpretation.swapped else []),
        *(["x counted from the right"] if interpretation.mirrored_x else []),
        *(["y counted from below"] if interpretation.mirrored_y else []),
    ]
    undo = [
        *(["swap the two channels"] if interpretation.swapped else []),
        *(["x := projector w - x"] if interpretation.mirrored_x else []),
        *(["y := projector h - y"] if interpretation.mirrored_y else []),
    ]
    return Problem(
        problem,
        f"the coordinates have {' and '.join(done)}: interpreted that way they fit",
        f"store (x, y), x to the right and y down from the pattern's upper left corner: {', then '.join(undo)}",
    )


def hopeless(given: GeometricFit, bad: int, count: int) -> Problem:
    """Poses that no known mistake explains, in `bad` of `count` frames."""
    symptom = "most points triangulate behind a device" if np.isinf(given.typical_px) else f"{given.typical_px:.0f} px"
    return Problem(
        f"does not fit the coordinates in {bad} of {count} frames (epipolar residual: {symptom})",
        "the poses are those of another scan, in another order or in other axes, or the intrinsics are wrong; "
        "no single known mistake explains it",
        "check that frames, poses and intrinsics are of the same scan, and compare the axes with docs/scan-format.md",
    )


def wrong_unit(metres: float) -> Problem:
    """A working distance that is impossible for a scanner."""
    return Problem(
        f"would put the object {metres:.3g} m from the camera",
        "lengths are in another unit than stated (m and mm mixed up?)",
        'state the unit that the poses are in, or "arbitrary" if it is unknown',
    )


def far_away(times: float) -> Problem:
    """A device that is `times` as far from the others as they usually are."""
    return Problem(
        f"puts the device {times:.2g} times as far from the other devices as is usual in this scan",
        "registration failed for this frame, or its position is in another unit",
        "register it again, or leave the frame out",
    )
