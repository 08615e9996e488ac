"""sl-check on good and faulty scans, and how every command ends."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from sl_nerfstudio.cli.check import main
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import Fault, ScanError, UserError

from .snapshots import call, expect, masked, succeed

sys.path.insert(0, str(Path(__file__).parents[1] / "scan"))
from sphere_scan import edit, write_sphere  # pyright: ignore[reportMissingImports]


def test_good_scans(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    said = succeed(main, "sl-check", write_sphere(Path("scan"))).out
    assert "frames              4, 72 x 60 pixels" in said and "working distance    270.1 mm" in said
    Image.new("L", (72, 60), 255).save("scan/masks/frame_00002.png")  # doubtful, but no fault
    noted = succeed(main, "sl-check", "scan").out
    assert "note                the mask covers the whole image in frame_00002" in noted
    expect("sl-check", "run", masked(said + noted))


def test_faulty_scans(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    edit(write_sphere(Path("faulty")), lambda document: document["projector"].update(fl_x=0))
    Path("faulty/masks/frame_00001.png").unlink()

    def ordinary(document: dict) -> None:
        for key in ("projector", "sl_format", "scale", "units"):
            del document[key]
        document["frames"] = [{"file_path": f["file_path"], "transform_matrix": 0} for f in document["frames"]] * 99

    edit(write_sphere(Path("ordinary")), ordinary)
    ended = [call(main, "sl-check", name) for name in ("faulty", "ordinary", "nowhere")]
    assert [(one.status, one.out) for one in ended] == [(1, "")] * 3
    expect("sl-check", "refused", "".join(one.err for one in ended))


def test_a_fault_in_words() -> None:
    fault = Fault("images/f7.png", "f7", None, "is empty", "a full disk", "copy it")
    assert str(fault) == "images/f7.png: is empty\n    cause:  a full disk\n    remedy: copy it"
    other = Fault("transforms.json", "f7", "w", "is 0", "a slip", "give it")
    assert str(other).splitlines()[0] == "transforms.json: frame f7: w: is 0"
    assert str(ScanError([fault, other], "scan")).splitlines()[0] == "2 faults in scan"
    assert str(ScanError([fault])).splitlines()[0] == "1 fault in the scan"


# How commands end: with the status that shells expect, cleaned up, and without a traceback.


def fail(error: BaseException) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (UserError("the flag\n    remedy: another"), 1, "error: the flag\n    remedy: another\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_errors_of_the_user_have_a_status_and_ours_keep_their_traceback(error, status, said) -> None:
    ended = call(lambda: run(lambda: fail(error)), "sl-x")
    assert (ended.status, ended.out, ended.err) == (status, "", said)
    with pytest.raises(RuntimeError, match="ours"):
        run(lambda: fail(RuntimeError("ours")))


@pytest.mark.parametrize(
    ("code", "out", "status"),
    [
        ("run(lambda: [print('x' * 1000) for _ in range(10000)])", None, 1),  # the reader goes away
        ("run(lambda: print('wrote', sys.argv[1]))", b"wrote x\\udcff\n", 0),  # a name that no encoding can show
    ],
)
def test_output_that_cannot_be_shown_is_no_traceback(code: str, out: bytes | None, status: int) -> None:
    command = [sys.executable, "-c", f"import sys; from sl_nerfstudio.cli.run import run; {code}", b"x\xff"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        if out is None:
            process.stdout.read(10)
            process.stdout.close()
        else:
            assert process.stdout.read() == out
        assert process.stderr.read() == b"" and process.wait() == status


_WAITING = """
import sys, time
from pathlib import Path
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.storage import NewFolder
def wait(word):
    print(word, flush=True)
    for _ in range(6000):  # a signal just before a sleep does not end that one
        time.sleep(0.01)
def main():
    with NewFolder(Path(sys.argv[1])) as folder:
        folder.write("inner/a", b"")
        try:
            wait("ready")
        finally:
            if len(sys.argv) > 2:
                wait("cleaning")
run(main)
"""


@pytest.mark.parametrize(
    ("signals", "status", "said"),
    [
        ([signal.SIGINT], 130, "interrupted\n"),
        ([signal.SIGTERM], 143, "terminated\n"),
        ([signal.SIGINT, signal.SIGTERM], 143, "terminated\n"),  # the second during the clean-up
    ],
)
def test_a_signal_ends_a_command_with_its_status_and_nothing_stays(tmp_path, signals, status, said) -> None:
    command = [sys.executable, "-c", _WAITING, tmp_path / "new", *(["slow"] if len(signals) > 1 else [])]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    for word, number in zip(("ready\n", "cleaning\n"), signals, strict=False):
        assert process.stdout.readline() == word and (tmp_path / "new" / "inner" / "a").exists()
        process.send_signal(number)
    assert process.communicate() == ("", said) and process.returncode == status
    assert list(tmp_path.iterdir()) == []


def test_the_handler_of_the_calling_program_stays() -> None:
    seen, own = [], lambda *_: None
    before = signal.signal(signal.SIGTERM, own)
    try:
        run(lambda: seen.append(signal.getsignal(signal.SIGTERM)))
        assert seen == [own] and signal.getsignal(signal.SIGTERM) == own
    finally:
        signal.signal(signal.SIGTERM, before)
    run(lambda: seen.append(signal.getsignal(signal.SIGTERM)))
    assert signal.getsignal(signal.SIGTERM) == before != seen[1]
