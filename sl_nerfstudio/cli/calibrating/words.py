"""What sl-calibrate says about its result."""

from sl_nerfstudio.calibration.board.calibrate import BoardCalibration
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.verdict.calibration import shortcomings, undetermined


def next_pose_words(found: BoardCalibration) -> str:
    """The further pose that would help most, as a sentence."""
    pose = found.next_pose
    if pose is None:
        return "no further pose was found that fits the images of both devices"
    place = "middle" if pose.row == pose.column == "middle" else f"{pose.row} {pose.column}"
    return (
        f"most useful next: the board in the {place} of the image, {pose.tilt}, {pose.distance}; focal lengths would "
        f"be known to {pose.sigma_after:.2%} instead of {pose.sigma_before:.2%} by the noise of the corners"
    )


def require_determined(found: BoardCalibration) -> None:
    """Raise UserError if the poses do not determine a focal length."""
    devices = undetermined(found)
    if not devices:
        return
    lacking = shortcomings(found)
    cause = "; ".join(lacking) if lacking else "the corners contradict each other from pose to pose"
    sigmas = [f"{s.focal() / d.fl_x:.0%}" for s, d in zip(found.sigmas, found.adjusted.rig.devices, strict=True)]
    raise UserError(
        f"the poses do not determine the focal length of the {' and of the '.join(devices)} (1 sigma: "
        f"{', '.join(sigmas)}); nothing was written\n    cause:  {cause}\n"
        f"    remedy: add poses; {next_pose_words(found)}"
    )
