"""Benchmarks run at their smallest size, and give figures of the right kind."""

import importlib
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks import paper
from benchmarks.common.measuring import Rows, kept_rows, options, parsed, shown
from benchmarks.launches import Config, Row
from sl_nerfstudio.errors import UserError

pytestmark = pytest.mark.filterwarnings("ignore")  # other libraries warn freely


@pytest.fixture
def rows(monkeypatch, tmp_path):
    """Runs a benchmark as from the command line; the rows of its result file."""

    def run(module: str, *words: object) -> list[dict[str, Any]]:
        output = tmp_path / "rows.json"
        monkeypatch.setattr(sys, "argv", [module, *map(str, words), "--output", str(output)])
        monkeypatch.chdir(tmp_path)
        importlib.import_module(f"benchmarks.{module}").main()
        document = json.loads(output.read_text())
        assert {"processor", "date", "commit"} <= document["machine"].keys()
        return document["rows"]

    return run


def test_flags_have_the_kinds_of_their_defaults(monkeypatch):
    def given(*words):
        monkeypatch.setattr(sys, "argv", ["benchmark", *words])
        return options("", seeds=[1, 2], ways={"a": 1, "b": 2}, again=False, limit=0.5, output=Path)

    assert vars(given()) == {"seeds": [1, 2], "ways": ["a", "b"], "again": False, "limit": 0.5, "output": None}
    found = given("--seeds", "7", "--ways", "b", "--again", "--limit", "2", "--output", "x")
    assert vars(found) == {"seeds": [7], "ways": ["b"], "again": True, "limit": 2.0, "output": Path("x")}
    with pytest.raises(SystemExit):
        given("--ways", "c")
    monkeypatch.setattr(sys, "argv", ["benchmark", "--rays", "3", "--sizes", "paper"])
    assert parsed(Config, "") == replace(Config(), sizes=["paper"], rays=3)


def test_rows_are_kept_from_run_to_run(tmp_path, capsys):
    row = Row("paper", "triton", 1, 2, 3, 4, 5, 6, 7, {"add": 1})
    Rows(tmp_path / "r.json", seed=3).add(row)
    assert shown(row) in capsys.readouterr().out
    assert json.loads((tmp_path / "r.json").read_text())["seed"] == 3
    assert kept_rows(tmp_path / "r.json", Row) == [row] and kept_rows(tmp_path / "none.json", Row) == []


def test_experiments_of_the_paper_refuse_unknown_names_all_at_once(monkeypatch, rows):
    with pytest.raises(UserError) as refused:
        rows("paper", "table2", "--methods", "kinect", "--scenes", "bust")
    found = str(refused.value)
    assert "name an experiment first: table1, ablation, real, chain" in found
    assert "--methods kinect: unknown" in found and "--scenes bust: unknown" in found and "cone-and-cylinder" in found


def test_experiments_of_the_paper_measure_each_case_once_and_go_on_after_failures(monkeypatch, rows, capsys):
    made, run = [], []

    def measure(case, scan, folder):
        run.append((case.method, case.variant, case.steps))
        if case.method == "registered":
            raise SystemExit("sl-eval\nno surface")
        return paper.Errors(1, 2, 3, 4, 5, 6, 7)

    monkeypatch.setattr(paper, "make", lambda case, scan: (scan.mkdir(), made.append(case.decoding)))
    monkeypatch.setattr(paper, "measure", measure)
    words = ("real", "--scenes", "frog", "--decoding", "usual", "90% missing", "--steps", 30)
    for _ in range(2):
        found = rows("paper", *words)
    assert made == ["usual", "90% missing"]
    methods = [("tracked", 0), ("registered", 0), ("sl-neus", 1000), ("sl-neus-paper", 30)]
    assert run == [(method, "refined", steps) for method, steps in methods] * 2
    assert [row["errors"] is None for row in found] == [False, True, False, False] * 2
    assert found[0]["case"]["frames"] == 57 and found[1]["fault"] == "sl-eval\nno surface"
    assert "failed: no surface" in capsys.readouterr().out


@pytest.mark.slow
def test_the_joint_adjustment_states_what_it_errs(rows):
    (row,) = rows("coverage", "--scenes", "cone-and-cylinder", "--seeds", 1, "--noises", "low")
    for name in ("relative", "camera", "length"):
        one, two, ratio = row[name]
        assert 0.2 < one <= two <= 1 and 0.3 < ratio < 2
    assert row["camera_mm"] < 0.5 and row["camera_deg"] < 0.1


@pytest.mark.slow
def test_the_decoder_reads_what_is_rendered(rows):
    found = rows("decoding", "--scenes", "head", "--resolutions", 400, "--frames", 1)
    assert [row["conditions"] for row in found] == ["plain", "strong"]
    assert found[0]["decoded"] > 0.8 and found[0]["median"] < 0.5 and found[0]["wrong"] < 0.01


@pytest.mark.slow
def test_poses_are_found_on_the_true_surface(rows, tmp_path):
    words = ("--scenes", "cone-and-cylinder", "--seeds", 1, "--ways", "Gauss-Newton", "--folder", tmp_path / "scans")
    (row,) = rows("pose_conditioning", *words)
    assert row["start_mm"] > 5 and row["end_mm"] < 0.3
