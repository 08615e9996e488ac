"""A stage is computed once, and again whenever anything that it follows from has changed."""

import json
import shutil
import subprocess
import sys
import types
import typing
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import sl_nerfstudio
from sl_nerfstudio.processing import cache
from sl_nerfstudio.processing.cache import (
    FOLDER,
    KEPT,
    VERSIONS,
    StageStore,
    note_work,
    stage_key,
    with_kept_work,
)
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.consistency import ConsistentFrames
from sl_nerfstudio.processing.records import encode
from sl_nerfstudio.registration.result import NoCommonSurface
from sl_nerfstudio.registration.static_projector import NoPlacement, StaticPlacement
from sl_nerfstudio.relative_pose.estimation import RelativePose
from sl_nerfstudio.relative_pose.intrinsics import IntrinsicsEvidence
from sl_nerfstudio.relative_pose.unknown_projector import NoProjector, ProjectorEstimate
from sl_nerfstudio.storage import locked, write_checked


@dataclass(frozen=True)
class Foreign:
    """A class that no stage returns."""

    value: int


@pytest.fixture
def compute():
    """A computation that counts how often it was done."""
    return Mock(side_effect=lambda: (NoCommonSurface("frame"), np.arange(3.0)))


def test_a_second_run_reads_what_the_first_computed_and_logs_it(tmp_path, compute):
    log = []
    first = StageStore(tmp_path, log.append).kept("registration", (1, "a"), compute)
    assert log == []
    second = StageStore(tmp_path, log.append).kept("registration", (1, "a"), compute)
    assert compute.call_count == 1 and log == ["registration: kept from an earlier run"]
    assert first[0] == second[0] == NoCommonSurface("frame") and (first[1] == second[1]).all()


def test_other_inputs_stage_versions_and_libraries_are_computed_again(tmp_path, compute, monkeypatch):
    store, inputs, expected = StageStore(tmp_path, print), np.zeros(3), 0

    def kept(inputs, stage="registration"):
        """Computed once, not twice."""
        nonlocal expected
        expected += 1
        for _ in range(2):
            store.kept(stage, inputs, compute)
            assert compute.call_count == expected

    kept(inputs)
    kept(inputs + 1e-300)
    kept(inputs, "adjustment")
    for stage in ("registration", "adjustment"):
        monkeypatch.setitem(VERSIONS, stage, VERSIONS[stage] + 1)
        kept(inputs, stage)
    monkeypatch.setattr(cache, "version", lambda _: "9.9")
    cache._computer.cache_clear()
    kept(inputs)
    cache._computer.cache_clear()
    with pytest.raises(KeyError):
        store.kept("a stage without a version", inputs, compute)


@pytest.mark.slow
def test_an_edited_source_file_discards_nothing(tmp_path):
    """The keys of every stage in a copy of the package in which every file was edited."""
    shutil.copytree(Path(sl_nerfstudio.__file__).parent, tmp_path / "sl_nerfstudio")
    for path in (tmp_path / "sl_nerfstudio").rglob("*.py"):
        path.write_text(path.read_text() + "\n\nEDITED = True\n")
    script = (
        "import numpy as np, sl_nerfstudio\nfrom sl_nerfstudio.processing.cache import VERSIONS, stage_key\n"
        "assert sl_nerfstudio.EDITED\nprint([stage_key(stage, (1, np.arange(3.0))) for stage in VERSIONS])"
    )
    found = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == str([stage_key(stage, (1, np.arange(3.0))) for stage in VERSIONS])


def test_a_damaged_result_is_computed_again(tmp_path, compute):
    store = StageStore(tmp_path, print)
    store.kept("registration", 1, compute)
    (path,) = (tmp_path / FOLDER).iterdir()
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    spoilt = [b"", content[:-1], content[: len(content) // 2], b"\0" * len(content)]
    for place in rng.integers(0, len(content), 40):
        flipped = bytearray(content)
        flipped[place] ^= 1 << rng.integers(8)
        spoilt.append(bytes(flipped))
    for count, text in enumerate(spoilt, 2):
        path.write_bytes(text)
        store.kept("registration", 1, compute)
        assert compute.call_count == count and path.read_bytes() == content


@pytest.mark.parametrize(
    "content", [b"", b"no archive", encode(3), encode(("key",)), encode((1, 2, 3)), encode(Foreign(1)), encode("key")]
)
def test_a_whole_file_with_something_else_in_it_is_not_used(tmp_path, compute, content):
    store = StageStore(tmp_path, print)
    store.kept("registration", 1, compute)
    (path,) = (tmp_path / FOLDER).iterdir()
    write_checked(path, content)
    store.kept("registration", 1, compute)
    assert compute.call_count == 2


def _inside(kind, seen):
    """All dataclasses that a field of this type may hold."""
    if is_dataclass(kind):
        if kind not in seen:
            seen.add(kind)
            for hint in typing.get_type_hints(kind).values():
                _inside(hint, seen)
    elif isinstance(kind, types.UnionType) or typing.get_origin(kind) is not None:
        for part in typing.get_args(kind):
            _inside(part, seen)
    return seen


def test_every_class_in_a_result_can_be_read_again():
    found: set[type] = set()
    for kind in (ConsistentFrames, RelativePose, ProjectorEstimate, NoProjector, StaticPlacement, NoPlacement,
                 IntrinsicsEvidence):  # fmt: skip
        found = _inside(kind, found)
    assert found == set(KEPT) and len({kind.__name__ for kind in KEPT}) == len(KEPT)
    assert all(fields(kind) for kind in KEPT)


# Which work folder a run uses, from the notes of earlier ones.


@pytest.fixture
def first(tmp_path, monkeypatch):
    """A run whose work folder holds something, with its note."""
    monkeypatch.setenv("SL_CACHE", str(tmp_path / "cache"))
    config = ProcessConfig(tmp_path / "captures", Path("p.json"), output=tmp_path / "scan")
    (config.work_folder / "stages").mkdir(parents=True)
    note_work(config)
    return config


def another(first, **changes):
    given = {"images": first.images, "output": first.output.with_name("other"), **changes}
    return with_kept_work(ProcessConfig(pattern=first.pattern, **given)).work_folder


def test_another_output_of_the_same_captures_uses_the_work_folder_that_there_is(first, tmp_path, monkeypatch):
    assert another(first) == first.work_folder
    own = tmp_path / "other.work"
    assert another(first, images=tmp_path / "others") == own
    assert another(first, work=tmp_path / "mine") == tmp_path / "mine"
    with locked(first.work_folder):
        assert another(first) == own  # two runs at the same time
    own.mkdir()
    assert another(first) == own
    own.rmdir()
    monkeypatch.chdir(tmp_path)
    assert another(first, images=Path("captures")) == first.work_folder
    (first.work_folder / "stages").rmdir()
    first.work_folder.rmdir()
    assert another(first) == own


def test_notes_are_few_and_no_run_depends_on_them(first, tmp_path, monkeypatch):
    for k in range(80):
        note_work(ProcessConfig(tmp_path / f"c{k}", first.pattern, output=tmp_path / f"s{k}"))
    notes = tmp_path / "cache" / "work-folders.json"
    assert len(json.loads(notes.read_text())) == 64 and another(first) == tmp_path / "other.work"
    note_work(first)
    assert another(first) == first.work_folder
    for damaged in (b"", b"[]", b'{"a": 1}', b"\xff"):
        notes.write_bytes(damaged)
        assert another(first) == tmp_path / "other.work"
    monkeypatch.setenv("SL_CACHE", "/dev/null")
    note_work(first)  # nowhere to write it
