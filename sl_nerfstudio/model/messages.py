"""Messages about poses and intrinsics that a training run prints before its first step."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sl_nerfstudio.bundle_adjustment.adjust import CrossValidation, cross_validate
from sl_nerfstudio.bundle_adjustment.modes import Mode
from sl_nerfstudio.bundle_adjustment.parameters import RefinePoses, SelfCalibration
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.calibration.stated import describe_change
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.model.pose_refinement import PriorConfig, ScanAdjustment, adjusted, maps_and_held_out
from sl_nerfstudio.review.verdict import DepartedFrame, describe_departed, other_places

# Intrinsics that agree better with the captures: found before training, kept only if held-out pixels confirm them.

_ROUNDS = 3  # Gauss-Newton steps of the intrinsics, at most; all poses are adjusted again after each
_AGREEMENT = 6.0  # chi square of correct intrinsics: below it, no further steps are taken


@dataclass(frozen=True)
class RefinedIntrinsics:
    """How intrinsics were changed; if they were not, `change` is the stated one."""

    change: IntrinsicsChange
    before: ScanAdjustment
    after: ScanAdjustment
    cross_validation: CrossValidation | None = None  # None where the captures do not contradict the stated intrinsics

    @property
    def changed(self) -> bool:
        """Whether the intrinsics were changed."""
        return self.cross_validation is not None and self.cross_validation.better


def refine_intrinsics(
    loaded: LoadedScan, stated: IntrinsicsChange, refine: RefinePoses, prior: PriorConfig, settings: AdjustmentSettings
) -> RefinedIntrinsics:
    """Change the intrinsics if the captures contradict them, adjusting all poses with each change.

    `loaded` holds the scan with the intrinsics of its folder, `stated` a change that is already known. Intrinsics that
    the captures do not contradict remain unchanged. Gauss-Newton steps are taken while they become shorter, by the same
    covariance: chi square itself may rise, as better intrinsics leave less noise (natural monotonicity: Deuflhard,
    Newton Methods for Nonlinear Problems, section 2.1). Held-out pixels then decide once between the first result and
    the last.
    """
    maps, held_out = maps_and_held_out(loaded.scan, loaded.samples)
    once = replace(settings, other_minima=False)  # poses are adjusted again later

    def adjusted_with(change: IntrinsicsChange) -> ScanAdjustment:
        scan = loaded.scan.with_intrinsics_change(change)
        return adjusted(scan, loaded.S_scene_world, maps, refine, prior, once)

    before = adjusted_with(stated)
    if before.intrinsics is None or not before.intrinsics.contradicts():
        return RefinedIntrinsics(stated, before, before)
    change, after = stated, before
    for _ in range(_ROUNDS):
        if after.intrinsics is None or after.intrinsics.chi_square < _AGREEMENT:
            break
        proposed = change + IntrinsicsChange.of(after.intrinsics.change.tolist())
        found = adjusted_with(proposed)
        left = found.intrinsics
        if left is None or left.chi_square >= left.squared_length(after.intrinsics.change):
            break
        change, after = proposed, found
    # That the captures contradict the stated intrinsics is known already: any gain beyond chance confirms it.
    decision = cross_validate(before.rig, after.rig, held_out, maps, before.noise_px, least_gain=0.0)
    return RefinedIntrinsics(change if decision.better else stated, before, after, decision)


def poses_message(found: ScanAdjustment) -> str:
    """Whether the adjusted poses were kept, in one line."""
    assert found.cross_validation is not None
    comparison = _comparison(found.cross_validation)
    if found.adjusted:
        return f"Poses adjusted: {comparison}."
    return f"Poses NOT changed, because adjusting them hardly helped: {comparison}. The starting poses are kept."


def unplaced_message(names: Sequence[str]) -> str:
    """Which frames do not agree with the others, and what to do; "" if all do."""
    if not names:
        return ""
    return (
        f"Frames that cannot be placed: {', '.join(names)}. They do not see the surface on which the others agree.\n"
        "    cause:  their starting poses are far off, or their coordinates are decoded wrongly\n"
        "    remedy: remove them from transforms.json, or register the captures again (sl-process)"
    )


def modes_message(modes: Sequence[Mode], names: Sequence[str]) -> str:
    """Which frames may stand elsewhere, and how likely; "" if none may."""
    if not modes:
        return ""
    listed = "\n".join(f"    {place.sentence()}" for place in other_places(modes, names))
    return (
        f"Frames that may stand elsewhere, by what was captured:\n{listed}\n"
        "    cause:  the object looks nearly the same from there\n"
        "    remedy: capture views in between, or more of what tells its sides apart"
    )


def departed_message(found: Sequence[DepartedFrame]) -> str:
    """Which frames ended far from where they started, and what that may mean; "" if none did."""
    if not found:
        return ""
    return (
        f"Frames far from their starting poses: {describe_departed(found)}.\n"
        "    cause:  a starting pose is wrong by far more than its stated or usual uncertainty and was found again,\n"
        "            or the frame slid along an object that looks the same from there (of revolution, a rod)\n"
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
