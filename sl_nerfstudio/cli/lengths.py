"""What sl-eval prints of the distances that were asked for."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sl_nerfstudio.evaluation.lengths import Length


def print_lengths(lengths: "Sequence[Length]", units: str) -> None:
    """A table, and why a distance has no uncertainty."""
    if not lengths:
        return
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title=f"Distances between points, in {units}", title_justify="left")
    for column in ("", "distance", "1 sigma", "from poses", "from noise"):
        table.add_column(column, justify="right" if column else "left")
    for length in lengths:
        sigmas = (length.sigma, length.sigma_shared, length.sigma_independent)
        table.add_row(length.name, f"{length.length:.5g}", *("-" if s is None else f"{s:.2g}" for s in sigmas))
    console.print(table)
    reasons = dict.fromkeys(filter(None, (why_unknown(length) for length in lengths)))
    for reason in reasons:
        console.print(f"  {reason}", highlight=False, soft_wrap=True, markup=False)


def why_unknown(length: "Length") -> str:
    """Why a distance has no uncertainty; "" if it has one."""
    if length.sigma is not None:
        return ""
    if length.views is not None and 0 in length.views:
        return f"{length.name}: no frame confirms the surface at one of its ends, so the distance is not measured"
    return (
        "no uncertainty: it needs mesh.ply of sl-export, and --poses with the folder that the same sl-export wrote "
        "(pose_covariance.npz, of a run that adjusted the poses)"
    )
