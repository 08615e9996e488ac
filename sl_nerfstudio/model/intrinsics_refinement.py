"""Intrinsics that agree better with the captures: found before training, kept only if held-out pixels say so, too."""

from dataclasses import dataclass

from sl_nerfstudio.bundle_adjustment.adjust import AdjustmentSettings
from sl_nerfstudio.bundle_adjustment.cross_validation import CrossValidation, cross_validate
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.self_calibration import SelfCalibration
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.geometry.devices import UNCHANGED, IntrinsicsChange
from sl_nerfstudio.model.pose_refinement import PriorConfig, ScanAdjustment, adjust_scan, guard_width, maps_and_held_out
from sl_nerfstudio.scan import Scan

_ROUNDS = 3  # Gauss-Newton steps of the intrinsics, with all poses adjusted anew after each
_AGREED = 6.0  # chi square that right intrinsics have


@dataclass(frozen=True)
class RefinedIntrinsics:
    """How intrinsics were changed; `change` is UNCHANGED where they were not."""

    change: IntrinsicsChange
    before: ScanAdjustment
    after: ScanAdjustment
    held_out: CrossValidation | None = (
        None  # how held-out pixels agree with both rigs; None where the stated ones are believed
    )

    def message(self, stated: Scan) -> str:
        """For the person who waits; `stated` is the scan with the devices of its transforms.json."""
        if self.before.intrinsics is None or self.after.intrinsics is None:
            return "Intrinsics NOT changed: no frame sees what another one decoded."
        chi = f"chi square {self.before.intrinsics.chi_square:.0f}"
        if not self.change or self.held_out is None:
            serious = self.before.intrinsics.serious
            why = "other ones did not help held-out pixels" if serious else f"the captures agree with them ({chi})"
            return f"Intrinsics NOT changed: {why}."
        total = SelfCalibration.of(self.change, self.after.intrinsics.covariance)
        return "\n".join(
            [
                f"Intrinsics changed ({chi} before, {self.after.intrinsics.chi_square:.0f} now; held-out pixels agree "
                f"to {self.held_out.after_px:.3g} px, before {self.held_out.before_px:.3g} px):",
                *total.lines([frame.camera for frame in stated.frames], stated.projector),
            ]
        )


def refine_intrinsics(
    loaded: LoadedScan, mode: RefinePoses, prior: PriorConfig, settings: AdjustmentSettings
) -> RefinedIntrinsics:
    """Change the intrinsics as far as the captures contradict them, adjusting all poses with each change.

    `loaded` holds the scan as it is stated. Intrinsics that are believed stay exactly as they are.
    """

    def adjusted(change: IntrinsicsChange) -> ScanAdjustment:
        scan = loaded.scan.with_intrinsics_change(change)
        return adjust_scan(scan, loaded.S_scene_world, loaded.samples, mode, prior, settings)

    before = adjusted(UNCHANGED)
    if before.intrinsics is None or not before.intrinsics.serious:
        return RefinedIntrinsics(UNCHANGED, before, before)
    maps, held_out = maps_and_held_out(loaded.scan, loaded.samples)

    def judged(one: ScanAdjustment, other: ScanAdjustment) -> CrossValidation:
        return cross_validate(one.rig, other.rig, held_out, maps, guard_width(before.noise_px))

    change, after = UNCHANGED, before
    for _ in range(_ROUNDS):
        doubt = after.intrinsics
        if doubt is None or doubt.chi_square < _AGREED:
            break
        proposed = change + IntrinsicsChange.of(doubt.change.tolist())
        found = adjusted(proposed)
        if not judged(after, found).better:
            break
        change, after = proposed, found
    return RefinedIntrinsics(change, before, after, judged(before, after))
