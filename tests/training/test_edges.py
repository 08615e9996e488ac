"""Training of the edge network: what a step minimises; an interrupted run ends where an uninterrupted one does."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from sl_nerfstudio.decoding.grid_edges import EdgeOutput
from training import edges
from training.edge_errors import losses
from training.edges import Config, train


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    output = tmp_path_factory.mktemp("edges")
    few = {"captures": 3, "size": 160, "objects": 1, "frames": 2, "steps": 4, "batch": 2, "crop": 64}
    return Config(output, **few, threads=1, log_every=1)


def test_the_best_possible_output_costs_least():
    errors = torch.rand(2, 33, 8, 8)
    errors[0, :, :4] = torch.nan  # nothing reaches these
    chosen = errors.nan_to_num(nan=9.0).argmin(1)
    scores = 100 * torch.nn.functional.one_hot(chosen, 33).movedim(-1, 1).float()
    wrong = errors.nan_to_num(nan=9.0).amin(1) > 0.1
    found = losses(EdgeOutput(scores, 100 * (2.0 * wrong - 1)), errors)
    assert found["risk"].item() == pytest.approx(found["least"].item(), abs=1e-5)
    assert found["risk"] < found["own"]
    assert found["wrong"].item() < 1e-5
    assert losses(EdgeOutput(-scores, scores[:, 0]), errors)["risk"] > found["risk"]
    assert losses(EdgeOutput(scores, -100 * (2.0 * wrong - 1)), errors)["wrong"] > 50


@pytest.mark.slow
def test_an_interrupted_training_ends_where_an_uninterrupted_one_does(small, monkeypatch):
    monkeypatch.setattr(edges, "_CHECKPOINT", 2)
    train(small)
    whole = load_file(small.output / "edges.safetensors")
    saved = edges._save
    other = replace(small, output=small.output / "again")
    other.output.mkdir()
    (small.output / "captures").rename(other.output / "captures")

    def interrupted(config, step, *state):
        saved(config, step, *state)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(edges, "_save", interrupted)
        train(other)
    train(other)
    parts = load_file(other.output / "edges.safetensors")
    assert whole.keys() == parts.keys()
    for name, value in whole.items():
        np.testing.assert_array_equal(parts[name], value, err_msg=name)
    lines = (other.output / "log.jsonl").read_text().splitlines()
    assert [line.count('"after"') for line in lines].count(1) == 1
