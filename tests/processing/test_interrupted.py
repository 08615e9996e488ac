"""A run that was interrupted goes on where it was, and ends with the same bytes as one that was not."""

import os
import shutil
from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.report.capture_reports import render_processing_report
from sl_nerfstudio.processing import frames
from sl_nerfstudio.processing import process as stages
from sl_nerfstudio.processing.cache import MOST_KEPT, VERSIONS
from sl_nerfstudio.processing.captures import find_captures
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.processing.records import digest
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.storage import LOCK, NewFolder, locked
from tests.forks import killed_at_change
from tests.processing.conftest import register_ramps
from tests.processing.ramp_scan import NAMES, write_poses

pytestmark = [pytest.mark.usefixtures("ramps_registered"), pytest.mark.slow]

KEPT = ["registration: kept from an earlier run", "adjustment: kept from an earlier run"]


def run(config):
    log = []
    process(config, render_processing_report, log.append)
    return log


def content(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def whole(ramp_scan, tmp_path_factory):
    """The scan of a run that nothing interrupted, and its work folder."""
    root = tmp_path_factory.mktemp("whole")
    run_ramps(ramp_scan.config(root / "s", known_length="baseline of frame 1 = 5 cm"))
    return root


@pytest.fixture
def config(ramp_scan, tmp_path):
    return ramp_scan.config(tmp_path / "s", known_length="baseline of frame 1 = 5 cm")


def run_ramps(config):
    """A run in a process that does not know the toy decoder."""
    with pytest.MonkeyPatch.context() as patch:
        register_ramps(patch)
        run(config)


@pytest.fixture
def resumed(whole, config):
    """Another output, with the work folder of the run that nothing interrupted."""
    shutil.copytree(whole / "s.work", config.work_folder)
    return config


def test_killed_at_any_moment_the_next_run_ends_with_the_same_bytes(whole, config):
    """Moments from the beginning to the end, one after the other in the same folders."""
    assert sum(killed_at_change(moment, run_ramps, config) for moment in (0, 9, 28, 42, 50, 60, 71, 95)) >= 6
    log = run(config)
    assert content(config.output) == content(whole / "s")
    assert [line for line in log if line in KEPT] == KEPT and "4 had been decoded before" in "".join(log)
    kept, expected = content(config.work_folder), content(whole / "s.work")
    assert kept.keys() == expected.keys()
    assert all(kept[name] == expected[name] for name in kept if name not in ("manifest.json", "scans.json"))


@pytest.mark.parametrize("change", [{"unordered": True}, {"seed": 1}, {"poses": True}, {"version": True}])
def test_with_other_settings_or_another_version_frames_are_registered_again(
    ramp_scan, resumed, change, monkeypatch, tmp_path
):
    if "poses" in change:
        poses = dict(zip(NAMES, ramp_scan.T_world_camera, strict=True))
        change = {"poses": write_poses(tmp_path / "rough.json", poses)}
    elif "version" in change:
        change = {}
        monkeypatch.setitem(VERSIONS, "registration", VERSIONS["registration"] + 1)
    monkeypatch.setattr(stages, "register", lambda *_: pytest.fail("registered again"))
    with pytest.raises(pytest.fail.Exception, match="registered again"):
        run(replace(resumed, **change))
    assert not resumed.output.exists()


def test_results_in_another_order_are_the_same_and_in_the_order_of_the_captures(ramp_scan, resumed, monkeypatch):
    job, captures = ramp_scan.job(resumed.work_folder), find_captures(ramp_scan.root / "images", True)
    usual = frames.run_frame_stage(resumed, job, captures)
    real = frames.run_frames

    def reversed_frames(*arguments):
        yield from reversed(list(real(*arguments)))

    monkeypatch.setattr(frames, "run_frames", reversed_frames)
    turned = frames.run_frame_stage(resumed, job, captures)
    assert [result.name for result in turned] == list(NAMES)
    assert digest([result.cloud for result in turned]) == digest([result.cloud for result in usual])


def test_two_runs_in_one_place_are_refused(config):
    with locked(config.work_folder), pytest.raises(UserError, match=r"s.work: is in use by"):
        run(config)
    assert not config.output.exists() and not config.work_folder.exists()
    with NewFolder(config.output), pytest.raises(UserError, match=r"s: is in use by"):
        run(config)
    assert not config.work_folder.exists()


def nothing_slow(monkeypatch):
    for module, name in ((stages, "register"), (stages, "adjust_consistent"), (frames, "estimate_relative_pose")):
        monkeypatch.setattr(module, name, lambda *_, name=name: pytest.fail(f"{name} was called again"))


def test_another_length_renews_the_scan_and_another_output_uses_what_is_kept(whole, resumed, monkeypatch, tmp_path):
    run(resumed)
    nothing_slow(monkeypatch)
    first, longer = content(resumed.output), replace(resumed, known_length="baseline of frame 1 = 10 cm")
    log = run(longer)
    assert f"{resumed.output} holds an earlier scan of the same captures, which this one replaces" in log
    second = content(resumed.output)
    assert second.keys() == first.keys() and second["transforms.json"] != first["transforms.json"]
    assert read_scan(resumed.output).poses.baseline[1] == pytest.approx(10)
    log = run(replace(resumed, output=tmp_path / "elsewhere" / "t"))
    assert f"processed before: {resumed.work_folder} has" in log[0] and "4 had been decoded before" in "".join(log)
    elsewhere = content(tmp_path / "elsewhere" / "t")
    assert all(elsewhere[name] == first[name] for name in first if name != "processing.html")  # names the work folder
    assert elsewhere.keys() == first.keys() and not (tmp_path / "elsewhere" / "t.work").exists()
    run(replace(resumed, output=tmp_path / "elsewhere" / "t"))  # of which the same work folder knows


def test_killed_while_a_scan_is_renewed_the_next_run_succeeds(whole, resumed):
    run(replace(resumed, known_length="baseline of frame 1 = 10 cm"))
    assert sum(killed_at_change(moment, run_ramps, resumed) for moment in (1, 8, 20, 31, 45)) >= 3
    run(resumed)
    assert content(resumed.output) == content(whole / "s")


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda out: (out / "transforms.json").write_text("{}"), "transforms.json was changed since"),
        (lambda out: (out / "notes.txt").touch(), "notes.txt was added since"),
        (lambda out: next((out / "images").iterdir()).unlink(), "images/.* was removed since"),
    ],
)
def test_a_scan_that_the_user_changed_stays(resumed, change, cause):
    run(resumed)
    change(resumed.output)
    before = content(resumed.output)
    with pytest.raises(UserError, match=f"s: is not empty(.|\n)*{cause}(.|\n)*choose another output"):
        run(resumed)
    assert content(resumed.output) == before


