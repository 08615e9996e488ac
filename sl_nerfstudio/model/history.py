"""Convergence curves that are saved in the checkpoint."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
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
        self._used = 0  # rows
        self.every = 5
        """Steps between two entries."""
        self.register_buffer("state", torch.tensor([self._used, self.every]))  # the same two, for the checkpoint
        self.register_load_state_dict_post_hook(_read_state)
        self.register_state_dict_pre_hook(_write_state)

    @torch.no_grad()
    def add(self, step: int, values: Mapping[str, Float[Tensor, ""]]) -> None:
        """Append one row; missing values are NaN. When the table is full, every other row is removed.

        Values on a GPU stay there, so that the host need not wait for them.
        """
        row = self.table[self._used]
        row[1:] = torch.stack([values.get(name, row[0]) for name in self.names])  # unused rows are NaN
        row[0].fill_(step)
        self._used += 1
        if self._used == _ROWS:
            kept = self.table[::2].clone()
            self.table.fill_(float("nan"))
            self.table[: len(kept)] = kept
            self._used = len(kept)
            self.every *= 2

    def latest(self, name: str) -> float:
        """The value of the last row, NaN if there is none."""
        return float(self.table[self._used - 1, 1 + self.names.index(name)]) if self._used else float("nan")

    def curves(self) -> dict[str, list[float]]:
        """Columns by name, `step` first."""
        rows = self.table[: self._used].cpu()
        return {name: rows[:, i].tolist() for i, name in enumerate(("step", *self.names))}


def _write_state(history: History, *_: object) -> None:
    """Before a checkpoint is written."""
    history.state.copy_(torch.tensor([history._used, history.every]))


def _read_state(history: History, _: object) -> None:
    """After a checkpoint was loaded."""
    history._used, history.every = history.state.tolist()
