"""sl-scan --live: what it refuses, and that it ends in the pipeline on the frames that it kept."""

from pathlib import Path

import pytest

from sl_nerfstudio.cli import scan as module
from sl_nerfstudio.cli.scan import main
from sl_nerfstudio.live import session as sessions
from sl_nerfstudio.live import sources
from sl_nerfstudio.model import preview
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.write import device_fields, encode_json
from tests.live.walks import CAMERA, PROJECTOR, FakeEye, FakeSource

from .snapshots import call, expect

pytestmark = pytest.mark.filterwarnings("ignore")  # of websockets, for what viser uses
FILES = ("--pattern", "pattern.json", "--intrinsics", "intrinsics.json", "--output", "result")
LIVE = ("--live", "--camera", "walk", *FILES)


@pytest.fixture(autouse=True)
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(preview, "PORT", 8490)
    pattern = GridPattern()
    Path("pattern.json").write_bytes(pattern.encode())
    projector = device_fields(PROJECTOR, "model") | {"w": pattern.w, "h": pattern.h}
    document = {"units": "mm", **device_fields(CAMERA, "camera_model"), "projector": projector}
    Path("intrinsics.json").write_bytes(encode_json(document))


def test_flags_that_do_not_belong_together_are_refused():
    Path("photographs").mkdir()
    cases = [
        ("--output", "result"),
        ("photographs", "--camera", "0", *FILES),
        ("photographs", "--live", "--camera", "0", *FILES),
        ("photographs", "--share", *FILES),
        ("--live", *FILES),
        ("--live", "--camera", "0", "--output", "result"),
        ("--live", "--camera", "0", "--pattern", "pattern.json", "--output", "result"),
        (*LIVE, "--color", "photographs"),
        (*LIVE,),
    ]
    said = []
    for flags in cases:
        ended = call(main, "sl-scan", *flags)
        assert ended.status == 1 and ended.err.startswith("error: "), (flags, ended)
        said.append(f"$ {' '.join(flags)}\n{ended.err}")
    expect("sl-scan", "a live scan refused", "".join(said))


def test_it_ends_in_the_pipeline_goes_on_after_an_interruption_and_is_not_done_twice(monkeypatch):
    monkeypatch.setattr(sessions, "Eye", FakeEye)
    walk = FakeSource([0, 1, 2, 3], fails_after=2)
    monkeypatch.setattr(sources, "open_source", lambda text: walk)
    processed = []
    monkeypatch.setattr(module.Work, "process", lambda work: processed.append(work.config.processing().images))

    def end(_: object) -> Path:
        raise KeyboardInterrupt  # where the training would begin

    monkeypatch.setattr(module.Work, "train", end)
    ended = call(main, "sl-scan", *LIVE)
    assert ended.status == 130 and not processed and "to go on: sl-scan --output result" in ended.err
    walk.fails_after = None
    ended = call(main, "sl-scan", *LIVE)
    assert "going on after 2 images" in ended.out and "4 images: 4 tracked, 0 uncertain, 0 lost" in ended.out
    captures = Path("result/live/captures")
    assert processed == [captures] and len(list(captures.glob("*.png"))) == 4
    monkeypatch.setattr(sources, "open_source", lambda text: pytest.fail("opened again"))
    assert "-- live: as before" in call(main, "sl-scan", *LIVE).out
    assert processed == [captures] * 2
