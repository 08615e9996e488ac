"""Render sets of photographs with Mitsuba 3, which `benchmarks.photographs` then measures.

    python -m benchmarks.path_traced --sets skull-table-matte-phone-1 gripper-none-glossy-machine-2-shuffled
    python -m benchmarks.photographs --sets 'skull-*' --keep outputs/photographs

Needs the extra [render] and libLLVM 16 or later; the shapes of other packages need `pip install --no-deps dm_control
robosuite`, of which only files are read. A name says all: the shape, what is around it (none, table, walls), what it is
made of (matte, glossy, dark, textured), the camera (phone, machine, long), a seed, and how the frames are ordered.
"""

import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.measuring import parsed
from benchmarks.path_traced.rendering import Quality
from benchmarks.path_traced.sets import photographed
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError


@dataclass(frozen=True)
class Config:
    """Which sets are rendered, and where to."""

    sets: tuple[str, ...] = ()  # names of sets
    frames: int = 24  # photographs of each set
    resolution: int = 600  # width of the images, pixels
    keep: Path = Path("outputs/photographs")  # folder of the sets


def main() -> None:
    """Print the folders of the sets."""
    config = parsed(Config, __doc__)
    if not config.sets:
        raise UserError("--sets: give the name of at least one set, as skull-table-matte-phone-1")
    for name in config.sets:
        start = time.monotonic()
        folder = photographed(name, config.frames, config.resolution, Quality(), config.keep, _say)
        print(f"{folder}: {(time.monotonic() - start) / config.frames:.1f} s a photograph", flush=True)


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    run(main)
