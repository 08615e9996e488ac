import shlex
from pathlib import Path

import hypothesis
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sl_nerfstudio.console import (
    WIDTH,
    command,
    duration,
    fitted,
    next_steps,
    paragraph,
    short_path,
)

PLAIN = st.text(st.characters(exclude_characters="\n\\", exclude_categories=["Cs"]), max_size=30)
WORDS = st.lists(st.one_of(st.sampled_from(["--data", "--poses", "-v"]), PLAIN), max_size=12)


@hypothesis.settings(max_examples=20)
@given(WORDS)
def test_a_command_can_be_copied_however_long_it_is(words):
    assert shlex.split(command("sl-eval", *words).replace("\\\n", "")) == ["sl-eval", *words]


def test_a_long_command_continues_at_its_flags():
    folder = "a/folder/with/a/name/that/is/rather/long"
    text = command("sl-eval", "--mesh", "mesh.ply", "--data", folder, "--poses", f"{folder}/transforms.json")
    assert text.splitlines() == [
        f"  sl-eval --mesh mesh.ply --data {folder} \\",
        f"      --poses {folder}/transforms.json",
    ]
    assert next_steps([text]).startswith("next:\n  sl-eval --mesh")


@given(st.text(alphabet="ab c\n", max_size=400))
def test_paragraphs_fit_a_terminal_and_keep_every_word(text):
    lines = paragraph("adjust", text).splitlines()
    assert all(len(line) <= WIDTH or len(line.split()) <= 2 for line in lines)
    assert " ".join(lines).split()[1:] == text.split() or not text.strip()


def test_lines_and_insets_of_a_text_stay():
    text = paragraph("adjust", "Poses adjusted.\n    cause:  " + "word " * 20)
    assert text.splitlines()[0] == "adjust      Poses adjusted."
    assert all(line.startswith(" " * 16) for line in text.splitlines()[1:])


@given(st.lists(st.tuples(st.sampled_from([0, 2, 4]), st.text(alphabet="ab ", max_size=200)), max_size=5))
def test_long_lines_continue_further_to_the_right_and_keep_every_word(lines):
    text = "\n".join(" " * inset + f"x{words}".rstrip() for inset, words in lines)
    out = fitted(text).splitlines()
    assert " ".join(out).split() == text.split()
    assert all(len(line) <= WIDTH or len(line.split()) == 1 for line in out)
    starts = [line for line in out if line.strip().startswith("x")]
    assert [len(line) - len(line.lstrip()) for line in starts] == [inset for inset, _ in lines]
    assert all(line.startswith("    ") for line in out if line not in starts)
    assert all(line in out for line in text.splitlines() if len(line) <= WIDTH)


@pytest.mark.parametrize(
    "seconds, said",
    [(-3.0, "0 s"), (0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (3599.0, "59 min 59 s"), (1e6, "277 h 46 min")],
)
def test_durations_are_never_given_in_days(seconds, said):
    assert duration(seconds) == said


def test_paths_in_the_current_folder_are_short(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert short_path(tmp_path / "scan") == Path("scan")
    assert short_path(tmp_path) == tmp_path and short_path(Path("/elsewhere")) == Path("/elsewhere")
