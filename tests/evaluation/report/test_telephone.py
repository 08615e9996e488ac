"""Pages on a narrow screen: no table, picture or column makes them wider than it is."""

from pathlib import Path

import pytest

from sl_nerfstudio.evaluation import report

TEMPLATES = Path(report.__file__).parent / "templates"
PAGES = sorted(path for path in TEMPLATES.glob("*.html.j2") if "<body>" in path.read_text())


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_page_has_the_one_style(page):
    text = page.read_text()
    assert "parts.head(" in text or '{% include "style.css.j2" %}\n</style>' in text


def test_tables_scroll_in_themselves_and_columns_stand_below_each_other():
    rules = (TEMPLATES / "style.css.j2").read_text().partition("@media screen and (max-width: 760px)")[2]
    for rule in ("table { display: block; overflow-x: auto; }", ".frames { grid-template-columns: minmax(0, 1fr); }"):
        assert rule in rules
    assert len(PAGES) == 3
