"""The scans of the benchmark, how they are made, and by which checksums they are known."""

import hashlib
import importlib.metadata
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.storage import write_atomic
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

VERSION = 1  # of the benchmark: figures of different versions must not be compared
INDEX = "benchmark.json"
PUBLISHED = Path(__file__).with_name("checksums.json")

_BASE = SynthConfig(frames=12, resolution=300)
_EXACT = replace(_BASE, noise=0.0, missing=0.0, wrong=0.0)
_NOISY = replace(_BASE, noise=0.8, missing=0.3, wrong=0.05)
_ROUGH = replace(_BASE, pose_error=(5.0, 15.0), autocalibration_error=(0.5, 1.0, 0.05))
_PHOTOGRAPHS = replace(_BASE, frames=14, resolution=500, images_only=True)


@dataclass(frozen=True)
class OpenScan:
    """One scan of the benchmark."""

    name: str  # what is hard about it, and the object
    config: SynthConfig

    @property
    def photographs(self) -> bool:
        """Whether a method gets images alone: nothing decoded, no poses, no length."""
        return self.config.images_only


SCANS = (
    OpenScan("ideal-frog", replace(_EXACT, scene="frog", seed=101)),
    OpenScan("ideal-leaf", replace(_EXACT, scene="leaf", seed=102)),
    OpenScan("noisy-head", replace(_NOISY, scene="head", seed=103)),
    OpenScan("noisy-dog", replace(_NOISY, scene="dog", seed=104)),
    OpenScan("rough-cone", replace(_ROUGH, scene="cone-and-cylinder", seed=105)),
    OpenScan("rough-chair", replace(_ROUGH, scene="chair", seed=106)),
    OpenScan("photographs-head", replace(_PHOTOGRAPHS, scene="head", appearance="realistic", seed=107)),
    OpenScan("photographs-frog", replace(_PHOTOGRAPHS, scene="frog", appearance="hard", seed=108)),
    OpenScan("weak-staircase", replace(_BASE, scene="staircase", seed=109)),
    OpenScan("weak-bottle", replace(_BASE, scene="bottle", seed=110)),
)


def chosen_scans(names: list[str]) -> list[OpenScan]:
    """The scans with these names; all without names. Raises UserError for a name that no scan has."""
    known = [scan.name for scan in SCANS]
    for name in names:
        if name not in known:
            raise UserError(f"--scans {name}: no scan is named so; there are {', '.join(known)}")
    return [scan for scan in SCANS if not names or scan.name in names]


def make(scans: list[OpenScan], output: Path) -> dict[str, Any]:
    """Make the scans below `output` that are not there yet, and write its benchmark.json, which is returned."""
    for scan in scans:
        if not (output / scan.name).exists():
            print(f"making {scan.name}", flush=True)
            synthesise(scan.config, output / scan.name)
    made = [scan for scan in SCANS if (output / scan.name).exists()]
    document = {
        "version": VERSION,
        "generator": f"sl_nerfstudio {importlib.metadata.version('sl_nerfstudio')}",
        "scans": {scan.name: checksum(output / scan.name) for scan in made},
    }
    write_atomic(output / INDEX, (json.dumps(document, indent=1) + "\n").encode())
    return document


def checksum(folder: Path) -> str:
    """SHA-256 of the names and the contents of all files of a scan."""
    found = hashlib.sha256()
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        found.update(
            f"{path.relative_to(folder).as_posix()}\n{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode()
        )
    return found.hexdigest()


def published() -> dict[str, str]:
    """The checksums of the scans on which the figures of docs/benchmark.md were measured."""
    return json.loads(PUBLISHED.read_text()) if PUBLISHED.exists() else {}
