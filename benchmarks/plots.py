"""Draws the plots of the documentation from benchmarks/results: accuracy, ablation, basin, sweeps, error over time.

    python -m benchmarks.plots [--results benchmarks/results] [--output docs/pictures]

Results that do not exist are skipped.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from benchmarks.common.measuring import options

INK, MUTED, GRID = "#1d2733", "#66727f", "#dfe4e9"
COLOURS = ("#2563a8", "#c2571a", "#3c8d5a", "#7a4fa3", "#8a8f98")
FUSION = "fusion after ICP"
Rows = list[dict[str, Any]]


def panels(count: int, height: float = 3.0) -> tuple[Figure, list[Any]]:
    """A figure with panels in a row, in the colours of the reports."""
    figure = Figure(figsize=(3.6 * count, height), dpi=130, layout="constrained")
    axes = [figure.add_subplot(1, count, k + 1) for k in range(count)]
    for ax in axes:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=MUTED)
        ax.grid(color=GRID, linewidth=0.7)
        ax.set_axisbelow(True)
    return figure, axes


def plain_decades(axis: Axis) -> None:
    """Write 0.1 instead of a power of ten, with ticks at 1, 2 and 5."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def series(ax: Any, rows: Rows, x: str, y: str, colour: int, label: str) -> None:
    """A curve through all rows."""
    ordered = sorted(rows, key=lambda row: row[x])
    values = ([row[key] for row in ordered] for key in (x, y))
    ax.plot(*values, "o-", color=COLOURS[colour], markersize=4, label=label)


def accuracy(rows: Rows) -> Figure:
    """Surface error of every scene: refined poses, true poses (oracle), and fusion."""
    shown = [v for v in ("refined", "oracle", "unrefined", FUSION) if any(row["variant"] == v for row in rows)]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, (ax,) = panels(1)
    figure.set_size_inches(5.2, 3.2)
    for k, variant in enumerate(shown):
        found = [[r["rigid_rmse"] for r in rows if r["scene"] == s and r["variant"] == variant] for s in scenes]
        middle = [float(np.median(f)) if f else np.nan for f in found]
        x = np.arange(len(scenes)) + (k - (len(shown) - 1) / 2) * 0.26
        ax.bar(x, middle, 0.24, color=COLOURS[k], label=variant)
        for at, values in zip(x, found, strict=True):
            ax.plot([at] * len(values), values, ".", color=INK, markersize=4)
    ax.set_xticks(range(len(scenes)), scenes)
    ax.set_yscale("log")
    ax.set_ylabel("rigid RMSE of the surface, mm", color=INK)
    plain_decades(ax.yaxis)
    figure.legend(loc="outside upper center", ncols=3, frameon=False, title="bars: median; dots: each scan")
    return figure


def ablation(rows: Rows) -> Figure:
    """Surface error with each part left out, relative to that of the whole method on the same scan."""
    whole = {(row["scene"], row["seed"]): row["rigid_rmse"] for row in rows if row["variant"] == "refined"}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    shown = [v for v in dict.fromkeys(row["variant"] for row in rows) if v != "refined"]
    figure, (ax,) = panels(1)
    figure.set_size_inches(6.4, 0.42 * len(shown) + 1.4)
    for k, scene in enumerate(scenes):
        mine = [row for row in rows if row["scene"] == scene and row["variant"] in shown]
        times = [row["rigid_rmse"] / whole[scene, row["seed"]] for row in mine]
        at = [shown.index(row["variant"]) + (k - (len(scenes) - 1) / 2) * 0.22 for row in mine]
        ax.plot(times, at, "o", color=COLOURS[k], markersize=5, label=scene)
    ax.axvline(1, color=MUTED, linewidth=1)
    ax.set_yticks(range(len(shown)), shown)
    ax.invert_yaxis()
    ax.set_xscale("log")
    plain_decades(ax.xaxis)
    ax.set_xlabel("surface error (rigid RMSE), times that of the whole method", color=INK)
    figure.legend(loc="outside upper center", ncols=3, frameon=False)
    return figure


