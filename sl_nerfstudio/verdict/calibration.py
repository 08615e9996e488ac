"""The verdict on a calibration from boards, and why."""

from collections.abc import Iterator
from dataclasses import dataclass

from sl_nerfstudio.calibration.board.calibrate import BoardCalibration
from sl_nerfstudio.verdict.verdict import Reason, Verdict, worst


@dataclass(frozen=True)
class CalibrationLimits:
    """What makes a calibration good, acceptable or poor."""

    good_focal: float = 0.003
    """Standard deviation of a focal length, relative to it."""
    acceptable_focal: float = 0.01
    """The same for an acceptable calibration."""
    determined_focal: float = 0.05
    """The same, beyond which the poses do not determine the focal length and no result is written."""
    good_centre: float = 0.005
    """Standard deviation of a principal point, relative to the focal length."""
    acceptable_centre: float = 0.015
    """The same for an acceptable calibration."""
    good_rms_px: float = 0.6
    """RMS of the corners in either device, in pixels."""
    acceptable_rms_px: float = 1.5
    """The same for an acceptable calibration."""
    good_excess: float = 2.0
    """Error of predicted corners in left-out poses, relative to the RMS of the fit."""
    good_coverage: float = 0.3
    """Share of the image's cells that hold corners."""
    least_tilt_deg: float = 20.0
    """Largest angle between two boards, below which they count as parallel."""
    least_depth_ratio: float = 1.15
    """Distance of the farthest board over that of the nearest, below which all stand at one distance."""


LIMITS = CalibrationLimits()
DEVICES = ("camera", "projector")


def judge_calibration(found: BoardCalibration, limits: CalibrationLimits = LIMITS) -> Verdict:
    """The worst of all judgements."""
    return worst(_reasons(found, limits))


def undetermined(found: BoardCalibration, limits: CalibrationLimits = LIMITS) -> tuple[str, ...]:
    """The devices whose focal length the poses do not determine."""
    return tuple(
        name
        for name, device, sigma in zip(DEVICES, found.adjusted.rig.devices, found.sigmas, strict=False)
        if sigma.focal() > limits.determined_focal * device.fl_x
    )


def shortcomings(found: BoardCalibration, limits: CalibrationLimits = LIMITS) -> tuple[str, ...]:
    """What the poses lack, in half sentences."""
    c, out = found.coverage, []
    if c.tilt_deg < limits.least_tilt_deg:
        out.append(f"the boards are nearly parallel (the largest angle between two is {c.tilt_deg:.0f} degrees)")
    if c.depth_ratio < limits.least_depth_ratio:
        out.append("all boards stand at one distance")
    if c.camera < limits.good_coverage:
        out.append(f"corners fill only {c.camera:.0%} of the camera's image")
    if c.projector is not None and c.projector < limits.good_coverage:
        out.append(f"corners fill only {c.projector:.0%} of the pattern")
    return tuple(out)


def _reasons(found: BoardCalibration, limits: CalibrationLimits) -> Iterator[Reason]:
    lacking = shortcomings(found, limits)
    because = f"; {', and '.join(lacking)}" if lacking else ""
    for k, (device, sigma) in enumerate(zip(found.adjusted.rig.devices, found.sigmas, strict=True)):
        name = DEVICES[k]
        focal, centre = sigma.focal() / device.fl_x, sigma.centre() / device.fl_x
        if focal > limits.good_focal:
            band = "acceptable" if focal <= limits.acceptable_focal else "poor"
            yield Reason(band, f"the focal length of the {name} is uncertain by {focal:.2%} (1 sigma){because}")
        if centre > limits.good_centre:
            band = "acceptable" if centre <= limits.acceptable_centre else "poor"
            yield Reason(
                band, f"the principal point of the {name} is uncertain by {sigma.centre():.0f} px (1 sigma){because}"
            )
        if found.rms_px[k] > limits.good_rms_px:
            band = "acceptable" if found.rms_px[k] <= limits.acceptable_rms_px else "poor"
            yield Reason(band, f"corners are {found.rms_px[k]:.2f} px (RMS) from where the {name} should see them")
        if found.left_out.error_px[k] > limits.good_excess * max(found.rms_px[k], found.adjusted.sigma_px[k]):
            yield Reason(
                "acceptable",
                f"corners of left-out poses are predicted to {found.left_out.error_px[k]:.2f} px in the {name}, "
                f"fitted ones to {found.rms_px[k]:.2f} px: more poses would help",
            )
