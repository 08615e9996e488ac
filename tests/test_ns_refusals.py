"""ns-train on what it cannot use: a message, status 1, nothing written."""

import copy
import dataclasses
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
import torch
import yaml
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.plugins.types import MethodSpecification
from nerfstudio.scripts import train as ns_train

from sl_nerfstudio.methods import sl_neus, sl_neus_paper
from sl_nerfstudio.model.optimisers import FusedAdamOptimizerConfig
from sl_nerfstudio.model.poses import PoseMode, PoseOptimizerConfig
from sl_nerfstudio.model.trainer import SLTrainerConfig
from tests.dataparser.tiny_scan import TinyScan

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio emits many warnings


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return TinyScan().write(tmp_path_factory.mktemp("scans") / "sphere")


@pytest.fixture
def refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What ns-train says of a scan, and of settings other than the usual; checks that nothing was written."""

    def run(root: Path | None, **settings: Any) -> str:
        empty = tmp_path / "here"
        empty.mkdir()
        monkeypatch.chdir(empty)
        config = copy.deepcopy(sl_neus.config)
        for name, value in {"data": root, **settings}.items():
            setattr(config, name, value)
        with pytest.raises(SystemExit) as exit_:
            ns_train.main(config)
        out, err = capfd.readouterr()
        assert exit_.value.code == 1 and not list(empty.iterdir()) and "Traceback" not in out + err
        return err

    return run


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_bad_scans_do_not_start(tmp_path, refused) -> None:
    """tests/scan has all faults, and that a training refuses what sl-check finds."""
    root = TinyScan().write(tmp_path / "scan")
    truncate(root / "images/frame_00001.png")
    message = refused(root)
    assert message.startswith("error: ") and str(root) in message
    assert "images/frame_00001.png" in message and "remedy: " in message


def without_rays() -> Any:
    pipeline = copy.deepcopy(sl_neus.config.pipeline)
    pipeline.datamanager.train_num_rays_per_batch = 0
    return pipeline


@pytest.mark.parametrize(
    "settings, expected",
    [
        ({"max_num_iterations": 0}, "--max-num-iterations 0: at least 1"),
        ({"schedule_iterations": 0}, "--schedule-iterations 0: at least 1"),
        ({"machine": replace(sl_neus.config.machine, seed=-1)}, "--machine.seed -1: give a number from 0"),
        ({"pipeline": without_rays()}, "train-num-rays-per-batch 0"),
        ({"timestamp": "../../../escaped"}, "is not the name of a folder inside"),
        ({"experiment_name": ""}, "--experiment-name '': is not the name of a folder"),
        ({"load_dir": Path("nowhere")}, "--load-dir nowhere: no checkpoint step-*.ckpt there"),
        ({"load_checkpoint": Path("none.ckpt")}, "--load-checkpoint none.ckpt: no such file"),
        ({"machine": replace(sl_neus.config.machine, device_type="cpu", num_devices=2)}, "--machine.num-devices 2"),
        pytest.param(
            {"machine": replace(sl_neus.config.machine, device_type="cuda")},
            "--machine.device-type cuda",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there"),
        ),
        ({"data": None}, "no scan given. Add --data FOLDER"),
    ],
)
def test_bad_settings_do_not_start(scan, refused, settings, expected) -> None:
    assert expected in refused(scan, **settings)


def of_poses(method: MethodSpecification, rate: float | None = None, **model: Any) -> dict[str, Any]:
    """A method's settings with other ones of its model, and another learning rate of the cameras."""
    config = copy.deepcopy(method.config)
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    if rate is not None:
        config.optimizers["camera_opt"]["optimizer"] = FusedAdamOptimizerConfig(lr=rate, eps=1e-15)
    return {name: getattr(config, name) for name in ("method_name", "pipeline", "optimizers")}


