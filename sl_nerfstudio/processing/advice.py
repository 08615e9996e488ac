"""What to take again, and why."""

from collections.abc import Sequence
from itertools import pairwise

from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord

_LOW_RATE = 0.6
_LITTLE_PATTERN = 0.03  # of the image
_POOR_FITNESS = 0.65


def what_to_recapture(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord], ordered: bool) -> tuple[str, ...]:
    """One sentence a capture, the most pressing first; empty if nothing is needed."""
    lost = [f"{f.name}: take it again; it was left out ({first_line(f.reason)})" for f in frames if not f.in_scan]
    return (*lost, *_gaps(frames, edges, ordered), *(s for f in frames if f.in_scan for s in _weak(f)))


def first_line(reason: str) -> str:
    """The problem alone, without cause and remedy."""
    return reason.strip().splitlines()[0] if reason.strip() else "no reason known"


def _gaps(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord], ordered: bool) -> list[str]:
    """Places where the chain of frames hangs by nothing."""
    used = {frozenset(edge.frames) for edge in edges if edge.used}
    present = [f.name for f in frames if f.in_scan]
    if ordered:
        return [
            f"between {a} and {b}: add a view; the two share too little of the surface to be registered directly"
            for a, b in pairwise(present)
            if frozenset((a, b)) not in used
        ]
    single = [name for name in present if sum(name in pair for pair in used) == 1 and len(present) > 2]
    return [f"near {name}: add a view; only one other frame overlaps it" for name in single]


def _weak(frame: FrameRecord) -> list[str]:
    said = [f"{frame.name}: {degeneracy}" for degeneracy in frame.degeneracies]
    if frame.decode_rate is not None and frame.decode_rate < _LOW_RATE:
        said.append(
            f"{frame.name}: only {frame.decode_rate:.0%} of the pattern was decoded; sharper focus, more light from "
            "the projector and less from the room help, and lines that are neither faint nor overexposed"
        )
    if frame.mask_share is not None and frame.mask_share < _LITTLE_PATTERN:
        said.append(f"{frame.name}: the pattern fills {frame.mask_share:.1%} of the image; go nearer, or aim better")
    if frame.fitness is not None and frame.fitness < _POOR_FITNESS:
        said.append(
            f"{frame.name}: {frame.fitness:.0%} of its points agree with the frames it overlaps; something moved, or "
            "its place is uncertain: take it again"
        )
    return said
