"""Runs that are damaged, edited, mixed up or made to run code: config.yml, checkpoints, and the scan they belong to."""

import json
import random
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import Done, call
from benchmarks.attacks.expect import accepted, refused

RUN = Path("run/scan/sl-neus/first")
CHECKPOINT = RUN / "nerfstudio_models/step-000000019.ckpt"
EXPORT = ("sl-export", "--load-config", str(RUN / "config.yml"), "--output", "mesh.ply", "--resolution", "24")
CHECK = ("sl-check", str(RUN))
RESUME = ("ns-train", "sl-neus", "--data", "scan", "--load-dir", str(CHECKPOINT.parent), "--output-dir", "new")
RAN = "ran"

_CODE = (
    "!!python/object/apply:os.system ['touch ran']",
    "!!python/object/apply:subprocess.check_output [[touch, ran]]",
    "!!python/object/new:os.system ['touch ran']",
    "!!python/object:subprocess.Popen {args: [touch, ran]}",
    '!!python/object/apply:builtins.exec [\'open("ran", "w")\']',
    "!!python/object/apply:builtins.open ['ran', 'w']",
    "!!python/object/apply:pathlib.Path.touch [ran]",
    "!!python/object/apply:torch.load [ran]",
    "!!python/module:antigravity",
    "!!python/name:os.system ''",
    "!!python/object/apply:nerfstudio.utils.writer.EventName.__init__ [ran]",
    "!!python/object/new:type {args: [A, !!python/tuple [], {}]}",
)
_PLACES = ("prompt: null", "seed: 42", "timestamp: first", "gradient_accumulation_steps: {}")


def cases() -> list[Case]:
    """All of them."""
    return [*_code(), *_structures(), *_edited_lines(), *_checkpoints(), *_damaged(), *_mixed_up()]


def _change(path: Path, change: Callable[[str], str]) -> None:
    text = path.read_text()
    changed = change(text)
    assert changed != text, "the case changes nothing"
    path.write_text(changed)


def _refused_without_effect(folder: Path, command: tuple[str, ...], *words: str) -> str:
    """As `refused`; nothing of the file was run, and no output is there."""
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

            def attack(folder: Path, text: str = text, place: str = place, command: tuple[str, ...] = command) -> str:
                new = f"{place.split(':')[0]}: {text}"
                _change(folder / RUN / "config.yml", lambda config: config.replace(place, new, 1))
                return _refused_without_effect(folder, command, "config.yml, line")

            found.append(Case("Code in config.yml", f"{name}: {text[:48]}", ("run",), attack))
    return found


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

            def attack(folder: Path, change: Callable[[str], str] = change, command: tuple[str, ...] = command) -> str:
                _change(folder / RUN / "config.yml", change)
                return _refused_without_effect(folder, command, "config.yml")

            found.append(Case("Broken config.yml", f"{name}: {title}", ("run",), attack))
    return found


def _edited_lines() -> list[Case]:
    """One line changed: refused, or without effect on the result."""
    values = ("[]", "{}", "null", "'text'", "-1", "1e400", ".nan", "!!python/tuple []", "&a 1", "0.3")

    def attack(folder: Path, seed: int) -> str:
        rng = random.Random(seed)
        path = folder / RUN / "config.yml"
        lines = path.read_text().splitlines()
        number = rng.randrange(len(lines))
        new = rng.choice(
            (f"{lines[number].split(':')[0]}: {rng.choice(values)}", lines[number][: rng.randrange(30)], "")
        )
        lines[number] = new
        path.write_text("\n".join(lines))
        done = call(folder, *EXPORT, "--data", "scan")
        return refused(done) if done.status else accepted(done) or _another_mesh(folder)

    return [
        Case("Broken config.yml", f"sl-export: a line changed, seed {seed}", ("run", "scan"), _seeded(attack, seed))
        for seed in range(24)
    ]


