"""The sets of captures: scenes, appearances and surroundings that no network was trained on."""

import json
import os
import re
import shutil
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, cast

import numpy as np

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.storage import write_atomic
from sl_nerfstudio.synthesis.appearance import AppearanceKind
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.parts import PARTS
from sl_nerfstudio.synthesis.render import Background
from sl_nerfstudio.synthesis.scenes import BUILT_IN
from sl_nerfstudio.synthesis.synthesise import synthesise

PATTERN = GridPattern(w=920, h=920)
"""46 x 46 nodes: with the object filling an image of 600 pixels, a period is about 14 of them wide."""

_NAME = re.compile(r"(.+)-(none|table|walls)-(plain|realistic|hard)-(\d+)(|-shuffled|-half)")
SET = "set.json"
"""What a folder of captures says of itself: `unordered`, `appearance`, and its `frames`' numbers in the truth."""
WORK = "work"
"""The folder of decoded frames in a folder of captures."""
GROUPS: dict[str, tuple[str, ...]] = {
    "objects": (
        "frog-none-plain-501", "dog-table-plain-502", "vase-walls-plain-503", "chair-none-plain-504-shuffled",
        "head-table-realistic-505", "chair-table-realistic-506", "leaf-walls-realistic-507",
        "medal-table-realistic-508", "dog-none-realistic-509-shuffled", "vase-none-realistic-510",
        "frog-walls-hard-511", "leaf-table-hard-512", "chair-walls-hard-513", "cone-and-cylinder-none-hard-514",
    ),
    "parts": (
        "flange-none-plain-700", "flange-walls-plain-706-shuffled", "knob-table-plain-701", "knob-none-plain-707-half",
        "disc-table-plain-702", "disc-none-realistic-708", "gear-table-plain-703", "gear-none-plain-709-shuffled",
        "box-none-plain-704", "box-table-plain-710-half", "labelled-bottle-table-plain-705",
        "labelled-bottle-walls-realistic-711",
    ),
    "unseen-parts": (
        "flange-table-realistic-800", "flange-none-plain-806-half", "knob-walls-plain-801",
        "knob-none-plain-807-shuffled", "disc-none-plain-802-half", "disc-table-plain-808-shuffled",
        "gear-none-plain-803", "gear-walls-realistic-809", "box-table-plain-804", "box-none-plain-810-shuffled",
        "labelled-bottle-none-plain-805-half", "labelled-bottle-table-plain-811",
    ),
}  # fmt: skip
"""Lists of sets; nobody looks at what is unseen before a change is finished."""
_TOLD = ("dog-none-realistic-509-shuffled",)  # sets of which sl-process is told that they are shuffled


def chosen_captures(parts: Sequence[str], frames: int, resolution: int, folder: Path) -> list[Path]:
    """Folders of the captures of sets, rendered unless they are in `folder`.

    A part is the name of a list, or a part of the names of the sets in the lists, or the full name of another set, or
    the name of any folder of captures in `folder`, or `kept`, all of these. Raises UserError for what is none of these.
    """
    found: list[Path] = []
    for part in parts:
        there = sorted(note.parent for note in folder.glob(f"{'*' if part == 'kept' else part}/{SET}"))
        if there or part == "kept":
            found += there
            continue
        names = GROUPS.get(part) or [name for group in GROUPS.values() for name in group if part in name] or [part]
        found += [captures_of(name, frames, resolution, folder) for name in names]
    return list(dict.fromkeys(found))


def note_of(captures: Path) -> dict[str, Any]:
    """What is in `SET`."""
    return dict(json.loads((captures / SET).read_text()))


def config_of(name: str, frames: int, resolution: int, folder: Path) -> SynthConfig:
    """The settings with which a set is rendered; its pattern's file lies in `folder`. Raises UserError."""
    parts = _NAME.fullmatch(name)
    if parts is None or parts[1] not in {**BUILT_IN, **PARTS}:
        raise UserError(
            f"--sets {name}: no set is named so; there are {', '.join(chain(*GROUPS.values()))}; a new one is named "
            "SCENE-BACKGROUND-APPEARANCE-SEED, with -shuffled at the end if its order is random, with -half if its "
            "frames go around half of the object"
        )
    scene, background, appearance, seed, order = parts.groups()
    return SynthConfig(
        scene=scene, background=cast(Background, background), appearance=cast(AppearanceKind, appearance),
        seed=int(seed), frames=frames, resolution=resolution, pattern=folder / "pattern.json",
        path="half-turn" if order == "-half" else "hand-held", images_only=True,
    )  # fmt: skip


def captures_of(name: str, frames: int, resolution: int, folder: Path) -> Path:
    """The captures of a set below `folder`, rendered unless an earlier run did so completely."""
    config = config_of(name, frames, resolution, folder)
    root = folder / f"{name}-{frames}-{resolution}"
    if root.exists():
        return root
    write_atomic(folder / "pattern.json", PATTERN.encode())
    # two runs side by side, or one that is interrupted, must not leave half a set under its name
    started = folder / f".{root.name}-{os.getpid()}"
    shutil.rmtree(started, ignore_errors=True)
    synthesise(config, started)
    numbers = _numbers(started / "images", config.seed if name.endswith("-shuffled") else None)
    note = {"unordered": name in _TOLD, "appearance": config.appearance, "frames": numbers}
    (started / SET).write_text(json.dumps(note, indent=1) + "\n")
    try:
        started.rename(root)
    except OSError:
        if not root.exists():
            raise
        shutil.rmtree(started)  # another run was faster
    return root


def _numbers(images: Path, seed: int | None) -> dict[str, int]:
    """Number in the truth of each image by its name; with a seed the images get names in random order."""
    found = sorted(images.iterdir())
    if seed is None:
        return {image.stem: number for number, image in enumerate(found)}
    numbers = {}
    for place, number in enumerate(np.random.default_rng(seed).permutation(len(found)).tolist()):
        image = found[number].rename(images / f"photo_{place:03d}{found[number].suffix}")
        numbers[image.stem] = number
    return numbers
