"""Graph network against window matching on grid graphs of the default pattern, with misread symbols and missing nodes.

python -m benchmarks.decoding_graphs [--graphs 10] [--output results.json]
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from benchmarks.baselines.window_matching import match_windows
from benchmarks.common.machine import write_rows
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.decoding.grid_detection import NodeRecogniser
from sl_nerfstudio.decoding.grid_graph import neighbourhoods, turned_pattern
from sl_nerfstudio.pattern.grid import GridPattern
from training.graphs import Damage, DamagedGraph, damage_graph


@dataclass(frozen=True)
class Config:
    """Shares of nodes that are placed rightly and wrongly."""

    misread: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3)
    """shares of symbols misread"""
    missing: float = 0.2
    """share of the nodes that are missing"""
    graphs: int = 12
    """graphs of each kind, each a random part of the pattern"""
    seed: int = 100
    """seed of the graphs; training uses others"""
    output: Path | None = None
    """where to write the figures as JSON, with machine, date and commit"""


@dataclass(frozen=True)
class Row:
    """Shares of all nodes: at their true place, and at a wrong one. The rest were given none."""

    misread: float
    missing: float
    method: str
    right: float
    wrong: float


METHODS = ("windows, exact", "windows, one symbol off", "graph network, each node alone", "graph network and consensus")


def answers(recogniser: NodeRecogniser, graph: DamagedGraph) -> dict[str, np.ndarray]:
    """(quarter turn, row, column) that each method gives to every node, -1 for none."""
    pattern = turned_pattern(recogniser.codes)
    around = neighbourhoods(graph.neighbour)
    places = np.column_stack([pattern.turn, pattern.place]).astype(np.int64)
    places = np.vstack([places, np.full((1, 3), -1)])
    alone = recogniser.logits(graph.as_grid()).argmax(1).numpy()
    assignment = recogniser.assign(graph.as_grid())
    together = np.column_stack([np.full(len(alone), assignment.turn), assignment.place])
    return dict(
        zip(
            METHODS,
            (
                places[match_windows(graph.score, around, pattern, 0)],
                places[match_windows(graph.score, around, pattern, 1)],
                places[alone],
                np.where(assignment.known[:, None], together, -1),
            ),
            strict=True,
        )
    )


def measure(recogniser: NodeRecogniser, config: Config, misread: float) -> list[Row]:
    """All methods on the same graphs."""
    right, wrong, total = np.zeros(len(METHODS)), np.zeros(len(METHODS)), 0
    codes = recogniser.codes
    for index in range(config.graphs):
        rng = np.random.default_rng([config.seed, round(100 * misread), index])
        graph = damage_graph(rng, codes, Damage(misread, config.missing), index % 4, 0.4)
        truth = np.column_stack([np.full(len(graph.place), graph.turn), graph.place])
        total += len(truth)
        for k, answer in enumerate(answers(recogniser, graph).values()):
            same = (answer == truth).all(-1)
            right[k] += same.sum()
            wrong[k] += (~same & (answer[:, 1] >= 0)).sum()
    return [
        Row(misread, config.missing, name, round(right[k] / total, 4), round(wrong[k] / total, 4))
        for k, name in enumerate(METHODS)
    ]


def main() -> None:
    """Print the table and write it to JSON."""
    config = tyro.cli(Config, description=__doc__)
    torch.set_num_threads(2)
    recogniser = NodeRecogniser(GridPattern())
    rows = [row for misread in config.misread for row in measure(recogniser, config, misread)]
    print("| misread | missing | method | right | wrong |\n|---|---|---|---|---|")
    for row in rows:
        print(f"| {row.misread:.0%} | {row.missing:.0%} | {row.method} | {row.right:.1%} | {row.wrong:.1%} |")
    if config.output is not None:
        write_rows(config.output, rows)


if __name__ == "__main__":
    run(main)
