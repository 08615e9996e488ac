"""config.yml is read without running anything from it, and whatever it holds gives settings or a message."""

import copy
import re
import warnings
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.model.poses import PoseOptimizerConfig
from sl_nerfstudio.model.run_files import decisive_settings, settings_fingerprint
from sl_nerfstudio.model.trainer import SLTrainerConfig
from sl_nerfstudio.runs.run import read_config

with warnings.catch_warnings():  # warnings are errors, but these are nerfstudio's own
    warnings.simplefilter("ignore")
    from sl_nerfstudio.methods import sl_neus, sl_neus_paper


TEXT = yaml.dump(sl_neus.config)
ATTACK = '!!python/object/apply:os.system ["touch {ran}"]'


def read(folder: Path, text: str | bytes) -> SLTrainerConfig:
    path = folder / "config.yml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_config(path)


@pytest.mark.parametrize("method", [sl_neus, sl_neus_paper], ids=["sl-neus", "sl-neus-paper"])
def test_what_a_training_writes_is_read(tmp_path, method):
    assert read(tmp_path, yaml.dump(method.config)) == method.config


@pytest.mark.parametrize(
    "text",
    [
        ATTACK,
        TEXT.replace("prompt: null", f"prompt: {ATTACK}", 1),
        TEXT.replace("!!python/name:torch.optim.adam.Adam ''", "!!python/name:os.system ''", 1),
        TEXT.replace("!!python/name:torch.optim.adam.Adam ''", "!!python/module:antigravity", 1),
        TEXT.replace("accumulation_steps: {}", "accumulation_steps: !!python/object/new:os.system []", 1),
        TEXT.replace("prompt: null", "prompt: !!python/object:subprocess.Popen {args: 'touch {ran}'}", 1),
        TEXT.replace("nerfstudio.configs.base_config.MachineConfig", "types.SimpleNamespace", 1),
        TEXT.replace("prompt: null", "prompt: !!python/object/apply:builtins.eval ['open(\"{ran}\", \"w\")']", 1),
        TEXT.replace("prompt: null", "prompt: !!python/object/apply:pathlib.Path.touch ['{ran}']", 1),
    ],
)  # fmt: skip
def test_code_is_not_run(tmp_path, text):
    """The line is named, and nothing happens."""
    assert text != TEXT
    with pytest.raises(UserError, match=r"config.yml, line \d+: .*(is not a|is no value|expected)"):
        read(tmp_path, text.replace("{ran}", str(tmp_path / "ran")))
    assert not (tmp_path / "ran").exists()


FAULTS = {
    "no mapping": ("- 1\n- 2\n", "is not a training configuration"),
    "a word": ("words", "is not a training configuration"),
    "no pipeline": (re.sub(r"\npipeline:.*?\n(?=\w)", "\n", TEXT, flags=re.S), "lacks the setting 'pipeline'"),
    "a setting of another version": (TEXT + "colour: red\n", "by an earlier version(.|\n)*has no setting 'colour'"),
    "text for a number": (TEXT.replace("seed: 42", "seed: many"), "'many' is no value for MachineConfig.seed"),
    "a list for settings": (re.sub(r"machine: .*?\n(?=\w)", "machine: []\n", TEXT, flags=re.S), "is no value for"),
    "unknown choice": (TEXT.replace("refine_poses: free", "refine_poses: all"), "'all' is no value"),
    "another class": (
        TEXT.replace("name:sl_nerfstudio.model.model.SLModel ", "name:sl_nerfstudio.model.pipeline.SLPipeline "),
        "no value for SLModelConfig._target",
    ),
    "brackets": ("[" * 100_000, "nested too deeply"),
    "indents": ("\n".join(" " * i + "a:" for i in range(1200)), "nested too deeply|cannot be read"),
    "a list in itself": ("&a [*a]", "is not a training configuration"),
    "many aliases": (
        "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 40)),
        "is not a training configuration",
    ),
    "many merges": (
        "a0: &a0 {x: 1}\n" + "".join(f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 40)),
        "`<<` is not a setting",
    ),
    "a long number": (TEXT.replace("seed: 42", f"seed: {'9' * 5000}"), "cannot be read|is no value"),
    "a large file": ("a: 1\n" * 300_000, r"it has 2 MB"),
    "not text": (b"\xff\xfe\x00", "cannot be read"),
    "impossible date": (TEXT.replace("timestamp: '{timestamp}'", "timestamp: 2001-99-99"), "cannot be read"),
}


