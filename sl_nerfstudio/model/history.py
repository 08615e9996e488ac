"""Convergence curves that are saved in the checkpoint."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

_ROWS = 512


class History(nn.Module):
    """A table of values over the run, thinned out when full, so that a run of any length fits."""

    table: Tensor
    state: Tensor

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        self.register_buffer("table", torch.full((_ROWS, len(names) + 1), float("nan"), dtype=torch.float64))
        self.register_buffer("state", torch.tensor([0, 5]))  # rows used, steps between rows

    @property
    def every(self) -> int:
        """Steps between two entries."""
        return int(self.state[1])

    def add(self, step: int, values: dict[str, float]) -> None:
        """Append one row; missing values are NaN. When the table is full, every other row is removed."""
        used = int(self.state[0])
        row = [float(step), *(values.get(name, float("nan")) for name in self.names)]
        self.table[used] = torch.tensor(row, dtype=torch.float64)
        used += 1
        if used == _ROWS:
            kept = self.table[::2].clone()
            self.table.fill_(float("nan"))
            self.table[: len(kept)] = kept
            used = len(kept)
            self.state[1] *= 2
        self.state[0] = used

    def latest(self, name: str) -> float:
        """The value of the last row, NaN if there is none."""
        used = int(self.state[0])
        return float(self.table[used - 1, 1 + self.names.index(name)]) if used else float("nan")

    def curves(self) -> dict[str, list[float]]:
        """Columns by name, `step` first."""
        rows = self.table[: int(self.state[0])].cpu()
        return {name: rows[:, i].tolist() for i, name in enumerate(("step", *self.names))}
