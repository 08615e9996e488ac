"""Runs that are damaged, edited or made to run code: config.yml and checkpoints."""

import random
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.attacks.commands import Case, accepted, call, refused

RUN = Path("run/scan/sl-neus/first")
CHECKPOINT = RUN / "nerfstudio_models/step-000000019.ckpt"
EXPORT = ("sl-export", "--load-config", str(RUN / "config.yml"), "--output", "mesh.ply", "--resolution", "24")
CHECK = ("sl-check", str(RUN))
RESUME = ("ns-train", "sl-neus", "--data", "scan", "--load-dir", str(CHECKPOINT.parent), "--output-dir", "new")
RAN = "ran"

_CODE = (
    "!!python/object/apply:os.system ['touch ran']", "!!python/object/apply:subprocess.check_output [[touch, ran]]",
    "!!python/object/new:os.system ['touch ran']", "!!python/object:subprocess.Popen {args: [touch, ran]}",
    '!!python/object/apply:builtins.exec [\'open("ran", "w")\']', "!!python/object/apply:builtins.open ['ran', 'w']",
    "!!python/object/apply:pathlib.Path.touch [ran]", "!!python/object/apply:torch.load [ran]",
    "!!python/module:antigravity", "!!python/name:os.system ''",
    "!!python/object/apply:nerfstudio.utils.writer.EventName.__init__ [ran]",
    "!!python/object/new:type {args: [A, !!python/tuple [], {}]}",
)  # fmt: skip
_PLACES = ("prompt: null", "seed: 42", "timestamp: first", "gradient_accumulation_steps: {}")


def cases() -> list[Case]:
    """Every damaged, edited or hostile file of a run."""
    return [*_code(), *_structures(), *_checkpoints(), *_damaged()]


def _change(path: Path, change: Callable[[str], str]) -> None:
    text = path.read_text()
    changed = change(text)
    assert changed != text, "the case changes nothing"
    path.write_text(changed)


def _refused_without_effect(folder: Path, command: tuple[str, ...], *words: str) -> str:
    """The fault unless the command refused, ran nothing of the file, and left no output."""
    done = call(folder, *command)
    if (folder / RAN).exists():
        return "ran code from the file"
    left = [name for name in ("mesh.ply", "new") if (folder / name).exists()]
    return refused(done, *words) or (f"left {left[0]}" if left else "")


def _code() -> list[Case]:
    found = []
    for number, text in enumerate(_CODE):
        for name, command in (("sl-export", EXPORT), ("sl-check", CHECK)):
            place = _PLACES[number % len(_PLACES)]

            new = f"{place.split(':')[0]}: {text}"
            attack = partial(_edited, change=partial(_replaced, old=place, new=new), command=command, word=", line")
            found.append(Case("Code in config.yml", f"{name}: {text[:48]}", ("run",), attack))
    return found


def _replaced(text: str, old: str, new: str) -> str:
    return text.replace(old, new, 1)


def _edited(folder: Path, change: Callable[[str], str], command: tuple[str, ...], word: str = "") -> str:
    _change(folder / RUN / "config.yml", change)
    return _refused_without_effect(folder, command, f"config.yml{word}")


def _without(name: str) -> Callable[[str], str]:
    return lambda text: re.sub(rf"(?m)^{name}:.*\n([ -].*\n)*", "", text)


