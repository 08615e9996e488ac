"""A stage is computed once, and again whenever anything that it follows from has changed."""

import types
import typing
from dataclasses import dataclass, fields, is_dataclass

import numpy as np
import pytest

from sl_nerfstudio.processing import cache
from sl_nerfstudio.processing.cache import FOLDER, KEPT, StageStore
from sl_nerfstudio.processing.consistency import ConsistentFrames
from sl_nerfstudio.processing.records import encode
from sl_nerfstudio.registration.result import NoCommonSurface
from sl_nerfstudio.registration.static_projector import NoPlacement, StaticPlacement
from sl_nerfstudio.relative_pose.estimation import RelativePose
from sl_nerfstudio.relative_pose.intrinsics import IntrinsicsEvidence
from sl_nerfstudio.relative_pose.unknown_projector import NoProjector, ProjectorEstimate
from sl_nerfstudio.storage import write_checked


@dataclass(frozen=True)
class Foreign:
    """A class that no stage returns."""

    value: int


class Counted:
    """A computation that says how often it was done."""

    def __init__(self):
        self.times = 0

    def __call__(self):
        self.times += 1
        return NoCommonSurface("frame"), np.arange(3.0)


@pytest.fixture
def compute():
    return Counted()


def test_a_second_run_reads_what_the_first_computed_and_says_so(tmp_path, compute):
    log = []
    first = StageStore(tmp_path, log.append).kept("registration", (1, "a"), compute)
    assert log == []
    second = StageStore(tmp_path, log.append).kept("registration", (1, "a"), compute)
    assert compute.times == 1 and log == ["registration: kept from an earlier run"]
    assert first[0] == second[0] == NoCommonSurface("frame") and (first[1] == second[1]).all()


def test_other_inputs_other_code_and_other_versions_are_computed_again(tmp_path, compute, monkeypatch):
    store = StageStore(tmp_path, print)
    inputs = np.zeros(3)
    store.kept("registration", inputs, compute)
    store.kept("registration", inputs + 1e-300, compute)
    assert compute.times == 2
    for name, change in (("version", lambda name: "9.9"), ("_PACKAGES", ())):
        monkeypatch.setattr(cache, name, change)
        cache.surroundings.cache_clear()
        store.kept("registration", inputs + 1e-300, compute)
    assert compute.times == 4
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").write_text("")
    monkeypatch.setattr(cache.sl_nerfstudio, "__file__", str(tmp_path / "package" / "__init__.py"))
    cache.surroundings.cache_clear()
    store.kept("registration", inputs + 1e-300, compute)
    cache.surroundings.cache_clear()
    assert compute.times == 5


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
        assert compute.times == count and path.read_bytes() == content


@pytest.mark.parametrize(
    "content", [b"", b"no archive", encode(3), encode(("key",)), encode((1, 2, 3)), encode(Foreign(1)), encode("key")]
)
def test_a_whole_file_with_something_else_in_it_is_not_used(tmp_path, compute, content):
    store = StageStore(tmp_path, print)
    store.kept("registration", 1, compute)
    (path,) = (tmp_path / FOLDER).iterdir()
    write_checked(path, content)
    store.kept("registration", 1, compute)
    assert compute.times == 2


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
