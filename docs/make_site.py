"""`make docs`: the documentation as a site, with pages of the code from its docstrings; every link is checked.

The pages are laid out as in the repository, so that a link that works there works on the site. Out: build/site/.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
PAGES, SITE = ROOT / "build" / "site-pages", ROOT / "build" / "site"
FOLDERS = (".", "docs", "benchmarks", "training")
CODE = "Code"


def main() -> None:
    """Lay out the pages and build the site. Ends with mkdocs's status if a page or a link is wrong."""
    shutil.rmtree(PAGES, ignore_errors=True)
    linked = copy_pages()
    config = yaml.safe_load((ROOT / "docs" / "mkdocs.yml").read_text())
    config["exclude_docs"] = "\n".join(f"!/{path}" for path in sorted(linked))
    # pages show examples as they are: `--8<-- "examples/FILE"`
    config["markdown_extensions"].append({"pymdownx.snippets": {"base_path": [str(ROOT)], "check_paths": True}})
    config["nav"].append({CODE: write_code_pages()})
    settings = ROOT / "build" / "mkdocs.yml"
    settings.write_text(yaml.safe_dump(config))
    # not --quiet: warnings that are not printed do not count as errors either
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", str(settings)]
    built = subprocess.run(command, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, check=False)
    if built.returncode:
        sys.exit(built.returncode)
    print(f"site: {SITE / 'index.html'}")


def copy_pages() -> set[str]:
    """Copy every page, and the files that pages link to; returns those that are not pages."""
    linked: set[str] = set()
    for folder in FOLDERS:
        for page in (ROOT / folder).glob("*.md"):
            _copy(page)
            for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
                file = (page.parent / target).resolve()
                if not re.match(r"[a-z]+:", target) and file.is_file() and file.suffix != ".md":
                    _copy(file)
                    linked.add(str(file.relative_to(ROOT)))
    return linked


def write_code_pages() -> list[dict[str, str]]:
    """A page for every folder of the package, in CONTRIBUTING's order, which is that of the data; returns their nav."""
    nav = []
    for name in packages():
        page = f"code/{name}.md"
        (PAGES / page).parent.mkdir(exist_ok=True)
        (PAGES / page).write_text(f"::: sl_nerfstudio.{name}\n")
        nav.append({name: page})
    return nav


def packages() -> list[str]:
    """Folders and files directly below the package, as CONTRIBUTING lists them; `__main__` is a command, not code."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    block = text[text.index("    sl_nerfstudio/\n") : text.index("    tests/ ")]
    names = re.findall(r"^ {6}(\w+)(?:/|\.py) ", block, re.MULTILINE)
    return [name for name in names if not name.startswith("__")]


def _copy(file: Path) -> None:
    target = PAGES / file.resolve().relative_to(ROOT)
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, target)


if __name__ == "__main__":
    main()
