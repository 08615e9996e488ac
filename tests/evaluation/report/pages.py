"""Reading reports without a browser."""

import base64
import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np


class Page(HTMLParser):
    """Collects what a browser would load, ids, and pictures without a text for those who do not see them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.ids: list[str] = []
        self.anchors: list[str] = []
        self.undescribed: list[str] = []
        self.text: list[str] = []
        self._skip = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {key: value or "" for key, value in attrs}
        self._skip = tag in ("script", "style")
        self.loaded += [given[key] for key in ("src", "srcset", "data", "poster", "action") if key in given]
        link = given.get("href", given.get("xlink:href", ""))
        if link.startswith("#"):
            self.anchors.append(link[1:])
        elif link:
            self.loaded.append(link)
        if "id" in given:
            self.ids.append(given["id"])
        if (tag == "img" and not given.get("alt")) or (tag == "svg" and not given.get("aria-label")):
            self.undescribed.append(str(attrs)[:80])

    def handle_endtag(self, tag: str) -> None:
        self._skip = False

    def handle_data(self, data: str) -> None:
        if not self._skip:
            self.text.append(data)


def figure_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="figure">(.*?)</script>', page, flags=re.S)
    assert found
    return json.loads(found.group(1))


def unpacked(values: Any) -> np.ndarray:
    """Numbers of a figure, which Plotly packs as base64."""
    if isinstance(values, dict):
        return np.frombuffer(base64.b64decode(values["bdata"]), values["dtype"]).astype(np.float64)
    return np.array(values, dtype=np.float64)
