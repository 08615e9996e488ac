"""What to capture again, and why."""

from collections.abc import Sequence
from itertools import pairwise

from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord

_LOW_RATE = 0.6  # decoded share of the pattern
_SMALL_SHARE = 0.03  # of the image that shows the pattern
_POOR_FITNESS = 0.65  # share of a frame's points that agree with other frames


def what_to_recapture(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord], ordered: bool) -> tuple[str, ...]:
    """One sentence for each problem, the most important first; empty if nothing is needed."""
    return (*_lost(frames), *_gaps(frames, edges, ordered), *(s for f in frames if f.in_scan for s in _weak(f)))


def _lost(frames: Sequence[FrameRecord]) -> list[str]:
    """One sentence for all frames that were left out for the same reason, or are connected with each other."""
    together: dict[tuple[int, str], list[FrameRecord]] = {}
    for frame in frames:
        if not frame.in_scan:
            key = (frame.component, "") if frame.component > 0 else (-1, first_line(frame.reason))
            together.setdefault(key, []).append(frame)
    sentences = []
    for (component, _), group in together.items():
        names, why = ", ".join(f.name for f in group), f"left out ({first_line(group[0].reason)})"
        if len(group) == 1:
            sentences.append(f"{names}: capture it again; it was {why}")
        elif component > 0:
            connect = f"capture views that connect this group {component} with the scan"
            sentences.append(f"{names}: {connect}; {group[0].name} was {why}")
        else:
            sentences.append(f"{names}: capture them again; each was {why}")
    return sentences


def first_line(reason: str) -> str:
    """The problem without cause and remedy."""
    return reason.strip().splitlines()[0] if reason.strip() else "no reason known"


def _gaps(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord], ordered: bool) -> list[str]:
    """Places where frames are connected to the others badly or not at all."""
    if ordered:
        return [
            f"between {a} and {b}: add a frame; the two share too little of the surface to be registered directly"
            for a, b in unconnected_neighbours(frames, edges)
        ]
    used = _used(edges)
    present = [f.name for f in frames if f.in_scan]
    single = [name for name in present if sum(name in pair for pair in used) == 1 and len(present) > 2]
    return [f"near {name}: add a frame; only one other frame overlaps it" for name in single]


def unconnected_neighbours(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord]) -> list[tuple[str, str]]:
    """Frames of the scan that follow each other, but were not registered with each other."""
    used = _used(edges)
    present = [f.name for f in frames if f.in_scan]
    return [(a, b) for a, b in pairwise(present) if frozenset((a, b)) not in used]


def _used(edges: Sequence[EdgeRecord]) -> set[frozenset[str]]:
    return {frozenset(edge.frames) for edge in edges if edge.used}


def _weak(frame: FrameRecord) -> list[str]:
    """What makes a frame of the scan unreliable."""
    advice = [f"{frame.name}: {degeneracy}" for degeneracy in frame.degeneracies]
    shared = frame.shared_decoded is not None
    rate, what = (frame.shared_decoded, "surface that other frames show") if shared else (frame.decode_rate, "pattern")
    if rate is not None and rate < _LOW_RATE:
        advice.append(
            f"{frame.name}: only {rate:.0%} of the {what} was decoded; focus better, use more light from "
            "the projector and less from the room, and expose so that lines are neither faint nor saturated"
        )
    if frame.mask_share is not None and frame.mask_share < _SMALL_SHARE:
        advice.append(
            f"{frame.name}: the pattern fills only {frame.mask_share:.1%} of the image; go closer, or aim better"
        )
    if frame.fitness is not None and frame.fitness < _POOR_FITNESS:
        advice.append(
            f"{frame.name}: only {frame.fitness:.0%} of its points agree with the frames it overlaps; something moved, "
            "or its pose is uncertain: capture it again"
        )
    return advice