@pytest.mark.parametrize("text, words", FAULTS.values(), ids=FAULTS.keys())
def test_what_is_no_configuration(tmp_path, text, words):
    assert text != TEXT
    with pytest.raises(UserError, match=words):
        read(tmp_path, text)


def test_a_run_without_optimisers_of_poses_is_one_that_did_not_state_them(tmp_path):
    """It was trained before there were such settings, and goes on as it would have."""
    text = re.sub(
        r"\n +camera_optimizer: .*PoseOptimizerConfig\n +mode: null|\n +projector_optimizer: \*id\d+", "", TEXT
    )
    assert "PoseOptimizerConfig" in TEXT and "PoseOptimizerConfig" not in text and "projector_optimizer" not in text
    config = read(tmp_path, text)
    assert config == sl_neus.config
    assert settings_fingerprint(config) == settings_fingerprint(sl_neus.config)
    decided = decisive_settings(sl_neus.config)["model"]
    assert "camera_optimizer" not in decided and "projector_optimizer" not in decided
    chosen = copy.deepcopy(sl_neus.config)
    chosen.pipeline.model.projector_optimizer = PoseOptimizerConfig("SO3xR3")
    assert read(tmp_path, yaml.dump(chosen)) == chosen
    assert settings_fingerprint(chosen) != settings_fingerprint(sl_neus.config)
    loaded = yaml.load(text, Loader=yaml.Loader)  # as nerfstudio's own commands do
    assert loaded.pipeline.model.moved_by_rendering == (False, False)


EARLIER = """\
!!python/object:sl_nerfstudio.model.trainer.SLTrainerConfig
_target: !!python/name:sl_nerfstudio.model.training.loop.SLTrainer ''
cuda_graph: true
pipeline: !!python/object:sl_nerfstudio.model.pipeline.SLPipelineConfig
  model: !!python/object:sl_nerfstudio.model.config.SLModelConfig
    sdf: !!python/object:sl_nerfstudio.field.sdf_field.FieldConfig
      features: 8
"""


@pytest.mark.parametrize("text", [EARLIER, re.sub("_target.*\n", "", EARLIER)])
def test_a_run_of_an_earlier_version_is_said_to_be_one(tmp_path, text):
    """With class paths and settings that are gone; it would take its sources to open it."""
    said = r"line \d+: this run was trained by an earlier version(.|\n)*remedy: train again"
    with pytest.raises(UserError, match=said):
        read(tmp_path, text)


@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_file_gives_settings_or_a_message(tmp_path_factory, data):
    lines = TEXT.splitlines()
    number = data.draw(st.integers(0, len(lines) - 1))
    line = lines[number]
    values = st.sampled_from(["*id001", "!!python/tuple []", "[]", "{}", "null", "1e400", ".nan", "-1", "&a"])
    cut = st.text(max_size=8).map(lambda text: line[: len(line) // 2] + text)
    other = values.map(lambda value: f"{line.split(':')[0]}: {value}")
    lines[number] = data.draw(st.one_of(st.just(""), st.just(line + line), cut, other))
    try:
        found = read(tmp_path_factory.getbasetemp(), "\n".join(lines).encode("utf-8", "surrogatepass"))
    except UserError as error:
        assert "config.yml" in str(error)
    else:
        assert isinstance(found, SLTrainerConfig)
        assert isinstance(found.pipeline.model, type(sl_neus.config.pipeline.model))
