"""The words in which mixed-up conventions are reported."""

import numpy as np

from sl_nerfstudio.scan.check.readings import PoseReading, Reading, ReadingFit
from sl_nerfstudio.scan.problem import Problem

APART = 0.2  # distance between frames' surfaces, in working distances, that is suspect

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


def key_of(reading: Reading) -> str:
    """The key of transforms.json that a mix-up concerns."""
    if reading.exchanged or reading.mirrored_x or reading.mirrored_y:
        return "sl_coords_path"
    return "projector_transform_matrix" if reading.camera == "as given" else "transform_matrix"


def describe(reading: Reading, given: ReadingFit, index: int | None = None) -> Problem:
    """The mix-up that `reading` undoes, in all frames or in frame `index`; `given` is the fit before."""
    residual = given.typical_px if index is None else float(given.residual_px[index])
    spread = given.typical_spread if index is None else float(given.spread[index])
    whom = "all frames" if index is None else "this frame"
    symptom = _symptom(residual, spread)
    if reading.exchanged or reading.mirrored_x or reading.mirrored_y:
        return _describe_coords(reading, f"do not fit the poses in {whom}: {symptom}")
    problem = f"does not fit the coordinates in {whom}: {symptom}"
    if reading.projector_unit != 1:
        return Problem(
            problem,
            f"the projector's position is in another unit than the camera's: times {reading.projector_unit:g} it fits",
            "give all positions in the scan's unit",
        )
    whose: list[tuple[str, PoseReading]]
    if reading.camera == reading.projector:
        whose = [("camera and projector matrices", reading.camera)]
    else:
        whose = [("the camera matrices", reading.camera), ("the projector matrices", reading.projector)]
    wrong = [(who, how) for who, how in whose if how != "as given"]
    cause = " and ".join(f"{who} {_CAUSES[how]}" for who, how in wrong)
    remedy = "; ".join(f"{who}: {_REMEDIES[how]}" for who, how in wrong)
    return Problem(problem, f"{cause}: read that way they fit", f"store device to world in OpenGL axes ({remedy})")


def _symptom(residual: float, spread: float) -> str:
    if np.isinf(residual):
        return "most points triangulate behind the camera or the projector"
    if spread > APART:
        return f"the frames' surfaces lie {spread:.1f} times the working distance apart"
    return f"camera rays and projector rays miss each other by {residual:.0f} px"


def _describe_coords(reading: Reading, problem: str) -> Problem:
    done = [
        *(["x and y exchanged"] if reading.exchanged else []),
        *(["x counted from the right"] if reading.mirrored_x else []),
        *(["y counted from below"] if reading.mirrored_y else []),
    ]
    undo = [
        *(["exchange the two channels"] if reading.exchanged else []),
        *(["x := projector w - x"] if reading.mirrored_x else []),
        *(["y := projector h - y"] if reading.mirrored_y else []),
    ]
    return Problem(
        problem,
        f"the coordinates have {' and '.join(done)}: read that way they fit",
        f"store (x, y), x to the right and y down from the pattern's upper left corner: {', then '.join(undo)}",
    )


def hopeless(given: ReadingFit, bad: int, count: int) -> Problem:
    """Poses that no known mix-up explains, in `bad` of `count` frames."""
    symptom = "most points triangulate behind a device" if np.isinf(given.typical_px) else f"{given.typical_px:.0f} px"
    return Problem(
        f"does not fit the coordinates in {bad} of {count} frames (epipolar residual: {symptom})",
        "poses of another scan, in another order, in other axes, or wrong intrinsics; no single mix-up explains it",
        "check that frames, poses and intrinsics belong together, and their axes against docs/scan-format.md",
    )


def wrong_unit(metres: float) -> Problem:
    """A working distance that no scanner has."""
    return Problem(
        f"would put the object {metres:.3g} m from the camera",
        "lengths are in another unit than stated (m and mm exchanged?)",
        'state the unit that the poses are in, or "arbitrary" if it is not known',
    )
