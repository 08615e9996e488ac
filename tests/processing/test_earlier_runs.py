"""Which work folder a run uses, from the notes of earlier ones."""

import json
from pathlib import Path

import pytest

from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.earlier_runs import note_work, with_kept_work
from sl_nerfstudio.storage import locked


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
