"""Takes the pictures of docs/live.md: the page of a live scan in Chromium, in a wide and a narrow window, and a film.

.venv/bin/python docs/make_live.py [FOLDER]

The walk is that of `python -m benchmarks.live --walks lost`; FOLDER has its video, or gets it (outputs/bench/live).
"""

import base64
import sys
import tempfile
import time
from io import BytesIO
from pathlib import Path

from make_windows import PICTURES, ROOT, Page, browser
from PIL import Image

sys.path.insert(0, str(ROOT))

from benchmarks.live import WALKS, record
from sl_nerfstudio.capture.camera import Video
from sl_nerfstudio.live.page import LivePage
from sl_nerfstudio.live.session import Update, open_session
from sl_nerfstudio.live.sources import CameraSource
from sl_nerfstudio.model.preview import Preview

WIDE, NARROW = (1100, 760), (420, 760)
MOMENTS = {6: "begin", 16: "lost", 38: "end"}  # images of the walk after which pictures are taken
FILM_WIDTH, FILM_MS, FILM_COLOURS = 400, 350, 32
SETTLE_S, RELOAD_S = 3.0, 12.0  # until the page has drawn what it was told, and until it has begun anew


def picture(page: Page) -> Image.Image:
    """What the page shows."""
    content = base64.b64decode(page.ask("Page.captureScreenshot", format="png")["data"])
    return Image.open(BytesIO(content)).convert("RGB")


def sized(page: Page, size: tuple[int, int]) -> None:
    """Open the page anew in a window of another size."""
    page.ask("Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False)
    page.ask("Page.reload")
    time.sleep(RELOAD_S)


def main(words: list[str]) -> None:
    """Scan, and take pictures meanwhile."""
    folder = Path(words[0] if words else ROOT / "outputs/bench/live") / "head/lost/recording"
    recording = record(folder, "head", WALKS["lost"](), 0)
    source = CameraSource(Video(recording.video))
    film: list[Image.Image] = []
    with tempfile.TemporaryDirectory() as output, Preview("head") as preview:
        session = open_session(Path(output), source, recording.pattern, recording.intrinsics)
        address = f"http://127.0.0.1:{preview.server.get_port()}"
        with session, LivePage(preview, session.camera, session.projector) as live, browser(address, WIDE) as page:

            def watch(update: Update) -> None:
                live.show(update)
                time.sleep(SETTLE_S)
                shot = picture(page)
                film.append(shot.resize((FILM_WIDTH, FILM_WIDTH * shot.height // shot.width)))
                number = len(update.rows) - 1
                if number in MOMENTS:
                    shot.save(PICTURES / f"live-{MOMENTS[number]}.jpg", quality=85)
                    sized(page, NARROW)
                    picture(page).save(PICTURES / f"live-{MOMENTS[number]}-narrow.jpg", quality=85)
                    sized(page, WIDE)

            session.run(source, watch)
    frames = [shot.quantize(FILM_COLOURS) for shot in film]
    frames[0].save(PICTURES / "live.gif", save_all=True, append_images=frames[1:], duration=FILM_MS, loop=0,
                   optimize=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])
