"""Do poses and coordinates follow the conventions of this format? Decided by triangulating correspondences.

Starting poses may be rough: frames wrong by 10 degrees, relative poses by a few. A mistake is therefore reported only
if the poses as given fit badly *and* undoing one known mistake makes them fit several times better; or if nearly all
frames are worse than any calibration error can make them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Y_Z_DOWN, Device
from sl_nerfstudio.scan.check_geometry import Correspondences, GeometricFit, OtherClouds, fit_geometry
from sl_nerfstudio.scan.check_mixed_poses import SUSPECT, SUSPECT_SIGMAS, copied_poses, is_suspect, mixed_poses
from sl_nerfstudio.scan.document import Problem

# Other conventions that poses and coordinates may follow by mistake, and how well each of them fits.

PoseConvention = Literal["as given", "inverted", "OpenCV axes", "inverted, OpenCV axes"]
POSE_CONVENTIONS: tuple[PoseConvention, ...] = ("as given", "inverted", "OpenCV axes", "inverted, OpenCV axes")


@dataclass(frozen=True)
class Interpretation:
    """One way to interpret a scan. Coordinates are first swapped, then mirrored."""

    camera: PoseConvention = "as given"
    projector: PoseConvention = "as given"
    projector_unit: float = 1.0  # factor on the projector's position
    swapped: bool = False
    mirrored_x: bool = False
    mirrored_y: bool = False

    @property
    def key(self) -> str:
        """The key of transforms.json that the mistake concerns."""
        if self in OTHER_AXES:
            return "sl_coords_path"
        return "projector_transform_matrix" if self.camera == "as given" else "transform_matrix"


OTHER_AXES = tuple(
    Interpretation(swapped=swapped, mirrored_x=x, mirrored_y=y)
    for swapped, x, y in product((False, True), repeat=3)
    if swapped or x or y
)
"""Every exchange and reversal of the axes of coordinates."""


def other_interpretations() -> Iterator[Interpretation]:
    """Every known mistake, the more common ones first."""
    for both in POSE_CONVENTIONS[1:]:
        yield Interpretation(camera=both, projector=both)
    for camera, projector in product(POSE_CONVENTIONS, repeat=2):
        if camera != projector:
            yield Interpretation(camera=camera, projector=projector)
    yield from OTHER_AXES
    yield Interpretation(projector_unit=1e3)
    yield Interpretation(projector_unit=1e-3)


def apply_interpretation(interpretation: Interpretation, frame: Correspondences, projector: Device) -> Correspondences:
    """The frame with its poses and coordinates interpreted that way, in the conventions of this format."""
    T_world_projector = _converted_pose(frame.T_world_projector, interpretation.projector).copy()
    T_world_projector[:3, 3] *= interpretation.projector_unit
    return replace(
        frame,
        T_world_camera=_converted_pose(frame.T_world_camera, interpretation.camera),
        T_world_projector=T_world_projector,
        uv_projector=converted_coords(frame.uv_projector, interpretation, (projector.w, projector.h)),
    )


def _converted_pose(T: Float64[ndarray, "4 4"], convention: PoseConvention) -> Float64[ndarray, "4 4"]:
    out = np.linalg.inv(T) if convention.startswith("inverted") else T
    return out @ Y_Z_DOWN if convention.endswith("OpenCV axes") else out


def converted_coords(uv: Float[ndarray, "n 2"], how: Interpretation, size: tuple[int, int]) -> Float[ndarray, "n 2"]:
    """Coordinates in a pattern of `size` (w, h), with axes exchanged and mirrored."""
    x, y = uv.T[::-1] if how.swapped else uv.T
    return np.stack([size[0] - x if how.mirrored_x else x, size[1] - y if how.mirrored_y else y], -1)


# The words in which wrong conventions are reported.

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


def describe(interpretation: Interpretation, given: GeometricFit, index: int | None = None) -> Problem:
    """The mistake that `interpretation` undoes, in all frames or in frame `index`; `given` is the fit before."""
    residual = given.typical_px if index is None else float(given.residual_px[index])
    spread = given.typical_spread if index is None else float(given.spread[index])
    which = "all frames" if index is None else "this frame"
    symptom = _symptom(residual, spread)
    if interpretation in OTHER_AXES:
        return describe_coords(interpretation, f"do not fit the poses in {which}: {symptom}")
    problem = f"does not fit the coordinates in {which}: {symptom}"
    if interpretation.projector_unit != 1:
        return Problem(
            problem,
            f"the projector's position is in another unit than the camera's: multiplied by "
            f"{interpretation.projector_unit:g} it fits",
            "give all positions in the scan's unit",
        )
    whose = {"the camera matrices": interpretation.camera, "the projector matrices": interpretation.projector}
    if interpretation.camera == interpretation.projector:
        whose = {"camera and projector matrices": interpretation.camera}
    wrong = [(who, how) for who, how in whose.items() if how != "as given"]
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


_AXES = {  # what was done, and what undoes it
    "swapped": ("x and y swapped", "swap the two channels"),
    "mirrored_x": ("x counted from the right", "x := projector w - x"),
    "mirrored_y": ("y counted from below", "y := projector h - y"),
}


def describe_coords(interpretation: Interpretation, problem: str) -> Problem:
    """Coordinates with exchanged or mirrored axes; `problem` says how it shows."""
    done, undo = zip(*(words for name, words in _AXES.items() if getattr(interpretation, name)), strict=True)
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


# Epipolar residuals as fractions of the projector's focal length: angles in radians.
_ROUGH = 0.03  # 1.7 degrees: in a scan worse than that, a single frame that fits better tells nothing
_SUSPECT_FRAME = 0.05  # of one frame among good ones
_FITS = 0.05  # the largest residual of an interpretation that "fits"
_HOPELESS = 0.35  # 19 degrees: no calibration is that wrong
_MUCH_BETTER = 0.2  # factor by which the right interpretation must lower the residual
_CLEARLY = 0.1  # the same where it stays beyond what is stated
_MUCH_CLOSER = 0.4  # factor by which the right interpretation must lower the distance between surfaces
_ONE_SURFACE = 0.1  # the largest distance it may leave, in working distances, with frames wrong by 10 degrees
_MOST = 0.9  # share of hopeless frames that makes a scan hopeless
_FAR = 100.0  # times the median distance of all devices from their middle; rings and walls have 1 to 2
_NEAREST, _FARTHEST = 1e-3, 100.0  # metres; working distances outside this range mean a wrong unit


def convention_problems(
    frames: Sequence[Correspondences], projector: Device, metres: float | None
) -> Iterable[tuple[str | None, str, Problem]]:
    """(frame or None, key, problem) of poses, coordinates and units that cannot be right as they are.

    `metres` is the length of the scan's unit, None if unknown.
    """
    given = fit_geometry(frames, projector)
    focal = (projector.fl_x + projector.fl_y) / 2
    found = copied_poses(frames, given, focal)
    if found is None:
        interpretation = _better_interpretation(frames, projector, given, focal)
        found = interpretation and (interpretation.key, describe(interpretation, given))
    found = found or mixed_poses(frames, projector, given)
    if found is not None:
        yield None, *found
        return
    lost = given.residual_px > _HOPELESS * focal
    if lost.mean() >= _MOST:
        yield None, "transform_matrix", hopeless(given, int(lost.sum()), len(frames))
        return
    explained: set[int] = set()
    if len(frames) > 2 and given.typical_px <= _ROUGH * focal:
        others = OtherClouds(given.clouds)
        for index, frame in enumerate(frames):
            own = _better_interpretation_of_frame(frames, index, projector, given, others, focal)
            if own is not None:
                explained.add(index)
                yield frame.name, own.key, describe(own, given, index)
    for index, key, times in _far_devices(frames):
        if index not in explained:
            problem = Problem(
                f"puts the device {times:.2g} times as far from the other devices as is usual in this scan",
                "registration failed for this frame, or its position is in another unit",
                "register it again, or leave the frame out",
            )
            yield frames[index].name, key, problem
    if metres is not None and not _NEAREST <= given.depth * metres <= _FARTHEST:
        problem = Problem(
            f"would put the object {given.depth * metres:.3g} m from the camera",
            "lengths are in another unit than stated (m and mm mixed up?)",
            'state the unit that the poses are in, or "arbitrary" if it is unknown',
        )
        yield None, "units", problem


def _better_interpretation(
    frames: Sequence[Correspondences], projector: Device, given: GeometricFit, focal: float
) -> Interpretation | None:
    """The interpretation under which the whole scan fits; None if it fits as it is, or nothing helps."""
    if not is_suspect(given, focal) and given.typical_px <= SUSPECT * focal and given.typical_spread <= APART:
        return None
    found: list[tuple[float, Interpretation]] = []
    for interpretation in other_interpretations():
        fit = fit_geometry([apply_interpretation(interpretation, frame, projector) for frame in frames], projector)
        stands = not fit.typical_excess > max(SUSPECT_SIGMAS, _CLEARLY * given.typical_excess)
        if stands and _explains(given.typical_px, given.typical_spread, fit.typical_px, fit.typical_spread, focal):
            found.append((_badness(fit.typical_px, fit.typical_spread, focal), interpretation))
    return min(found, key=lambda item: item[0])[1] if found else None


def _better_interpretation_of_frame(
    frames: Sequence[Correspondences],
    index: int,
    projector: Device,
    given: GeometricFit,
    others: OtherClouds,
    focal: float,
) -> Interpretation | None:
    """The interpretation of one frame alone under which it fits the others."""
    residual, spread = float(given.residual_px[index]), float(given.spread[index])
    if given.depth == 0 or (residual <= _SUSPECT_FRAME * focal and spread <= APART):
        return None
    found: list[tuple[float, Interpretation]] = []
    for interpretation in other_interpretations():
        alone = fit_geometry([apply_interpretation(interpretation, frames[index], projector)], projector)
        px = alone.typical_px
        if px > _FITS * focal:
            continue
        apart = others.distance(alone.clouds[0], index) / given.depth
        if apart < APART and _explains(residual, spread, px, apart, focal):
            found.append((_badness(px, apart, focal), interpretation))
    return min(found, key=lambda item: item[0])[1] if found else None


def _far_devices(frames: Sequence[Correspondences]) -> Iterator[tuple[int, str, float]]:
    """(frame, key, distance from the middle of all devices in median distances) of devices that are far away."""
    cameras = np.stack([frame.T_world_camera[:3, 3] for frame in frames])
    projectors = np.stack([frame.T_world_projector[:3, 3] for frame in frames])
    everything = np.concatenate([cameras, projectors])
    middle = np.median(everything, 0)
    usual = max(float(np.median(np.linalg.norm(everything - middle, axis=1))), 1e-300)
    for key, positions in (("transform_matrix", cameras), ("projector_transform_matrix", projectors)):
        times = np.linalg.norm(positions - middle, axis=1) / usual
        for index in np.flatnonzero(times > _FAR).tolist():
            yield index, key, float(times[index])


def _explains(px_before: float, spread_before: float, px: float, spread: float, focal: float) -> bool:
    """Whether an interpretation fits, and so much better than the one before that it cannot be chance."""
    if px > _FITS * focal:
        return False
    if px_before > SUSPECT * focal and px < _MUCH_BETTER * px_before:
        return px < SUSPECT * focal or spread <= max(APART, spread_before)
    # The rays meet equally well in both: only the agreement of the frames decides. Views that never overlap
    # (a room seen from its middle) may come closer to each other when misinterpreted, but not to one surface.
    return spread_before > APART and spread < min(_MUCH_CLOSER * spread_before, _ONE_SURFACE) and px < 2 * px_before + 1


def _badness(px: float, spread: float, focal: float) -> float:
    """Orders interpretations that fit: both parts are about 0.01 for a good scan interpreted correctly."""
    return px / focal + min(spread, 1.0)
