"""Every command, flag, setting, file, link and picture in the documentation exists."""

import ast
import dataclasses
import importlib
import os
import re
import shlex
import subprocess
import sys
import typing
from functools import cache
from pathlib import Path

import pytest

from sl_nerfstudio.dataparser.dataparser import SLDataParserConfig
from tests.test_package import SCRIPTS

ROOT = Path(__file__).parents[1]
LOG = ROOT / "benchmarks" / "log.md"  # a record of experiments: it uses the names of its time
PAGES = sorted(path for folder in (".", "docs", "benchmarks", "training") for path in (ROOT / folder).glob("*.md"))
CURRENT = [page for page in PAGES if page != LOG]
SETTING = re.compile(r"--(?:pipeline|machine|viewer)\.[a-z.-]*[a-z]")
CODE_FILE = re.compile(r"`([a-z_/]+\.py)`")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
COMMAND = re.compile(r"^(?:[A-Z_]+=\S+ )*(?:\.venv/bin/)?((?:sl|ns)-[a-z-]+|make|python)(?= )")
MOST_BYTES_OF_A_PICTURE = 500_000

pages = pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
current_pages = pytest.mark.parametrize("page", CURRENT, ids=lambda page: str(page.relative_to(ROOT)))


def commands(page: Path) -> list[list[str]]:
    """Words of every command in the page's code blocks (fenced or indented), without comments and `$`."""
    text = re.sub(r"\\\n\s*", "", page.read_text())
    found, fenced = [], False
    for line in text.splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif (fenced or line.startswith("    ")) and COMMAND.match(line.strip().removeprefix("$ ")):
            words = shlex.split(line.strip().removeprefix("$ "), comments=True)
            while "=" in words[0]:
                words.pop(0)
            for end in ("&&", "|", ";", ">"):
                words = words[: words.index(end)] if end in words else words
            found.append([Path(words[0]).name, *words[1:]])
    return found


def flags_of(words: list[str]) -> list[str]:
    return [word.split("=")[0] for word in words if re.match(r"--[a-z]", word)]


@cache
def help_of(script: str) -> str:
    module = SCRIPTS[script].split(":")[0]
    return subprocess.run(
        [sys.executable, "-m", module, "--help"],
        capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "200", "NO_COLOR": "1"},
    ).stdout  # fmt: skip


def has_field(config: typing.Any, flag: str) -> bool:
    """Whether nested dataclasses (classes or instances) have the field that a flag names."""
    for name in flag.removeprefix("--").replace("-", "_").split("."):
        fields = {f.name: f for f in dataclasses.fields(config)} if dataclasses.is_dataclass(config) else {}
        if isinstance(config, dict) and name in config:
            config = config[name]
        elif name not in fields:
            return False
        elif not isinstance(config, type):
            config = getattr(config, name)
        else:
            f = fields[name]
            config = f.default_factory() if f.default_factory is not dataclasses.MISSING else f.default
            config = f.type if config is dataclasses.MISSING else config
    return True


@cache
def nerfstudio_command(command: str, sub: str) -> typing.Any:
    """The settings class (or instance) behind a ns-* command and its sub-command."""
    if command == "ns-train":
        from sl_nerfstudio import methods

        known = {spec.config.method_name: spec.config for spec in (methods.sl_neus, methods.sl_neus_paper)}
        return known[sub]
    single = {"ns-eval": ("eval", "ComputePSNR"), "ns-viewer": ("viewer.run_viewer", "RunViewer")}
    if command in single:
        module, name = single[command]
        return getattr(importlib.import_module(f"nerfstudio.scripts.{module}"), name)
    several = {"ns-export": "exporter", "ns-render": "render"}
    module = importlib.import_module(f"nerfstudio.scripts.{several[command]}")
    for member in typing.get_args(typing.get_args(module.Commands)[0]):
        cls, *marks = typing.get_args(member)
        if sub in {getattr(mark, "name", None) for mark in marks}:
            return cls
    raise KeyError(f"{command} {sub}")