def basin(rows: Rows) -> Figure:
    """Camera rotation error before and after bundle adjustment."""
    figure, (ax,) = panels(1)
    figure.set_size_inches(5.2, 3.2)
    for k, seed in enumerate(sorted({row["seed"] for row in rows})):
        series(ax, [row for row in rows if row["seed"] == seed], "start_deg", "end_deg", k, f"seed {seed}")
    ax.set_yscale("log")
    plain_decades(ax.yaxis)
    ax.set_xlabel("starting poses: camera rotation error, degrees RMS", color=INK)
    ax.set_ylabel("after adjustment, degrees RMS", color=INK)
    ax.legend(frameon=False)
    return figure


def sweeps(rows: Rows) -> Figure:
    """Surface error against decoding quality, number of frames and image size."""
    titles = {
        "noise": "noise, pattern pixels", "missing": "share of cells missing", "wrong": "share of cells wrong",
        "frames": "frames", "resolution": "image width, pixels",
    }  # fmt: skip
    shown = [name for name in titles if any(row["sweep"] == name for row in rows)]
    figure, axes = panels(len(shown))
    for ax, name in zip(axes, shown, strict=True):
        mine = [row for row in rows if row["sweep"] == name]
        for k, (key, label) in enumerate((("rigid_rmse", "RMSE"), ("rigid_median", "median"))):
            series(ax, mine, "value", key, k, label)
        ax.set_xlabel(titles[name], color=INK)
        ax.set_ylim(bottom=0)
    axes[0].set_ylabel("surface, mm", color=INK)
    axes[0].legend(frameon=False)
    return figure


def error_over_time(rows: Rows) -> Figure:
    """Surface error against the seconds of the whole training command."""
    figure, (ax,) = panels(1)
    figure.set_size_inches(5.2, 3.4)
    for k, variant in enumerate(dict.fromkeys(row["variant"] for row in rows)):
        some = [row for row in rows if row["variant"] == variant]
        series(ax, some, "training_seconds", "rigid_rmse", k, variant)
    ax.set_xscale("log")
    ax.set_yscale("log")
    plain_decades(ax.xaxis)
    plain_decades(ax.yaxis)
    ax.set_xlabel("seconds of ns-train, start-up and adjustment included", color=INK)
    ax.set_ylabel("rigid RMSE of the surface, mm", color=INK)
    ax.legend(frameon=False)
    return figure


def all_pictures(results: Path) -> dict[str, Figure | None]:
    """Draw all pictures, by the name of the file; None without results."""

    def rows(name: str) -> Rows:
        path = results / f"{name}.json"
        return json.loads(path.read_text())["rows"] if path.exists() else []

    fused = [
        {"scene": row["scan"].rsplit("-", 1)[0], "variant": FUSION, "rigid_rmse": row["accuracy_rmse"]}
        for row in rows("tsdf_baseline")
        if row["poses"] == "registered"
    ]
    timed = [row for row in rows("sweeps") if row["sweep"] == "time"]
    others = [row for row in rows("sweeps") if row["sweep"] != "time"]
    wanted: dict[str, tuple[Callable[[Rows], Figure], Rows]] = {
        "accuracy.png": (accuracy, rows("accuracy") + fused), "ablation.png": (ablation, rows("ablation")),
        "basin.png": (basin, rows("basin")), "sweeps.png": (sweeps, others),
        "error_over_time.png": (error_over_time, timed),
    }  # fmt: skip
    return {name: draw(found) if found else None for name, (draw, found) in wanted.items()}


def main() -> None:
    """Draw all pictures."""
    given = options(__doc__, results=Path("benchmarks/results"), output=Path("docs/pictures"))
    for name, figure in all_pictures(given.results).items():
        if figure is not None:
            FigureCanvasAgg(figure).print_png(str(given.output / name))
            print(given.output / name)


if __name__ == "__main__":
    main()
