"""What `--object-only` found, in words and as JSON."""

from typing import Any

from sl_nerfstudio.object_separation.plane_judgement import PlaneFinding, Verdict
from sl_nerfstudio.processing.selection.object_only import ObjectOnly

_BECAUSE: dict[Verdict, str] = {
    "leaves the views": "all cameras are in front of it, nothing is behind it, and it continues beyond the views",
    "object stands on it": "it is far larger than the object, which stands on it",
    "cameras on both sides": "cameras are on both sides of it",
    "surface behind it": "there is surface behind it",
    "nothing on it": "nothing is in front of it",
    "edges seen": "its edges are seen, and what rises from it is flat or nearly as large: it may be the object itself",
}


def object_sentences(found: ObjectOnly) -> tuple[str, ...]:
    """What was left out and what was kept, the most important first."""
    shares = found.shares()
    if not found.left_out:
        begin = "no plane was left out"
    else:
        begin = f"left out {shares.plane:.0%} of the decoded pixels as planes around the object"
    lines = [f"{begin}, and {shares.beyond:.1%} as not connected to it; {shares.object:.0%} show the object"]
    if found.planes and not found.left_out and any(plane.is_surroundings for plane in found.planes):
        lines.append("hardly anything would have been left without its planes, so they were kept")
    lines += [plane_sentence(plane, plane in found.left_out) for plane in found.planes]
    empty = found.empty_frames()
    if empty:
        lines.append(f"frames without any of the object, not in the scan: {', '.join(empty)}")
    return tuple(lines)


def plane_sentence(plane: PlaneFinding, left_out: bool) -> str:
    """Why a plane was left out or kept."""
    what = "left out" if left_out else "kept"
    return f"plane with {plane.share:.0%} of the points {what}: {_BECAUSE[plane.verdict]}"


def object_document(found: ObjectOnly) -> dict[str, Any]:
    """For processing.json; planes are `normal . p = offset` in the axes and the unit of the scan."""
    shares = found.shares()
    return {
        "object": shares.object,
        "planes_left_out": shares.plane,
        "beyond_left_out": shares.beyond,
        "planes": [
            {
                "normal": plane.plane.normal.tolist(),
                "offset": float(plane.plane.offset),
                "share": plane.share,
                "left_out": plane in found.left_out,
                "because": _BECAUSE[plane.verdict],
            }
            for plane in found.planes
        ],
        "frames": [dict(vars(frame)) for frame in found.frames],
    }