def test_a_scan_of_other_captures_stays_and_so_does_any_after_an_error(copy, resumed, monkeypatch):
    run(resumed)
    before = content(resumed.output)
    fewer = replace(resumed, images=copy.root / "images", work=resumed.work_folder)
    shutil.rmtree(fewer.images / NAMES[2])
    with pytest.raises(UserError, match=r"holds the scan of other captures(.|\n)*added, removed or replaced"):
        run(fewer)
    monkeypatch.setattr(stages, "find_scan_poses", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(replace(resumed, known_length="baseline of frame 1 = 10 cm"))
    assert content(resumed.output) == before


def test_the_work_folder_keeps_what_was_used_last_and_no_temporary_files_of_killed_workers(resumed):
    stage = resumed.work_folder / "stages"
    old = [stage / f"registration-{k:024d}.npz" for k in range(20)]
    for k, path in enumerate(old):
        path.touch()
        os.utime(path, (k, k))
    for folder in ("", "decoded", "stages"):
        (resumed.work_folder / folder / ".0123456789abcdef.partial").write_bytes(b"half")
    (resumed.work_folder / LOCK).write_bytes(b"")
    run(resumed)
    assert [path for path in old if path.exists()] == old[1 - MOST_KEPT :]  # and the one that was used
    assert not [path for path in resumed.work_folder.rglob(".*") if path.is_file()]
    assert len(list((resumed.work_folder / "decoded").iterdir())) == len(NAMES)


def test_damaged_files_in_the_work_folder_are_made_again(whole, resumed):
    every = sorted(resumed.work_folder.rglob("*.npz"))
    for k, path in enumerate(path for path in every if not path.name.startswith("adjustment")):  # that is slow
        text = bytearray(path.read_bytes())
        text[np.random.default_rng(k).integers(len(text))] ^= 4
        path.write_bytes(text)
    log = run(resumed)
    assert "had been decoded before" not in "".join(log) and KEPT[0] not in log and KEPT[1] in log
    assert content(resumed.output) == content(whole / "s")
