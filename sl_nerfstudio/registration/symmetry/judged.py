"""How much of the frames agrees, and contradicts, if each is moved by a turn of the world and the others stay."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.graph_residuals import Nodes, node_at
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.surface_agreement import Side, Tolerance, agreement
from sl_nerfstudio.registration.settings import RegistrationSettings


@dataclass(frozen=True)
class Judged:
    """Points of pairs of frames, in frames: 1 is all points of one. Row i is moved, column j stays.

    Only frames that have a pose have a row.
    """

    agreeing: Float64[ndarray, "n n"]
    contradicting: Float64[ndarray, "n n"]

    def across(self, block: Bool[ndarray, "n"]) -> tuple[float, float]:
        """Those that agree and those that contradict, of the pairs of a frame of the block and another."""
        pairs = np.ix_(block, ~block)
        return float(self.agreeing[pairs].sum()), float(self.contradicting[pairs].sum())

    @property
    def total(self) -> float:
        """All points that agree."""
        return float(self.agreeing.sum())

    @property
    def share(self) -> float:
        """Of all points that could be judged, those that contradict."""
        return share(self.total, float(self.contradicting.sum()))


def share(agreeing: float, contradicting: float) -> float:
    """Of points that contradict; 1 if there are none at all."""
    return contradicting / (agreeing + contradicting) if agreeing + contradicting else 1.0


def judged(
    sides: Sequence[Side], nodes: Nodes, turn: Similarity, neighbours: int, settings: RegistrationSettings
) -> Judged:
    """Every frame that has a pose, moved, against `neighbours` others that then look most nearly its way."""
    row = {k: n for n, k in enumerate(k for k, S in enumerate(nodes) if S is not None)}
    agreeing, contradicting = np.zeros((2, len(row), len(row)))
    width, agrees = Tolerance(0.0, settings.assembly.tolerance_sigmas), settings.pair.agreement
    for i, j, S in facing(nodes, turn, neighbours, settings):
        found = agreement(sides[i], sides[j], Hypotheses.of(S), width, width, agrees)
        agreeing[row[i], row[j]] = found.agreeing[0]
        contradicting[row[i], row[j]] = found.contradicting(agrees.behind)[0]
    return Judged(agreeing, contradicting)


def facing(
    nodes: Nodes, turn: Similarity, neighbours: int, settings: RegistrationSettings
) -> Iterator[tuple[int, int, Similarity]]:
    """A moved frame, another that looks nearly its way, and the first in the second's axes."""
    least_cosine = np.cos(np.radians(settings.selection.largest_view_angle_deg))
    frames = [k for k, S in enumerate(nodes) if S is not None]
    sight = np.array([node_at(nodes, k).R[:, 2] for k in frames])
    for n, i in enumerate(frames):
        moved = turn @ node_at(nodes, i)
        cosine = np.asarray(sight @ moved.R[:, 2], dtype=np.float64)
        cosine[n] = -np.inf
        for k in np.argsort(-cosine, kind="stable")[:neighbours].tolist():
            if cosine[k] > least_cosine:
                yield i, frames[k], node_at(nodes, frames[k]).inverse() @ moved
