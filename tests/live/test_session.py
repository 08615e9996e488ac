"""Sessions: what is kept, and that an interruption changes nothing."""

import numpy as np
import pytest

from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.live import session as module
from sl_nerfstudio.live.session import STATE, Session, open_session
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import read_image
from tests.live.walks import AWAY, CAMERA, PROJECTOR, FakeEye, FakeSource

WALK = [0, 1, 2, 2, AWAY, AWAY, 1, 2, 3, 4]


@pytest.fixture(autouse=True)
def _known_images(monkeypatch):
    monkeypatch.setattr(module, "Eye", FakeEye)


def new(root) -> Session:
    return Session(root, NetworkDecoder(GridPattern()), CAMERA, PROJECTOR)


def scan(root, source):
    updates = []
    with new(root) as session:
        session.run(source, updates.append)
    return session, updates


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "Eye", FakeEye)
        return scan(tmp_path_factory.mktemp("whole") / "live", FakeSource(WALK))


def without_seconds(rows):
    return [(r.name, r.state, r.cause, r.kept, r.anchor) for r in rows]


@pytest.mark.slow
def test_frames_that_add_something_are_kept_as_captures(whole):
    session, updates = whole
    kept = [WALK[k] for k, row in enumerate(session.rows) if row.kept >= 0]
    assert kept == [0, 1, 2, 3, 4]
    files = sorted(session.captures.glob("*.png"))
    assert [path.stem for path in files] == [f"frame_{k:04d}" for k in range(5)]
    assert [int(read_image(path)[0, 0, 0]) for path in files] == kept
    assert [u.row.state for u in updates[4:6]] == ["lost", "lost"]
    assert np.isfinite(session.poses).all((1, 2)).tolist() == [place != AWAY for place in WALK]


@pytest.mark.slow
@pytest.mark.parametrize("cut", [1, 4, 8])
def test_a_session_that_was_interrupted_gives_the_same_scan(whole, tmp_path, cut):
    with pytest.raises(KeyboardInterrupt):
        scan(tmp_path / "live", FakeSource(WALK, fails_after=cut))
    resumed, updates = scan(tmp_path / "live", FakeSource(WALK))
    assert len(updates) == len(WALK) - cut
    assert without_seconds(resumed.rows) == without_seconds(whole[0].rows)
    np.testing.assert_allclose(resumed.poses, whole[0].poses, rtol=0, atol=1e-11)  # sums of several threads
    files = [sorted(path.name for path in s.captures.glob("*.png")) for s in (resumed, whole[0])]
    assert files[0] == files[1]


@pytest.mark.slow
def test_an_image_that_was_kept_but_not_noted_comes_again(whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Session, "_note", lambda self: 1 / (len(self.rows) - 3) and _note(self))
        with pytest.raises(ZeroDivisionError):
            scan(tmp_path / "live", FakeSource(WALK))
    resumed, _ = scan(tmp_path / "live", FakeSource(WALK))
    assert without_seconds(resumed.rows) == without_seconds(whole[0].rows)
    assert len(list(resumed.captures.glob("*.png"))) == 5


_note = Session._note


def test_a_damaged_record_is_refused_and_nothing_is_lost(tmp_path):
    session, _ = scan(tmp_path / "live", FakeSource(WALK[:3]))
    (tmp_path / "live" / STATE).write_bytes(b"damaged")
    with pytest.raises(UserError, match=r"state.npz: is missing, damaged(.|\n)*remedy: give another --output"):
        scan(tmp_path / "live", FakeSource(WALK))
    assert len(list(session.captures.glob("*.png"))) == 3


def test_too_few_frames_are_refused_with_what_was_seen(tmp_path):
    session, _ = scan(tmp_path / "live", FakeSource([0, AWAY, AWAY]))
    with pytest.raises(UserError, match=r"1 frames were kept, a scan needs 2\n.*of 3 images: 2 no pattern, 1 placed"):
        session.require_enough()


def test_images_of_another_size_are_refused(tmp_path):
    session = Session(tmp_path / "live", NetworkDecoder(GridPattern()), CAMERA.scaled(0.5), PROJECTOR)
    with session, pytest.raises(UserError, match=r"image 0: has 100 x 100 pixels, and the images before have 50 x 50"):
        session.run(FakeSource([0]), lambda update: None)


def test_gray_code_is_refused(tmp_path):
    path = tmp_path / "pattern.json"
    path.write_bytes(GrayCode(64, 48).encode())
    with pytest.raises(UserError, match=r"is no coded grid\n(.|\n)*remedy: project a coded grid"):
        open_session(tmp_path / "live", FakeSource([]), path, path)
