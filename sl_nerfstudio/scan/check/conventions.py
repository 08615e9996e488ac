"""Do poses and coordinates follow the conventions of this format? Decided by triangulating correspondences.

Starting poses may be rough: frames wrong by 10 degrees, relative poses by a few. A mistake is therefore reported only
if the poses as given fit badly *and* undoing one known mistake makes them fit several times better; or if nearly all
frames are worse than any calibration error can make them.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.check.convention_words import APART, describe, far_away, hopeless, key_of, wrong_unit
from sl_nerfstudio.scan.check.correspondences import Correspondences
from sl_nerfstudio.scan.check.interpretations import (
    GeometricFit,
    Interpretation,
    apply_interpretation,
    fit_geometry,
    other_interpretations,
)
from sl_nerfstudio.scan.check.other_clouds import OtherClouds
from sl_nerfstudio.scan.problem import Problem

# Epipolar residuals as fractions of the projector's focal length: angles in radians.
_SUSPECT = 0.01  # 0.6 degrees: worse than auto-calibration usually is
_SUSPECT_FRAME = 0.05  # of one frame among good ones
_FITS = 0.05  # the largest residual of an interpretation that "fits"
_HOPELESS = 0.35  # 19 degrees: no calibration is that wrong
_MUCH_BETTER = 0.2  # factor by which the right interpretation must lower the residual
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
    interpretation = _better_interpretation(frames, projector, given, focal)
    if interpretation is not None:
        yield None, key_of(interpretation), describe(interpretation, given)
        return
    lost = given.residual_px > _HOPELESS * focal
    if lost.mean() >= _MOST:
        yield None, "transform_matrix", hopeless(given, int(lost.sum()), len(frames))
        return
    explained: set[int] = set()
    if len(frames) > 2:
        others = OtherClouds(given.clouds)
        for index, frame in enumerate(frames):
            own = _better_interpretation_of_frame(frames, index, projector, given, others, focal)
            if own is not None:
                explained.add(index)
                yield frame.name, key_of(own), describe(own, given, index)
    for index, key, times in _far_devices(frames):
        if index not in explained:
            yield frames[index].name, key, far_away(times)
    if metres is not None and not _NEAREST <= given.depth * metres <= _FARTHEST:
        yield None, "units", wrong_unit(given.depth * metres)


def _better_interpretation(
    frames: Sequence[Correspondences], projector: Device, given: GeometricFit, focal: float
) -> Interpretation | None:
    """The interpretation under which the whole scan fits; None if it fits as it is, or nothing helps."""
    if given.typical_px <= _SUSPECT * focal and given.typical_spread <= APART:
        return None
    found: list[tuple[float, Interpretation]] = []
    for interpretation in other_interpretations():
        fit = fit_geometry([apply_interpretation(interpretation, frame, projector) for frame in frames], projector)
        if _explains(given.typical_px, given.typical_spread, fit.typical_px, fit.typical_spread, focal):
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
        px, cloud = alone.typical_px, alone.clouds[0]
        if px > _FITS * focal:
            continue
        apart = others.distance(cloud, index) / given.depth
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
    if px_before > _SUSPECT * focal and px < _MUCH_BETTER * px_before:
        return px < _SUSPECT * focal or spread <= max(APART, spread_before)
    # The rays meet equally well in both: only the agreement of the frames decides. Views that never overlap
    # (a room seen from its middle) may come closer to each other when misinterpreted, but not to one surface.
    return spread_before > APART and spread < min(_MUCH_CLOSER * spread_before, _ONE_SURFACE) and px < 2 * px_before + 1


def _badness(px: float, spread: float, focal: float) -> float:
    """Orders interpretations that fit: both parts are about 0.01 for a good scan interpreted correctly."""
    return px / focal + min(spread, 1.0)
