"""What the report says about the intrinsics of a run, from its training.json."""

from typing import Any

from sl_nerfstudio.calibration.changes import describe_change
from sl_nerfstudio.geometry.devices import DeviceChange, IntrinsicsChange
from sl_nerfstudio.scan import Scan


def intrinsics_hint(training: dict[str, Any] | None, scan: Scan) -> str:
    """How the run changed the intrinsics, and which ones would agree better; "" if there is nothing to say."""
    record = (training or {}).get("intrinsics")
    if not isinstance(record, dict):
        return ""
    sentences = []
    change = _change(record["change"])
    if change:
        sentences.append(
            "The intrinsics are not those of the scan folder: focal length of the camera "
            f"{100 * change.camera.focal:+.2f} %, of the projector {100 * change.projector.focal:+.2f} %. The "
            "transforms.json of the refined poses has them"
        )
    found = record["self_calibration"]
    if found is not None and found["contradicts"]:
        cameras = [frame.camera for frame in scan.frames]
        lines = describe_change(_change(found["change"]), _change(found["sigma"]), cameras, scan.projector)
        sentences.append(
            f"The intrinsics contradict the captures (chi square {found['chi_square']:.0f}, by chance 6). "
            f"These changes, together, would agree better: {'; '.join(lines)}. Train with "
            "--pipeline.model.refine-intrinsics True; if that does not help, calibrate again"
        )
    return ". ".join(sentences)


def _change(record: dict[str, dict[str, float]]) -> IntrinsicsChange:
    return IntrinsicsChange(DeviceChange(**record["camera"]), DeviceChange(**record["projector"]))
