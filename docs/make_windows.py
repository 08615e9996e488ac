"""Takes pictures of the windows that users see, in Chromium: both reports, the viewer, and the preview of `sl-scan`.

.venv/bin/python docs/make_windows.py [outputs/demo-images] [reports] [viewer] [preview]    # all, if none is named

The folder is that of `make demo-images`. WebGL is drawn without a GPU, so a picture takes half a minute.
"""

import base64
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import connect
from websockets.sync.connection import Connection

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "pictures"
REPORT, VIEWER = (1160, 1000), (1400, 900)
PAGE = (1000, 700)  # of the preview
VIEWER_PORT, DEBUGGER_PORT = 7345, 9345
LONGEST = 600.0  # seconds to wait for something on a page


class Page:
    """A page in Chromium."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._numbers = connection, count(1)

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command of the DevTools protocol, and wait for its result."""
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(LONGEST))
            if answer.get("id") == number:
                return answer["result"]

    def run(self, script: str) -> Any:
        """The value of a line of JavaScript."""
        return self.ask("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def wait(self, text: str) -> None:
        """Wait until the page says something."""
        end = time.monotonic() + LONGEST
        while text not in (self.run("document.body.innerText") or ""):
            if time.monotonic() > end:
                raise SystemExit(f"the page did not say {text!r}")
            time.sleep(0.5)

    def save(self, name: str) -> None:
        """Write what is seen to the pictures of the documentation."""
        path = PICTURES / name
        kind = {"format": "png"} if path.suffix == ".png" else {"format": "jpeg", "quality": 85}
        path.write_bytes(base64.b64decode(self.ask("Page.captureScreenshot", **kind)["data"]))
        print(f"{path}: {path.stat().st_size // 1000} kB")


@contextmanager
def browser(address: str, size: tuple[int, int]) -> Iterator[Page]:
    """A page in a window of `size` pixels."""
    program = next((found for name in ("chromium", "google-chrome", "chrome") if (found := shutil.which(name))), None)
    if program is None:
        raise SystemExit("Chromium or Chrome is needed, which draws the pages")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        software = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # draws WebGL without a GPU
        flags = ("--headless=new", "--no-sandbox", "--hide-scrollbars", *software, f"--user-data-dir={folder}")
        window = (f"--window-size={size[0]},{size[1]}", f"--remote-debugging-port={DEBUGGER_PORT}", address)
        process = subprocess.Popen([program, *flags, *window], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            pages = tried(lambda: json.loads(urlopen(f"http://127.0.0.1:{DEBUGGER_PORT}/json").read()))
            target = next(page for page in pages if page["type"] == "page")["webSocketDebuggerUrl"]
            with connect(target, max_size=None) as connection:
                page = Page(connection)
                page.ask("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1,
                         mobile=False)  # fmt: skip
                yield page
        finally:
            process.terminate()
            process.wait()


def tried(what: Callable[[], Any]) -> Any:
    """The first result that is not refused."""
    end = time.monotonic() + LONGEST
    while True:
        try:
            return what()
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.5)


@contextmanager
def running(*words: object) -> Iterator[subprocess.Popen[bytes]]:
    """A command of this package, until the block ends."""
    process = subprocess.Popen([sys.executable, "-c", *map(str, words)])
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def command(module: str, function: str) -> str:
    """Python that runs a command with the words after it."""
    return f"import sys; from {module} import {function}; sys.exit({function}())"


def reports(demo: Path) -> None:
    """The tops of both reports."""
    result = demo / "result"
    for file, name in ((result / "scan/processing.html", "processing-report"), (result / "report.html", "scan-report")):
        with browser(file.resolve().as_uri(), REPORT) as page:
            time.sleep(15)
            page.save(f"{name}.png")


def viewer(demo: Path) -> None:
    """`ns-viewer` with the finished run, as it opens."""
    run = next((demo / "result/training/sl-neus").glob("*/config.yml"))
    flags = ("--load-config", run, "--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", VIEWER_PORT)
    with running(command("nerfstudio.scripts.viewer.run_viewer", "entrypoint"), *flags):
        address = f"http://127.0.0.1:{VIEWER_PORT}"
        tried(lambda: urlopen(address).read())
        with browser(address, VIEWER) as page:
            page.wait("The surface at step")
            time.sleep(30)
            page.save("viewer.png")


def preview(demo: Path) -> None:
    """`sl-scan --preview` after the adjustment, from the photographs of the demo."""
    captures = demo / "captures"
    with tempfile.TemporaryDirectory() as folder:
        files = (
            captures / "images",
            "--pattern",
            captures / "pattern.json",
            "--intrinsics",
            captures / "intrinsics.json",
        )
        flags = (*files, "--output", f"{folder}/result", "--object-only", "--quality", "draft", "--preview")
        with running(command("sl_nerfstudio.cli.scan", "main"), *flags):
            address = "http://127.0.0.1:7007"
            tried(lambda: urlopen(address).read())
            with browser(address, PAGE) as page:
                page.wait("adjusted together")
                time.sleep(8)
                page.save("preview.png")


WINDOWS = {"reports": reports, "viewer": viewer, "preview": preview}


def main(words: list[str]) -> None:
    """Take the pictures that are named."""
    names = [word for word in words if word in WINDOWS]
    folders = [word for word in words if word not in WINDOWS]
    for name in names or WINDOWS:
        WINDOWS[name](Path(folders[0] if folders else "outputs/demo-images"))


if __name__ == "__main__":
    main(sys.argv[1:])
