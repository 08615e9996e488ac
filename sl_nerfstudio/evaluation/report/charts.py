"""Small charts as inline SVG: sharp in print, without scripts."""

import io
import math
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy import ndarray

INK, MUTED, GRID = "#1d2733", "#66727f", "#dfe4e9"
BLUE, ORANGE = "#2563a8", "#c2571a"
_RC = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


@dataclass(frozen=True)
class Bars:
    """One series of a bar chart with one bar per frame."""

    label: str
    values: Sequence[float]


def frame_bars(title: str, unit: str, series: Sequence[Bars], wide: bool = False) -> str:
    """Bars per frame, several series side by side; `wide` fills the width of the page."""
    import matplotlib

    with matplotlib.rc_context(_RC):
        figure, axes = _figure(10.4 if wide else 5.4, 2.1)
        count = len(series[0].values)
        width = 0.8 / len(series)
        for k, one in enumerate(series):
            x = np.arange(count) + (k - (len(series) - 1) / 2) * width
            y = np.nan_to_num(np.asarray(one.values, np.float64))
            axes.bar(x, y, width, color=(BLUE, ORANGE)[k % 2], label=one.label)
        axes.set_xlim(-0.7, count - 0.3)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("frame")
        axes.set_ylabel(unit)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        _legend(axes, len(series))
        return _svg(figure, title)


def histogram(title: str, unit: str, values: Float[ndarray, "n"], lower: float, upper: float) -> str:
    """Share of the values in each bin between two limits; values outside count in the outermost bins."""
    import matplotlib

    with matplotlib.rc_context(_RC):
        figure, axes = _figure(5.4, 2.1)
        share = np.full(len(values), 100 / max(len(values), 1))
        axes.hist(np.clip(values, lower, upper), bins=61, range=(lower, upper), weights=share, color=BLUE)
        axes.set_xlabel(unit)
        axes.set_ylabel("% of the surface")
        axes.set_xlim(lower, upper)
        return _svg(figure, title)


def curve(title: str, step: Sequence[float | int | None], values: Sequence[float | int | None]) -> str:
    """A convergence curve; logarithmic where positive values span more than a factor of 20."""
    import matplotlib

    with matplotlib.rc_context(_RC):
        figure, axes = _figure(2.9, 1.7)
        x, y = np.asarray(step, np.float64), np.asarray(values, np.float64)
        known = np.isfinite(x) & np.isfinite(y)
        x, y = x[known], y[known]
        axes.plot(x, y, color=BLUE, linewidth=1.2, marker="." if len(x) == 1 else "")
        if len(y) and y.min() > 0 and y.max() / y.min() > 20:
            axes.set_yscale("log")
        axes.set_title(title, fontsize=9, color=INK, loc="left")
        axes.set_xlabel("iteration")
        return _svg(figure, title)


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    axes = figure.add_subplot()
    axes.patch.set_alpha(0)
    axes.grid(axis="y", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    return figure, axes


def _legend(axes: Axes, series: int) -> None:
    if series > 1:
        axes.legend(
            frameon=False, fontsize=8, ncols=series, loc="lower right", bbox_to_anchor=(1, 0.98), borderaxespad=0
        )


def _svg(figure: Figure, title: str) -> str:
    """The figure as an <svg> element with a title for screen readers."""
    import matplotlib
    from markupsafe import escape

    buffer = io.StringIO()
    # One salt per chart: the ids of several charts on one page must differ, and every run must give the same.
    with matplotlib.rc_context({"svg.hashsalt": title}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    prefix = "c" + format(zlib.crc32(title.encode()), "x") + "-"
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = re.sub(r'(xlink:href="#|url\(#)', lambda m: m.group(1) + prefix, text)
    head = f'<svg role="img" aria-label="{escape(title)}" class="chart"'
    return text.replace("<svg", head, 1)


def nice_limit(value: float) -> float:
    """The smallest number of 1, 2, 5 times a power of ten that is at least `value`."""
    if not math.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= value * (1 - 1e-12))
