"""How many cores this process may use: as its affinity mask and the quotas of its control groups allow.

A container that is given two of 64 cores by a quota still sees 64: as many threads would wait for each other.
"""

import math
import os
from pathlib import Path

from sl_nerfstudio.control_groups import OWN, ROOT, groups_around


def cores() -> int:
    """The smaller of both numbers, at least 1."""
    mask = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(math.ceil(min(mask, quota(ROOT, OWN))), 1)


def quota(root: Path, own: Path) -> float:
    """Cores' worth of time that the control groups of this process allow, infinite without a limit.

    For the arguments see `control_groups.groups_around`.
    """
    return min((_limit(folder) for folder in groups_around("cpu", root, own)), default=math.inf)


def _limit(folder: Path) -> float:
    """That of one group: `cpu.max` of version 2, or the two files of version 1."""
    try:
        if (folder / "cpu.max").is_file():
            allowed, period = (folder / "cpu.max").read_text().split()
        else:
            allowed, period = ((folder / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return float(allowed) / float(period) if allowed.strip() not in ("max", "-1") else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf
