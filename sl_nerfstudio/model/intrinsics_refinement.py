"""Intrinsics that agree better with the captures: found before training, kept only if held-out pixels confirm them."""

from dataclasses import dataclass, replace

from sl_nerfstudio.bundle_adjustment.cross_validation import CrossValidation, cross_validate
from sl_nerfstudio.bundle_adjustment.free_parameters import RefinePoses
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.model.pose_refinement import (
    Found,
    PriorConfig,
    adjusted,
    maps_and_held_out,
    pose_prior,
    scene_rig,
)


@dataclass(frozen=True)
class RefinedIntrinsics:
    """How intrinsics were changed; if they were not, `change` is the stated one."""

    change: IntrinsicsChange
    before: Found
    after: Found
    cross_validation: CrossValidation | None = None  # None where the captures do not contradict the stated intrinsics

    @property
    def changed(self) -> bool:
        """Whether the intrinsics were changed."""
        return self.cross_validation is not None and self.cross_validation.better


def refine_intrinsics(
    loaded: LoadedScan,
    stated: IntrinsicsChange,
    refine: RefinePoses,
    prior: PriorConfig,
    settings: AdjustmentSettings,
) -> RefinedIntrinsics:
    """Change the intrinsics if the captures contradict them, adjusting all poses with each change.

    `loaded` holds the scan with the intrinsics of its folder, `stated` a change that is already known. Intrinsics that
    the captures do not contradict remain unchanged. Gauss-Newton steps are taken while the chi square of the
    contradiction falls; held-out pixels then decide once between the first result and the last.
    """
    maps, held_out = maps_and_held_out(loaded.scan, loaded.samples, settings)
    s = settings.self_calibration
    once = replace(settings, other_minima=replace(settings.other_minima, searches=0))  # poses are adjusted again later

    def adjusted_with(change: IntrinsicsChange) -> Found:
        scan = loaded.scan.with_intrinsics_change(change)
        start = scene_rig(scan, loaded.S_scene_world)
        known = pose_prior(scan, loaded.S_scene_world, prior)
        return adjusted(scan, loaded.S_scene_world, start, maps, refine, known, once)

    before = adjusted_with(stated)
    if before.intrinsics is None or not before.intrinsics.contradicts(s):
        return RefinedIntrinsics(stated, before, before)
    change, after = stated, before
    for _ in range(s.rounds):
        if after.intrinsics is None or after.intrinsics.chi_square < s.agreement:
            break
        proposed = change + IntrinsicsChange.of(after.intrinsics.change.tolist())
        found = adjusted_with(proposed)
        if found.intrinsics is None or found.intrinsics.chi_square >= after.intrinsics.chi_square:
            break
        change, after = proposed, found
    # That the captures contradict the stated intrinsics is known already: any gain beyond chance confirms it.
    any_gain = replace(settings, cross_validation=replace(settings.cross_validation, least_gain=0.0))
    decision = cross_validate(before.rig, after.rig, held_out, maps, before.noise_px, any_gain)
    return RefinedIntrinsics(change if decision.better else stated, before, after, decision)
