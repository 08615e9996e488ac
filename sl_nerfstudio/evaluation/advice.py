"""What to do next, in words: frames to leave out or to capture again, and the capture that would add most."""

import math

from sl_nerfstudio.console import figure, unit_word
from sl_nerfstudio.evaluation.capture_agreement import FrameAgreement
from sl_nerfstudio.evaluation.completeness.next_view import NextView
from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.verdict.judge import frame_band
from sl_nerfstudio.verdict.settings import VerdictSettings
from sl_nerfstudio.verdict.verdict import listed

_LARGE = {"coordinate_px_median": 2.0, "coordinate_px_p95": 3.0}  # multiples of the median frame's value
_LEAST_AGREEING = 0.85  # share of a frame's decoded pixels that agree with the surface within the noise
_MOST = 0.5  # of the frames: if more disagree, it is not them
_WORTH = 0.02  # of the surface and its openings that a capture must newly show to be proposed
_STEEP_DEG = 60.0  # above or below the horizon


def disagreeing_frames(evaluation: Evaluation) -> tuple[str, ...]:
    """At most one sentence, with all frames that contradict the others or the surface; none with starting poses."""
    if evaluation.starting_poses:
        return ()
    frames = evaluation.agreement.frames
    names = [f.name for k, f in enumerate(frames) if _stands_out(f, frames) or _contradicts(evaluation, k)]
    if not names or len(names) > _MOST * len(frames):
        return ()
    several = len(names) > 1
    them = "them" if several else "it"
    return (f"{listed(names)} {'disagree' if several else 'disagrees'}: leave {them} out or capture {them} again",)


def _stands_out(frame: FrameAgreement, frames: tuple[FrameAgreement, ...]) -> bool:
    for key, factor in _LARGE.items():
        known = sorted(v for f in frames if math.isfinite(v := getattr(f, key)))
        if known and getattr(frame, key) > factor * known[len(known) // 2]:
            return True
    return frame.agreeing_share < _LEAST_AGREEING


def _contradicts(evaluation: Evaluation, number: int) -> bool:
    cross = evaluation.cross
    return cross is not None and bool(cross.pairs) and frame_band(cross.frames[number], VerdictSettings()) != "good"


def capture_next(evaluation: Evaluation, view: NextView | None) -> str:
    """Where to capture next and what that would show; "" if nothing that no frame has seen would show."""
    found = evaluation.completeness
    if found is None or view is None:
        return ""
    whole = found.surface_area + float(found.openings.area.sum())
    if view.new_area < _WORTH * whole:
        return ""
    unit = unit_word(evaluation.units)
    nearest = evaluation.agreement.frames[view.nearest].name
    side, way = f"the side {view.nearest_deg:.0f}° from {nearest}, the nearest frame", "it"
    if view.elevation_deg < -_STEEP_DEG:
        side, way = "the underside", "it from below, or turn the object over"
    elif view.elevation_deg > _STEEP_DEG:
        side, way = "the top", "it from above"
    return (
        f"No frame sees {side}: capture {way}; this would show {view.new_area / view.unseen_area:.0%} of what no frame "
        f"has seen ({figure(view.new_area)} {unit}²)"
    )
