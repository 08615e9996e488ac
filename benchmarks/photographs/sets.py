"""The sets of captures: scenes, appearances and surroundings that no network was trained on."""

import os
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.storage import write_atomic
from sl_nerfstudio.synthesis.appearance import AppearanceKind
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.render import Background
from sl_nerfstudio.synthesis.scenes import BUILT_IN
from sl_nerfstudio.synthesis.synthesise import synthesise

PATTERN = GridPattern(w=920, h=920)
"""46 x 46 nodes: with the object filling an image of 600 pixels, a period is about 14 of them wide."""


@dataclass(frozen=True)
class CaptureSet:
    """One set; `shuffled` ones come in random order, which sl-process is told only if `unordered`."""

    scene: str
    background: Background
    appearance: AppearanceKind
    seed: int
    shuffled: bool = False
    unordered: bool = False

    @property
    def name(self) -> str:
        """A unique name, which changes with everything that changes the images."""
        return f"{self.scene}-{self.background}-{self.appearance}-{self.seed}{'-shuffled' if self.shuffled else ''}"


SETS = (
    CaptureSet("frog", "none", "plain", 501), CaptureSet("dog", "table", "plain", 502),
    CaptureSet("vase", "walls", "plain", 503), CaptureSet("chair", "none", "plain", 504, shuffled=True),
    CaptureSet("head", "table", "realistic", 505), CaptureSet("chair", "table", "realistic", 506),
    CaptureSet("leaf", "walls", "realistic", 507), CaptureSet("medal", "table", "realistic", 508),
    CaptureSet("dog", "none", "realistic", 509, shuffled=True, unordered=True),
    CaptureSet("vase", "none", "realistic", 510), CaptureSet("frog", "walls", "hard", 511),
    CaptureSet("leaf", "table", "hard", 512), CaptureSet("chair", "walls", "hard", 513),
    CaptureSet("cone-and-cylinder", "none", "hard", 514),
)  # fmt: skip


_NAME = re.compile(r"(.+)-(none|table|walls)-(plain|realistic|hard)-(\d+)(-shuffled)?")


def chosen_sets(parts: Sequence[str]) -> list[CaptureSet]:
    """The sets whose names contain one of the parts, and new ones that are named in full.

    Raises UserError if a part fits none and is no name of a set.
    """
    new = [_named(part) for part in parts if not any(part in one.name for one in SETS)]
    return [one for one in SETS if not parts or any(part in one.name for part in parts)] + new


def _named(name: str) -> CaptureSet:
    """A set that is not among those of the benchmark, for example "frog-table-plain-801-shuffled"."""
    found = _NAME.fullmatch(name)
    if found is None or found[1] not in BUILT_IN:
        raise UserError(
            f"--sets {name}: no set is named so; there are {', '.join(one.name for one in SETS)}; a new one is named "
            "SCENE-BACKGROUND-APPEARANCE-SEED, with -shuffled at the end if its order is random"
        )
    background, appearance = cast(Background, found[2]), cast(AppearanceKind, found[3])
    return CaptureSet(found[1], background, appearance, int(found[4]), found[5] is not None)


def captures_of(one: CaptureSet, frames: int, resolution: int, folder: Path) -> Path:
    """The captures of a set below `folder`, rendered unless an earlier run did so completely."""
    root = folder / f"{one.name}-{frames}-{resolution}"
    if root.exists():
        return root
    pattern = folder / "pattern.json"
    write_atomic(pattern, PATTERN.encode())
    config = SynthConfig(
        scene=one.scene, background=one.background, appearance=one.appearance, seed=one.seed, frames=frames,
        resolution=resolution, pattern=pattern, images_only=True,
    )  # fmt: skip
    # two runs side by side, or one that is interrupted, must not leave half a set under its name
    started = folder / f".{root.name}-{os.getpid()}"
    shutil.rmtree(started, ignore_errors=True)
    synthesise(config, started)
    if one.shuffled:
        _shuffle(started / "images", one.seed)
    try:
        started.rename(root)
    except OSError:
        if not root.exists():
            raise
        shutil.rmtree(started)  # another run was faster
    return root


def frame_names(one: CaptureSet, frames: int) -> dict[str, int]:
    """Number in the truth of each image of a set."""
    order = np.random.default_rng(one.seed).permutation(frames) if one.shuffled else np.arange(frames)
    return {_image_name(one, place): int(number) for place, number in enumerate(order)}


def _image_name(one: CaptureSet, place: int) -> str:
    return f"photo_{place:03d}" if one.shuffled else f"frame_{place:05d}"


def _shuffle(images: Path, seed: int) -> None:
    """New names in random order."""
    found = sorted(images.iterdir())
    for place, number in enumerate(np.random.default_rng(seed).permutation(len(found))):
        found[number].rename(images / f"photo_{place:03d}{found[number].suffix}")
