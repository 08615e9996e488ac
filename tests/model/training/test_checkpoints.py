"""Checkpoints that are damaged, or something else: refused before anything is written, never taken for good."""

from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.model.run_files import checkpoints_in, find_checkpoint, read_checkpoint, write_checkpoint
from tests.model.training.small_runs import require_equal, settings, status, train

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely

RATE = {"shape": "cosine", "final": 0.1, "warm_up": 0, "max_steps": 700}
GOOD = {
    "step": 9,
    "pipeline": {"_model.field": torch.arange(12.0).reshape(3, 4), "scan_fingerprint": torch.ones(32).byte()},
    "optimizers": {"mlp": {"state": {0: {"step": torch.tensor(3.0)}}, "param_groups": [{"lr": 0.1, "params": [0]}]}},
    "schedulers": {"mlp": {"lr_lambdas": [RATE]}},
    "scalers": {},
    "schedule_iterations": 700,
}
WRONG: dict[str, tuple[Any, str]] = {
    "list": ([1, 2], "it holds a list"),
    "tensor": (torch.zeros(3), "it holds a Tensor"),
    "None": (None, "it holds a NoneType"),
    "number": (7, "it holds a int"),
    "only weights": (GOOD["pipeline"], "it lacks step"),
    "no optimizers": ({k: v for k, v in GOOD.items() if k != "optimizers"}, "it lacks optimizers"),
    "step as text": ({**GOOD, "step": "9"}, "its step is no number"),
    "step as boolean": ({**GOOD, "step": True}, "its step is no number"),
    "step too small": ({**GOOD, "step": -2}, "its step is no number"),
    "step too large": ({**GOOD, "step": 10**12}, "its step is no number"),
    "schedule as text": ({**GOOD, "schedule_iterations": "long"}, "the length of its schedule is no number"),
    "weights as list": ({**GOOD, "pipeline": [torch.zeros(1)]}, "not made of weights"),
    "weights as numbers": ({**GOOD, "pipeline": {"a": 1.0}}, "not made of weights"),
    "weights without names": ({**GOOD, "pipeline": {1: torch.zeros(1)}}, "not made of weights"),
    "optimizers as list": ({**GOOD, "optimizers": []}, "optimizers or schedulers"),
    "schedulers as text": ({**GOOD, "schedulers": "cosine"}, "optimizers or schedulers"),
    "scheduler as number": ({**GOOD, "schedulers": {"mlp": 3}}, "optimizers or schedulers"),
    "foreign scheduler": ({**GOOD, "schedulers": {"mlp": {"gamma": 0.1}}}, "not those of this package"),
    "foreign rates": ({**GOOD, "schedulers": {"mlp": {"lr_lambdas": [{"gamma": 1}]}}}, "not those of this package"),
    "rates as numbers": ({**GOOD, "schedulers": {"mlp": {"lr_lambdas": [1.0]}}}, "not those of this package"),
}


@pytest.mark.parametrize("state, words", WRONG.values(), ids=WRONG.keys())
def test_what_is_no_checkpoint(tmp_path, state, words):
    torch.save(state, tmp_path / "step-000000009.ckpt")
    with pytest.raises(UserError, match=rf"step-000000009.ckpt: cannot be read as a checkpoint \(.*{words}"):
        read_checkpoint(tmp_path / "step-000000009.ckpt")


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    class Attack:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    torch.save({**GOOD, "scalers": Attack()}, tmp_path / "step-000000009.ckpt")
    with pytest.raises(UserError, match=r"cannot be read as a checkpoint \(UnpicklingError\)"):
        read_checkpoint(tmp_path / "step-000000009.ckpt")
    assert not (tmp_path / "ran").exists()


@pytest.fixture(scope="module")
def good_bytes(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("good") / "step-000000009.ckpt"
    torch.save(GOOD, path)
    return path.read_bytes()


@hypothesis_settings(max_examples=150)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), cut=st.booleans())
def test_a_damaged_file_is_refused_or_still_the_same(tmp_path_factory, good_bytes, place, flip, cut):
    path = tmp_path_factory.getbasetemp() / "damaged.ckpt"
    at = int(place * len(good_bytes))
    spoilt = bytearray(good_bytes)
    spoilt[at] ^= flip
    path.write_bytes(bytes(spoilt[:at] if cut else spoilt))
    try:
        found = read_checkpoint(path)
    except UserError as error:
        assert str(error).startswith(f"{path}: cannot be read as a checkpoint")
    else:
        assert found.step == 9 and found.schedule_iterations == 700
        require_equal(found.weights, GOOD["pipeline"])


def test_names_that_are_no_numbers_are_left_alone(tmp_path):
    for name in ("step-000000003.ckpt", "step-000000021.ckpt", "step-xyz.ckpt", "step-1.ckpt", "best.ckpt", ".x"):
        (tmp_path / name).touch()
    assert [path.name for path in checkpoints_in(tmp_path)] == ["step-000000003.ckpt", "step-000000021.ckpt"]
    assert find_checkpoint(tmp_path, None, None) == tmp_path / "step-000000021.ckpt"
    with pytest.raises(UserError, match=r"no checkpoint step-000000007.ckpt there"):
        find_checkpoint(tmp_path, 7, None)


def test_a_checkpoint_is_complete_or_not_there(tmp_path):
    path, partial = tmp_path / "models/step-000000009.ckpt", tmp_path / "partial"
    write_checkpoint(path, GOOD, partial)
    before = path.read_bytes()
    with pytest.raises(UserError, match="cannot be written"):
        write_checkpoint(path, GOOD, tmp_path / "missing/partial")
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == ["models"]


def test_weights_of_another_model_are_a_message(scan_root, copy, tmp_path, capfd):
    """Their parts are right, but they do not fit the settings of the new training."""
    other = settings(scan_root, tmp_path, "other", load_dir=copy / "nerfstudio_models")
    other.pipeline.model.sdf.hidden = 32
    assert status(train, other) == 1
    error = capfd.readouterr().err
    assert "does not fit this training" in error and "Traceback" not in error
