"""Train the graph network on random damaged graphs of random patterns.

python -m training.gcn --output outputs/training/gcn
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from sl_nerfstudio.decoding.grid_graph import (
    GraphNetwork,
    TurnedPattern,
    neighbourhoods,
    one_hot,
    turned_pattern,
)
from training.graphs import DamagedGraph, damage_graph, random_codes, random_damage
from training.steps import cosine_rate, descend, log_row, save_weights


@dataclass(frozen=True)
class Config:
    """Training of the graph network."""

    output: Path
    """folder of the weights and the log"""
    steps: int = 500
    """number of steps, one damaged graph each"""
    nodes: int = 320
    """nodes of a graph that are judged in a step"""
    candidates: int = 640
    """other places of the pattern among which they must find their own"""
    rate: float = 2e-3
    """highest learning rate, of AdamW"""
    seed: int = 0
    """determines graphs and initial weights"""
    threads: int = 1
    """processor threads"""
    log_every: int = 50
    """steps per line of the log"""


def step_loss(
    network: GraphNetwork, graph: DamagedGraph, pattern: TurnedPattern, config: Config, rng: np.random.Generator
) -> tuple[torch.Tensor, float]:
    """Cross entropy of the nodes' places among candidates, and the share of nodes recognised."""
    around = torch.from_numpy(neighbourhoods(graph.neighbour).astype(np.int64))
    truth = _candidate_index(graph, pattern)
    judged = rng.permutation(len(truth))[: config.nodes]
    drawn = rng.integers(0, len(pattern.symbol), config.candidates)
    chosen, position = np.unique(np.concatenate([truth[judged], drawn]), return_inverse=True)
    node = network(torch.from_numpy(graph.score), around)[torch.from_numpy(judged)]
    candidate = _candidate_features(network, pattern, chosen)
    logits = network.logits(node, candidate)
    target = torch.from_numpy(position[: len(judged)].astype(np.int64))
    return torch.nn.functional.cross_entropy(logits, target), float((logits.argmax(1) == target).float().mean())


def _candidate_index(graph: DamagedGraph, pattern: TurnedPattern) -> np.ndarray:
    """Index of each node's true place among all candidates."""
    same_turn = np.nonzero(pattern.turn == graph.turn)[0]
    columns = int(pattern.place[same_turn, 1].max()) + 1
    return same_turn[0] + graph.place[:, 0] * columns + graph.place[:, 1]


def _candidate_features(network: GraphNetwork, pattern: TurnedPattern, chosen: np.ndarray) -> torch.Tensor:
    """Features of some places, computed from their neighbours and the neighbours' neighbours only."""
    seen = pattern.around[chosen]
    needed = np.unique(np.concatenate([chosen, seen[seen >= 0]]))
    outer = pattern.around[needed]
    known = np.unique(np.concatenate([needed, outer[outer >= 0]]))
    number = np.full(len(pattern.symbol) + 1, -1, dtype=np.int64)
    number[known] = np.arange(len(known))
    around = torch.from_numpy(number[pattern.around[known]])
    features = network(one_hot(pattern.symbol[known]), around)
    return features[torch.from_numpy(number[chosen])]


def train(config: Config) -> None:
    """Train and write `gcn.safetensors` and `log.jsonl` into the output folder."""
    torch.set_num_threads(config.threads)
    config.output.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(config.seed)
    network = GraphNetwork()
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=1e-3)
    total, recognised, start = 0.0, 0.0, time.monotonic()
    for step in range(config.steps):
        rng = np.random.default_rng([config.seed, step])
        codes = random_codes(rng)
        graph = damage_graph(rng, codes, random_damage(rng), int(rng.integers(4)), rng.uniform(0.1, 0.9))
        if len(graph.place) < 9:
            continue
        loss, right = step_loss(network, graph, turned_pattern(codes), config, rng)
        descend(network, optimizer, cosine_rate(config.rate, step, config.steps, 50), loss)
        total, recognised = total + float(loss.detach()), recognised + right
        if (step + 1) % config.log_every == 0:
            row = {
                "step": step + 1, "seconds": round(time.monotonic() - start),
                "loss": round(total / config.log_every, 4), "recognised": round(recognised / config.log_every, 4),
            }  # fmt: skip
            log_row(config.output, row)
            total, recognised = 0.0, 0.0
    save_weights(network, config.output / "gcn.safetensors", config)


if __name__ == "__main__":
    train(tyro.cli(Config, description=__doc__))