def _seeded(attack: Callable[[Path, int], str], seed: int) -> Callable[[Path], str]:
    return lambda folder: attack(folder, seed)


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
        "a tensor": _state(lambda state: state["pipeline"]["_model.cache.values"]),
        "None": _state(lambda state: None),
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
        "code": _state(lambda state: {**state, "scalers": Attack()}),
        "empty": lambda path: path.write_bytes(b""),
        "text": lambda path: path.write_text("weights"),
        "a picture": lambda path: path.write_bytes(b"\x89PNG\r\n" + bytes(1000)),
        "a folder": lambda path: path.unlink() or path.mkdir(),
    }
    found = []
    for title, spoil in states.items():
        for name, command in (("sl-export", EXPORT), ("sl-check", CHECK), ("ns-train --load-dir", RESUME)):

            def attack(
                folder: Path, spoil: Callable[[Path], object] = spoil, command: tuple[str, ...] = command
            ) -> str:
                spoil(folder / CHECKPOINT)
                return _refused_without_effect(folder, command)

            found.append(Case("Broken checkpoints", f"{name}: {title}", ("run", "scan"), attack))
    return found


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
        *(Case(group, f"cut off, seed {seed}", ("run", "scan"), _seeded(cut, seed)) for seed in range(12)),
        *(Case(group, f"a bit flipped, seed {seed}", ("run", "scan"), _seeded(flip, seed)) for seed in range(16)),
    ]


def _move_pose(scan: Path) -> None:
    content = json.loads((scan / "transforms.json").read_text())
    content["frames"][2]["transform_matrix"][1][3] *= 1.001
    (scan / "transforms.json").write_text(json.dumps(content))


def _other_focal(scan: Path) -> None:
    content = json.loads((scan / "transforms.json").read_text())
    content["projector"]["fl_x"] *= 1.001
    (scan / "transforms.json").write_text(json.dumps(content))


def _nudge(scan: Path) -> None:
    path = sorted((scan / "coords").iterdir())[0]
    with np.load(path) as file:
        values = {name: file[name].copy() for name in file.files}
    for value in values.values():
        if value.dtype.kind == "f":
            value[np.isfinite(value)] += 0.05
    np.savez(path.with_suffix(".npz"), **values)


def _mixed_up() -> list[Case]:
    """Scan, config.yml and checkpoint of different runs; and what may change without harm."""
    group, found = "Parts of different runs", []
    for title, change in (("a pose", _move_pose), ("a focal length", _other_focal), ("coordinates", _nudge)):
        for name, command in (("sl-export", (*EXPORT, "--data", "scan")), ("ns-train --load-dir", RESUME)):

            def attack(
                folder: Path, change: Callable[[Path], None] = change, command: tuple[str, ...] = command
            ) -> str:
                change(folder / "scan")
                return _refused_without_effect(folder, command, "does not belong")

            found.append(Case(group, f"{name}: the scan with {title} changed", ("run", "scan"), attack))

    def edited(folder: Path, old: str, new: str, command: tuple[str, ...]) -> str:
        _change(folder / RUN / "config.yml", lambda text: re.sub(old, new, text, count=1))
        return _refused_without_effect(folder, command, "config.yml")

    for old, new in (
        (r"seed: 42", "seed: 43"),
        (r"eikonal: \S+", "eikonal: 0.3"),
        (r"scan_fingerprint: \w", "scan_fingerprint: 0x"),
        (r"settings_fingerprint: \w{4}", "settings_fingerprint: abcd"),
        (r"schedule_iterations: 20", "schedule_iterations: 40"),
        (r"focal: 0.0", "focal: 0.01"),
    ):
        for name, command in (("sl-export", EXPORT), ("sl-check", CHECK)):
            title = f"{name}: config.yml with {new.split(':')[0]} changed"
            again = partial(edited, old=old, new=new, command=command)
            found.append(Case(group, title, ("run",), again))

    def beside(folder: Path) -> str:
        for name in ("step-xyz.ckpt", "step-1.ckpt", "best.ckpt", ".partial", "notes.txt"):
            (folder / CHECKPOINT).with_name(name).write_text("mine")
        return accepted(call(folder, *EXPORT)) or _another_mesh(folder)

    def moved(folder: Path) -> str:
        (folder / RUN).rename(folder / "elsewhere")
        (folder / "scan").rename(folder / "the scan")
        command = ("sl-export", "--load-config", "elsewhere", "--output", "mesh.ply", "--resolution", "24")
        return accepted(call(folder, *command, "--data", "the scan")) or _another_mesh(folder)

    def good(folder: Path) -> str:
        done: Done = call(folder, *CHECK)
        return accepted(done, "no faults", "step 19, complete", "unchanged")

    found += [
        Case(group, "sl-export: files that are no checkpoints beside it", ("run",), beside),
        Case(group, "sl-export: run and scan moved", ("run", "scan"), moved),
        Case(group, "sl-check: an untouched run", ("run",), good),
    ]
    return found
