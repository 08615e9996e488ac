"""Sentences on a projector that was, or could not be, found."""

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.registration.static_projector.settings import STATIC_DEFAULTS
from sl_nerfstudio.registration.static_projector.solve import NoPlacement
from sl_nerfstudio.relative_pose.unknown_projector.estimate import Cause, NoProjector, ProjectorEstimate
from sl_nerfstudio.relative_pose.unknown_projector.stated_intrinsics import Explanation, IntrinsicsEvidence, Role

_MORE_CAMERAS = (
    "add views from places that differ more, of something with depth; or give the projector's intrinsics (sl-calibrate)"
)
_CAUSES: dict[Cause, tuple[str, str]] = {
    "few frames": (
        "there are few frames, and each leaves only two constraints on the intrinsics",
        "add frames (ten or more) in which the projector stands differently against the camera: turned by 90 degrees, "
        "nearer, on the other side",
    ),
    "similar frames": (
        "the projector stands in the same way against the camera in all frames, which then leave only two constraints "
        "on the intrinsics together",
        "add frames in which it stands differently against the camera: turned by 90 degrees, nearer, on the other "
        "side; or calibrate it with sl-calibrate",
    ),
    "flat": (
        "most frames show hardly more than a plane, which leaves no constraint on the intrinsics",
        "add frames of something with depth, a corner of a room or a crumpled sheet; or calibrate with sl-calibrate",
    ),
    "unknown": (
        "not found",
        "check that pattern.json is the pattern that was projected and that the intrinsics are this camera's (at this "
        "size and focus); or calibrate the projector with sl-calibrate",
    ),
}


def doubt_sentence(found: ProjectorEstimate) -> str:
    """Why the intrinsics are uncertain and what to add; "" if they are well determined."""
    if found.centre_kept:
        return (
            "the frames do not determine the projector's principal point; it was kept as stated, and the focal length "
            "is right only if it is\n    remedy: " + _CAUSES["few frames"][1]
        )
    if found.cause is None:
        return ""
    cause, remedy = _CAUSES[found.cause]
    return (
        f"the projector's intrinsics are uncertain (1 sigma of the focal length: {100 * found.sigma[0]:.1f} %)\n"
        f"    cause:  {cause}\n    remedy: {remedy}"
    )


def wrong_intrinsics(evidence: IntrinsicsEvidence) -> str:
    """Which intrinsics the frames contradict, and the values with which they agree."""
    found = evidence.explanations()
    chi_square = min(evidence.projector.chi_square, evidence.camera.chi_square)
    head = (
        "The stated intrinsics contradict the captures (epipolar geometry of all frames together: chi square "
        f"{chi_square:.0f}, by chance 3)."
    )
    if len(found) == 1:
        (one,) = found
        return (
            f"{head} One change explains it, and no other that was tried does: {one.role}, {_values(one)}\n"
            f"    cause:  the {one.role}'s {one.part} is not as stated (another zoom, focus, lens shift, size?)\n"
            f"    remedy: {_remedy(one.role)}"
        )
    return "\n".join(
        [
            f"{head} One of these would agree, by itself:",
            *(f"    {one.role}: {_values(one)}" for one in found),
            "    cause:  the calibration of a device is off, or was made with another zoom, focus, lens shift or image "
            "size; the frames do not tell whose",
            "    remedy: calibrate again (sl-calibrate); if the camera's intrinsics are certain, find the projector's "
            "from the captures: --estimate-projector",
        ]
    )


def _values(one: Explanation) -> str:
    """The values that would agree, with 1 sigma; those that are right are left out."""
    device, shares, sigma = one.device, one.change, one.sigma
    words = []
    if sigma[0]:
        focal = device.fl_x * (1 + shares[0])
        words.append(f"focal length {focal:.1f} ± {device.fl_x * sigma[0]:.1f} px ({100 * shares[0]:+.1f} %)")
    if sigma[1]:
        x, y = device.cx + device.fl_x * shares[1], device.cy + device.fl_x * shares[2]
        words.append(
            f"principal point ({x:.1f} ± {device.fl_x * sigma[1]:.1f}, {y:.1f} ± {device.fl_x * sigma[2]:.1f}) px "
            f"instead of ({device.cx:.1f}, {device.cy:.1f})"
        )
    return ", ".join(words)


def _remedy(role: Role) -> str:
    if role == "camera":
        return "calibrate the camera again at this zoom, focus and image size (sl-calibrate --camera-only)"
    return "find the projector's from the captures: --estimate-projector"


def static_doubt(sigma_focal: float, frames: int) -> str:
    """Why the intrinsics of a static projector are uncertain; "" if they are well determined."""
    if sigma_focal <= STATIC_DEFAULTS.doubtful_sigma:
        return ""
    return (
        f"the projector's focal length is known only to {100 * sigma_focal:.1f} % (1 sigma), from {frames} cameras\n"
        f"    remedy: {_MORE_CAMERAS}"
    )


def static_not_found(found: NoPlacement, frames: int) -> UserError:
    """The error for cameras that cannot be placed by the codes, or a projector that does not follow from them."""
    if found.fault == "no pair":
        return UserError(
            f"--rig static-projector: no two of {frames} cameras can be placed against each other\n"
            f"    cause:  the best two have {found.common} squares of the pattern in common, or these show no depth\n"
            "    remedy: capture views that overlap more, from places that differ by 10 to 30 degrees; if the "
            "projector was moved, leave --rig out"
        )
    if found.fault == "no projector":
        return UserError(
            "--rig static-projector: no place and no intrinsics of one projector explain what the cameras see\n"
            "    cause:  the projector was moved between the frames, or everything seen lies in one plane\n"
            f"    remedy: if it was moved, leave --rig out; otherwise {_MORE_CAMERAS}"
        )
    return UserError(
        f"--rig static-projector: {frames} cameras do not determine the projector's intrinsics (1 sigma of the focal "
        f"length: {100 * found.sigma_focal:.0f} %)\n    cause:  what is seen is too flat, or the cameras are too close "
        f"to each other\n    remedy: {_MORE_CAMERAS}"
    )


def not_found(found: NoProjector) -> UserError:
    """The error for frames that do not determine the projector."""
    cause, remedy = _CAUSES[found.cause]
    known = f" (known to {100 * found.sigma:.0f} % of the focal length, 1 sigma)" if found.sigma < 10 else ""
    frames = f"{found.frames} frame" + ("" if found.frames == 1 else "s")
    return UserError(
        f"--estimate-projector: {frames} that could be used do not determine the projector's intrinsics{known}\n"
        f"    cause:  {cause}\n    remedy: {remedy}"
    )