MODE, CAMERA = "--pipeline.model.{}-optimizer.mode {}", "--optimizers.camera-opt"
SE3, SO3XR3, OFF = (PoseOptimizerConfig(mode) for mode in get_args(PoseMode)[::-1])
OWN_FLAGS = [
    (of_poses(sl_neus, camera_optimizer=SE3, projector_optimizer=OFF, rate=1e-3),
     [MODE.format("camera", "SE3"), MODE.format("projector", "off"), CAMERA, "pose-method adjust"]),
    (of_poses(sl_neus, rate=1e-3), [CAMERA, "pose-method adjust"]),
    (of_poses(sl_neus_paper, camera_optimizer=OFF, rate=1e-2), [CAMERA, "camera-optimizer.mode off"]),
    (of_poses(sl_neus_paper, refine_poses="known-rig", projector_optimizer=SO3XR3),
     [MODE.format("projector", "SO3xR3"), "refine-poses known-rig"]),
    (of_poses(sl_neus_paper, refine_poses="off", camera_optimizer=SE3),
     [MODE.format("camera", "SE3"), "refine-poses off"]),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "expected"), OWN_FLAGS)
def test_optimisers_of_poses_that_no_step_would_move(scan, refused, settings, expected) -> None:
    """One message with all such flags."""
    message = refused(scan, **settings)
    named, cause = message.split(": no step of the training would move these poses\n")
    assert named == "error: " + ", ".join(flag for flag in expected if flag.startswith("--"))
    assert expected[-1] in cause.splitlines()[0] and "remedy: leave these flags out" in cause


def test_a_truncated_checkpoint(scan, tmp_path, refused) -> None:
    checkpoint = tmp_path / "step-000000005.ckpt"
    torch.save({"schedulers": {}, "weights": torch.zeros(1000)}, checkpoint)
    truncate(checkpoint)
    message = refused(scan, load_dir=tmp_path)
    assert message.startswith("error: ") and message.count("error: ") == 1
    assert "step-000000005.ckpt: cannot be read as a checkpoint" in message


def test_other_dataparsers(scan, refused) -> None:
    pipeline = copy.deepcopy(sl_neus.config.pipeline)
    pipeline.datamanager.dataparser = NerfstudioDataParserConfig()
    message = refused(scan, pipeline=pipeline)
    assert message.startswith("error: sl-neus trains on scan folders only") and len(message.splitlines()) == 1
    assert "NerfstudioDataParser has no projector. Leave the dataparser out." in message


@pytest.mark.slow
def test_the_command_itself_refuses_a_bad_scan(tmp_path: Path) -> None:
    """The installed ns-train, in a separate process."""
    root = TinyScan(frames=2).write(tmp_path / "scan")
    (root / "coords/frame_00001.npz").unlink()
    (tmp_path / "here").mkdir()
    command = [Path(sys.executable).with_name("ns-train"), "sl-neus", "--data", root]
    done = subprocess.run(command, cwd=tmp_path / "here", capture_output=True, text=True)
    assert done.returncode == 1
    assert "Traceback" not in done.stdout + done.stderr
    assert "coords/frame_00001.npz" in done.stderr and "remedy:" in done.stderr
    assert not list((tmp_path / "here").iterdir())


OLD = (
    "!!python/object:sl_nerfstudio.model.trainer.SLTrainerConfig\npipeline: !!python/object:sl_nerfstudio.{}\n  x: 1\n"
)


@pytest.mark.parametrize("what", ["training.pipeline.SLPipelineConfig", "model.pipeline.OldPipelineConfig"])
def test_a_config_of_another_version_ends_in_a_sentence(what: str, capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["ns-eval", "--load-config", "old/config.yml"])
    with pytest.raises(yaml.constructor.ConstructorError) as caught:
        yaml.load(OLD.format(what), Loader=yaml.Loader)
    sys.excepthook(caught.type, caught.value, None)
    said = capsys.readouterr().err
    assert said.startswith("error: old/config.yml, line 2: trained by another version of sl_nerfstudio")
    assert what.rpartition(".")[0] in said and "remedy: train again" in said and "Traceback" not in said
    sys.excepthook(ValueError, ValueError("another"), None)
    assert "ValueError: another" in capsys.readouterr().err


def test_the_help_of_a_training_begins_with_what_its_users_set() -> None:
    names = [field.name for field in dataclasses.fields(SLTrainerConfig)]
    assert names[0] == "data" and names.index("pipeline") < names.index("machine") and len(names) == len(set(names))
    assert "--pipeline.model.refine-poses" in sl_neus.description
