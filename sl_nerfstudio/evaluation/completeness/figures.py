"""How completeness is judged: by shares of what was observed, and of the surface."""

from sl_nerfstudio.console import figure, unit_word
from sl_nerfstudio.evaluation.completeness.completeness import Completeness
from sl_nerfstudio.evaluation.figures import JudgedFigure, judged


def completeness_figures(found: Completeness, units: str) -> list[JudgedFigure]:
    """What is missing of the observed surface is a fault; what nobody observed is at most a weakness."""
    o, unit = found.openings, unit_word(units)
    size = f"{len(o)}, {figure(o.area.sum())} {unit}² in all, borders {figure(o.length.sum())} {unit} long"
    return [
        judged(
            "Observed surface", 100 * found.observed, "{:.1f} % present", 99.0, 96.0, "≥ {} %",
            "Share of the decoded pixels of all frames at which the mesh has a surface near the measured point.",
            "surface is missing where it was measured: train longer, or export with a finer resolution",
        ),
        judged(
            "Holes", 100 * found.hole_share, f"{{:.1f}} % of the surface beside the rim (openings: {size})", 5.0,
            float("inf"), "≤ {} %",
            "Area of all places where the mesh ends, except for the largest one, the rim of the scan, as a share of "
            "the surface. Objects are closed: behind each of them is surface that no frame saw.",
            "capture what no frame saw, or export with --keep-unobserved, which invents it",
        ),
    ]  # fmt: skip