@pages
def test_commands_and_their_flags_exist(page):
    for command, *words in commands(page):
        if command == "make":
            targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
            assert {word for word in words if "=" not in word} <= targets, words
        elif command in SCRIPTS:
            known = set(re.findall(r"--[a-z][\w-]*", help_of(command)))
            assert set(flags_of(words)) <= known, (command, words)
        elif command.startswith("ns-"):
            sub = next((word for word in words if not word.startswith("-")), "")
            settings = nerfstudio_command(command, sub)
            end = words.index("sl-data") if "sl-data" in words else len(words)  # what follows is the dataparser's
            for flag in flags_of(words[:end]):
                assert flag == "--help" or has_field(settings, flag), f"{command}: no flag {flag}"
            for flag in flags_of(words[end:]):
                assert has_field(SLDataParserConfig, flag), f"sl-data: no flag {flag}"
        elif command == "python" and words[0] != "-m":
            assert (ROOT / words[0]).is_file(), words
        elif command == "python" and words[1] not in ("pytest", "pip"):
            assert (ROOT / words[1].replace(".", "/")).exists() or (ROOT / f"{words[1].replace('.', '/')}.py").exists()
        else:
            assert command == "python", f"unknown command {command}"


@current_pages
def test_settings_named_in_the_text_exist(page):
    settings = nerfstudio_command("ns-train", "sl-neus")
    for flag in SETTING.findall(page.read_text()):
        assert has_field(settings, flag), f"ns-train: no setting {flag}"


@current_pages
def test_code_files_named_in_the_text_exist(page):
    files = [str(path.relative_to(ROOT)) for folder in ("sl_nerfstudio", "benchmarks", "tests", "training", "docs")
             for path in (ROOT / folder).rglob("*.py")]  # fmt: skip
    for name in CODE_FILE.findall(page.read_text()):
        assert any(f"/{file}".endswith(f"/{name}") for file in files), f"no file {name}"


@pages
def test_link_targets_exist(page):
    for target in LINK.findall(page.read_text()):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}, target


def test_pictures_are_small_and_used():
    pictures = set((ROOT / "docs" / "pictures").glob("*"))
    used = {(page.parent / target).resolve() for page in PAGES for target in LINK.findall(page.read_text())}
    for picture in pictures:
        assert picture.stat().st_size < MOST_BYTES_OF_A_PICTURE, picture
        assert picture in used, f"{picture} is shown nowhere"


def test_common_failures_are_quoted_as_the_code_says_them():
    """Sentences are put together of strings, numbers and names, so runs of three words between these are compared."""
    nodes = (node for path in (ROOT / "sl_nerfstudio").rglob("*.py") for node in ast.walk(ast.parse(path.read_text())))
    strings = [node.value for node in nodes if isinstance(node, ast.Constant) and type(node.value) is str]
    said = {run for text in strings for run in threes(text)}
    for line in re.findall(r"^    +(.*)$", (ROOT / "docs" / "failures.md").read_text(), re.MULTILINE):
        runs = [run for part in re.split(r"[\d:;,]|frame_\S+|captures/\S+", line) for run in threes(part)]
        assert 4 * sum(run in said for run in runs) >= 3 * len(runs), line


def threes(text: str) -> list[tuple[str, ...]]:
    words = re.findall(r"[a-z-]+", text.lower())
    return list(zip(words, words[1:], words[2:], strict=False))


def test_readme_shows_every_command():
    text = (ROOT / "README.md").read_text()
    assert {name for name in SCRIPTS if name not in text} == set()


def test_make_explains_every_target():
    makefile = (ROOT / "Makefile").read_text()
    targets = re.search(r"^\.PHONY: (.*)$", makefile, re.MULTILINE)
    assert targets
    explained = set(re.findall(r'@echo "make ([a-z-]+) ', makefile))
    assert explained == set(targets[1].split()) - {"help"}


def test_the_site_has_every_page_of_the_documentation_and_every_folder_of_the_code():
    """`make docs` checks their links; a page that is not in the navigation would end it."""
    from docs.make_site import packages

    text = (ROOT / "docs" / "mkdocs.yml").read_text()
    listed = set(re.findall(r"[:-] ([\w/.-]+\.md)$", text, re.MULTILINE))
    assert listed == {str(page.relative_to(ROOT)) for page in PAGES}
    folders = {path.parent.name for path in (ROOT / "sl_nerfstudio").glob("*/__init__.py")}
    assert folders <= set(packages()) and "__main__" not in packages()
