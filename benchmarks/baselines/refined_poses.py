"""The poses with which `sl-neus` trains, for other methods to be compared on."""

import sys

from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import load_scan
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.model.pose_refinement import PriorConfig, adjust_scan
from sl_nerfstudio.scan import Scan


def refined_poses(scan: Scan) -> DevicePoses:
    """Poses after our joint adjustment, with its defaults, in the scan's gauge."""
    loaded = load_scan(scan.root)
    found = adjust_scan(scan, loaded.S_scene_world, loaded.samples, "free", PriorConfig(), AdjustmentSettings())
    if not found.adjusted:
        print(f"{scan.root.name}: adjusted poses were not better on held-out pixels, and are not used", file=sys.stderr)
    return found.rig.poses(loaded.S_scene_world.inverse())
