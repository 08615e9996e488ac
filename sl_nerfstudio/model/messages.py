"""Messages about poses and intrinsics that a training run prints before its first step."""

from collections.abc import Sequence

from sl_nerfstudio.bundle_adjustment.cross_validation import CrossValidation
from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.calibration.changes import describe_change
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.model.intrinsics_refinement import RefinedIntrinsics
from sl_nerfstudio.model.pose_refinement import ScanAdjustment
from sl_nerfstudio.verdict.departed_frames import DepartedFrame, describe_departed


def poses_message(found: ScanAdjustment) -> str:
    """Whether the adjusted poses were kept, in one line."""
    if found.adjusted:
        return f"Poses adjusted: {_comparison(found.cross_validation)}."
    return (
        "Poses NOT changed, because adjusting them hardly helped: "
        f"{_comparison(found.cross_validation)}. The starting poses are kept."
    )


def unplaced_message(names: Sequence[str]) -> str:
    """Which frames do not agree with the others, and what to do; "" if all do."""
    if not names:
        return ""
    return (
        f"Frames that cannot be placed: {', '.join(names)}. They do not see the surface on which the others agree.\n"
        "    cause:  their starting poses are far off, or their coordinates are decoded wrongly\n"
        "    remedy: remove them from transforms.json, or register the captures again (sl-process)"
    )


def departed_message(found: Sequence[DepartedFrame]) -> str:
    """Which frames ended far from where they started, and what that may mean; "" if none did."""
    if not found:
        return ""
    return (
        f"Frames far from their starting poses: {describe_departed(found)}.\n"
        "    cause:  a starting pose is wrong by far more than its stated uncertainty and was found again, or the\n"
        "            frame slid along an object that looks the same from there (of revolution, a rod)\n"
        "    remedy: look at these frames in the viewer; if a starting pose is right, leave its frame out"
    )


def contradiction_message(found: SelfCalibration, cameras: Sequence[Device], projector: Device) -> str:
    """Which intrinsics would agree better, for the person who calibrated; "" if the captures agree with them."""
    if not found.contradicts():
        return ""
    lines = describe_change(
        IntrinsicsChange.of(found.change.tolist()), IntrinsicsChange.of(found.sigma.tolist()), cameras, projector
    )
    return "\n".join(
        [
            f"The intrinsics contradict the captures (chi square {found.chi_square:.0f}, by chance 6). These changes, "
            "together, would agree better:",
            *(f"    {line}" for line in lines),
            "    cause:  the calibration of a device is inaccurate, or was made with another zoom, focus or image size",
            "    remedy: train with --pipeline.model.refine-intrinsics True; if that does not help, calibrate again.\n"
            "            Until then poses and surface absorb part of the error; the reported uncertainty includes it",
        ]
    )


def refined_intrinsics_message(found: RefinedIntrinsics, cameras: Sequence[Device], projector: Device) -> str:
    """How the intrinsics were changed, or why not; `cameras` and `projector` have the stated intrinsics."""
    before, after = found.before.intrinsics, found.after.intrinsics
    if before is None or after is None:
        return "Intrinsics NOT changed: no frame sees what another one decoded."
    if found.cross_validation is None:
        return (
            "Intrinsics NOT changed: the captures agree with them "
            f"(chi square {before.chi_square:.0f}; about 6 is expected for correct ones)."
        )
    if not found.changed:
        return f"Intrinsics NOT changed: changing them did not help ({_comparison(found.cross_validation)})."
    sigma = IntrinsicsChange.of(after.sigma.tolist())
    return "\n".join(
        [
            f"Intrinsics changed (chi square {before.chi_square:.0f} before, {after.chi_square:.0f} now; "
            f"{_comparison(found.cross_validation)}):",
            *(f"    {line}" for line in describe_change(found.change, sigma, cameras, projector)),
        ]
    )


def _comparison(found: CrossValidation) -> str:
    return f"held-out pixels agree to {found.after_px:.3g} px, before {found.before_px:.3g} px"
