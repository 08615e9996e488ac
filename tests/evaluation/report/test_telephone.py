"""Pages on a narrow screen: no table, picture or column makes them wider than it is."""

from pathlib import Path

import pytest

from sl_nerfstudio.evaluation import report

TEMPLATES = Path(report.__file__).parent / "templates"
PAGES = sorted(path for path in TEMPLATES.glob("*.html.j2") if "</style>" in path.read_text())


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_every_page_ends_its_styles_with_those_for_telephones(page):
    assert '{% include "telephone.css.j2" %}</style>' in page.read_text()  # last, so that nothing overrules them


def test_tables_scroll_in_themselves_and_columns_stand_below_each_other():
    rules = (TEMPLATES / "telephone.css.j2").read_text()
    for rule in ("table { display: block; overflow-x: auto; }", "grid-template-columns: minmax(0, 1fr)"):
        assert rule in rules.partition("@media screen and (max-width: 640px)")[2]
    assert len(PAGES) == 3


def test_clicks_on_menus_and_buttons_are_no_points():
    script = (TEMPLATES / "measuring.html.j2").read_text()
    assert script.count("onSurface(event)") == 2 and '.closest(".infolayer, .menulayer, .modebar-container")' in script