def _structures() -> list[Case]:
    nested = "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 40))
    merged = "a0: &a0 {x: 1}\n" + "".join(
        f"a{i}: &a{i}\n  <<: [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 40)
    )
    changes: dict[str, Callable[[str], str]] = {
        "empty": lambda text: "",
        "a word": lambda text: "word",
        "a list": lambda text: "[1, 2]",
        "[ x 100,000": lambda text: "[" * 100_000,
        "{a: x 20,000": lambda text: "{a: " * 20_000,
        "- x 50,000": lambda text: "- " * 50_000,
        "! x 50,000": lambda text: "!" * 50_000,
        "aliases of aliases": lambda text: nested,
        "merged aliases": lambda text: merged,
        "300,000 lines": lambda text: "a: 1\n" * 300_000,
        "40,000 duplicate keys": lambda text: "a: 1\n" * 40_000,
        "half of it": lambda text: text[: len(text) // 2],
        "twice": lambda text: text + "---\n" + text,
        "upper case": str.upper,
        **{
            f"without {name}": _without(name) for name in ("pipeline", "machine", "method_name", "output_dir", "viewer")
        },
        "pipeline null": lambda text: _without("pipeline")(text) + "pipeline: null\n",
        "pipeline a list": lambda text: _without("pipeline")(text) + "pipeline: [1]\n",
        "unknown setting": lambda text: text + "colour: red\n",
        "unknown class": lambda text: text.replace("configs.base_config.MachineConfig", "configs.base_config.Nothing"),
        "another target": lambda text: text.replace("model.model.SLModel ", "model.pipeline.SLPipeline "),
        "hidden: 10**9": lambda text: re.sub(r"hidden: \d+", "hidden: 1000000000", text),
        "log2_table_size: 60": lambda text: re.sub(r"log2_table_size: \d+", "log2_table_size: 60", text),
        "levels: -1": lambda text: re.sub(r"levels: \d+", "levels: -1", text),
        "eikonal: .nan": lambda text: re.sub(r"eikonal: \S+", "eikonal: .nan", text),
    }
    found = []
    for title, change in changes.items():
        for name, command in (("sl-export", EXPORT), ("sl-check", CHECK)):
            attack = partial(_edited, change=change, command=command)
            found.append(Case("Broken config.yml", f"{name}: {title}", ("run",), attack))
    return found


def _another_mesh(folder: Path) -> str:
    """The fault if mesh.ply is not what the untouched run gives."""
    fixtures = folder.parent.parent / "fixtures"
    command = ("sl-export", "--load-config", str(fixtures / RUN / "config.yml"), "--output", "right.ply")
    fault = accepted(call(folder, *command, "--resolution", "24"))
    same = not fault and (folder / "mesh.ply").read_bytes() == (folder / "right.ply").read_bytes()
    return fault or ("" if same else "accepted, and another mesh than that of the run")


def _state(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        import torch

        torch.save(change(torch.load(path)), path)

    return spoil


def _checkpoints() -> list[Case]:
    """What is no checkpoint, for each command that reads one."""

    class Attack:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (Path(RAN),))

    def renamed(weights: dict[str, Any]) -> dict[str, Any]:
        return {f"other.{key}": value for key, value in weights.items()}

    rate = {"gamma": 0.1}
    states: dict[str, Callable[[Path], object]] = {
        "a list": _state(lambda state: [1, 2]),
        "a tensor": _state(lambda state: state["pipeline"]["_model.cache.values"]), "None": _state(lambda state: None),
        "a number": _state(lambda state: 7),
        "without step": _state(lambda state: {k: v for k, v in state.items() if k != "step"}),
        "without optimizers": _state(lambda state: {k: v for k, v in state.items() if k != "optimizers"}),
        "step 'nine'": _state(lambda state: {**state, "step": "nine"}),
        "step 1e9": _state(lambda state: {**state, "step": 10**9}),
        "weights a list": _state(lambda state: {**state, "pipeline": []}),
        "weights of another model": _state(lambda state: {**state, "pipeline": renamed(state["pipeline"])}),
        "schedulers None": _state(lambda state: {**state, "schedulers": None}),
        "schedulers foreign": _state(lambda state: {**state, "schedulers": {"mlp": rate}}),
        "schedulers' rates foreign": _state(lambda state: {**state, "schedulers": {"mlp": {"lr_lambdas": [rate]}}}),
        "code": _state(lambda state: {**state, "scalers": Attack()}), "empty": lambda path: path.write_bytes(b""),
        "text": lambda path: path.write_text("weights"),
        "a picture": lambda path: path.write_bytes(b"\x89PNG\r\n" + bytes(1000)),
        "a folder": lambda path: path.unlink() or path.mkdir(),
    }  # fmt: skip

    def attack(folder: Path, spoil: Callable[[Path], object], command: tuple[str, ...]) -> str:
        spoil(folder / CHECKPOINT)
        return _refused_without_effect(folder, command)

    group = "Broken checkpoints"
    return [
        Case(group, f"{name}: {title}", ("run", "scan"), partial(attack, spoil=spoil, command=command))
        for title, spoil in states.items()
        for name, command in (("sl-export", EXPORT), ("sl-check", CHECK), ("ns-train --load-dir", RESUME))
    ]


def _damaged() -> list[Case]:
    """Cut off, or with a byte changed, at seeded places."""

    def cut(folder: Path, seed: int) -> str:
        path = folder / CHECKPOINT
        with path.open("r+b") as stream:
            stream.truncate(random.Random(seed).randrange(path.stat().st_size))
        return _refused_without_effect(folder, (EXPORT, CHECK, RESUME)[seed % 3])

    def flip(folder: Path, seed: int) -> str:
        path, rng = folder / CHECKPOINT, random.Random(seed)
        at = rng.randrange(path.stat().st_size) if seed % 2 else -rng.randrange(1, 4000)
        with path.open("r+b") as stream:
            stream.seek(at, 0 if at >= 0 else 2)
            byte = stream.read(1)[0] ^ (1 << rng.randrange(8))
            stream.seek(-1, 1)
            stream.write(bytes([byte]))
        done = call(folder, *EXPORT)
        return refused(done) if done.status else accepted(done) or _another_mesh(folder)

    group = "Broken checkpoints"
    return [
        *(Case(group, f"cut off, seed {seed}", ("run", "scan"), partial(cut, seed=seed)) for seed in range(12)),
        *(Case(group, f"a bit flipped, seed {seed}", ("run", "scan"), partial(flip, seed=seed)) for seed in range(16)),
    ]
