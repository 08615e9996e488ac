"""How many cores this process may use: as its affinity mask and the quotas of its control groups allow.

A container that is given two of 64 cores by a quota still sees 64: as many threads would wait for each other.
"""

import math
import os
from pathlib import Path

CGROUPS, OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def cores() -> int:
    """The smaller of both numbers, at least 1."""
    mask = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(math.ceil(min(mask, quota(CGROUPS, OWN))), 1)


def quota(root: Path, own: Path) -> float:
    """Cores' worth of time that the control groups of this process allow, infinite without a limit.

    `root` is where control groups are mounted, `own` lists those of the process (cgroups(7)): version 2 as `0::/a/b`,
    version 1 with the controller `cpu`. The limits of all groups around it hold, too. A container sees its own group as
    the root.
    """
    try:
        lines = own.read_text().splitlines()
    except OSError:
        lines = []
    found = [math.inf]
    for _, controllers, path in (line.split(":", 2) for line in ["0::/", "0:cpu:/", *lines] if line.count(":") >= 2):
        if controllers and "cpu" not in controllers.split(","):
            continue
        mount = root / "cpu" if controllers else root
        group = mount / path.strip("/")
        inside = [group, *group.parents]
        found += [_limit(folder) for folder in inside[: inside.index(mount) + 1]]
    return min(found)


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
