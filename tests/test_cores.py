"""The number of cores: affinity and quotas of control groups, laid out as Linux shows them."""

import math
import os
from pathlib import Path

import pytest

from sl_nerfstudio import parallel as module
from sl_nerfstudio.parallel import cores, quota


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def version_1(folder: str, quota: str) -> dict[str, str]:
    return {f"{folder}/cpu.cfs_quota_us": quota, f"{folder}/cpu.cfs_period_us": "100000\n"}


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {}, math.inf),
        ("0::/\n", {"cpu.max": "max 100000\n"}, math.inf),
        ("0::/\n", {"cpu.max": "250000 100000\n"}, 2.5),  # a container
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n", "a/cpu.max": "150000 50000\n"}, 3.0),  # the group around it
        ("4:cpu,cpuacct:/x\n2:pids:/y\n", version_1("cpu/x", "400000\n"), 4.0),
        ("4:cpu:/\n", version_1("cpu", "-1\n"), math.inf),
        ("4:cpu:/gone\n", version_1("cpu", "50000\n"), 0.5),
        ("0::/\n", {"cpu.max": "nonsense\n"}, math.inf),
    ],
)  # fmt: skip
def test_the_smallest_limit_of_all_groups_around_a_process_holds(
    tmp_path: Path, own: str, files: dict[str, str], expected: float
) -> None:
    write(tmp_path / "root", files)
    (tmp_path / "own").write_text(own)
    assert quota(tmp_path / "root", tmp_path / "own") == expected


def test_without_control_groups_there_is_no_limit(tmp_path: Path) -> None:
    assert quota(tmp_path, tmp_path / "none") == math.inf


def test_cores_are_whole_and_at_least_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    for text, expected in (("max 1000", 8), ("1500 1000", 2), ("100 1000", 1), ("99000 1000", 8)):
        write(tmp_path, {"cpu.max": text})
        monkeypatch.setattr(module, "ROOT", tmp_path)
        assert cores() == expected
