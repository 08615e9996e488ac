"""A drawing of which frames were registered with which."""

import math
from collections.abc import Sequence

from markupsafe import escape

from sl_nerfstudio.evaluation.report.charts import BLUE, INK, MUTED, ORANGE
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord

_SIZE, _RADIUS = 460.0, 185.0
_WEAK = 0.7  # fitness below which an edge is drawn as weak


def draw_overlaps(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord]) -> str:
    """An <svg> of the frames on a circle, in order; thick lines mean large overlap, dashed ones were rejected."""
    place = {f.name: _place(k, len(frames)) for k, f in enumerate(frames)}
    lines = [_line(place, edge) for edge in sorted(edges, key=lambda e: e.used) if set(edge.frames) <= place.keys()]
    nodes = [_node(frame, place[frame.name], str(k)) for k, frame in enumerate(frames)]
    return (
        f'<svg role="img" aria-label="Overlap graph" class="chart" viewBox="0 0 {_SIZE:g} {_SIZE:g}" '
        f'style="max-width:{_SIZE:g}px">{"".join(lines + nodes)}</svg>'
    )


def _place(index: int, count: int) -> tuple[float, float]:
    angle = 2 * math.pi * index / max(count, 1) - math.pi / 2
    return _SIZE / 2 + _RADIUS * math.cos(angle), _SIZE / 2 + _RADIUS * math.sin(angle)


def _line(place: dict[str, tuple[float, float]], edge: EdgeRecord) -> str:
    (x1, y1), (x2, y2) = (place[name] for name in edge.frames)
    colour = MUTED if not edge.used else ORANGE if edge.fitness < _WEAK or edge.undecided else BLUE
    width = 0.8 + 4 * max(0.0, min(edge.overlap, 1.0))
    dashed = "" if edge.used else ' stroke-dasharray="4 4" opacity="0.6"'
    title = f"{edge.frames[0]} – {edge.frames[1]}: overlap {edge.overlap:.0%}, agreement {edge.fitness:.0%}"
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" '
        f'stroke-width="{width:.1f}"{dashed}><title>{escape(title)}</title></line>'
    )


def _node(frame: FrameRecord, place: tuple[float, float], label: str) -> str:
    x, y = place
    fill = "#f6c7c2" if not frame.in_scan else "#f7dc8f" if frame.undecided else "#ffffff"
    return (
        f'<g><title>{escape(frame.name)}</title><circle cx="{x:.1f}" cy="{y:.1f}" r="11" fill="{fill}" '
        f'stroke="{INK}"/><text x="{x:.1f}" y="{y + 3.5:.1f}" text-anchor="middle" font-size="10" '
        f'fill="{INK}">{escape(label)}</text></g>'
    )
