"""The control groups of Linux that this process is in, and what they allow (cgroups(7))."""

from pathlib import Path

ROOT, OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def groups_around(controller: str, root: Path, own: Path) -> list[Path]:
    """Folders of the groups whose limits for a controller, "cpu" or "memory", hold for this process.

    `root` is where control groups are mounted, `own` lists those of the process: version 2 as `0::/a/b`, version 1 with
    the controller's name. The limits of all groups around its own hold, too. A container sees its own group as the
    root. Folders need not exist.
    """
    try:
        lines = own.read_text().splitlines()
    except OSError:
        lines = []
    found: list[Path] = []
    for _, names, path in (line.split(":", 2) for line in ["0::/", f"0:{controller}:/", *lines] if line.count(":") > 1):
        if names and controller not in names.split(","):
            continue
        mount = root / controller if names else root
        group = mount / path.strip("/")
        inside = [group, *group.parents]
        found += inside[: inside.index(mount) + 1]
    return found
