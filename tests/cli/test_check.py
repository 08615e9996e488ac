"""sl-check as a user runs it."""

import subprocess
import sys
from pathlib import Path

import pytest

from sl_nerfstudio.cli.check import check
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import Fault, ScanError, UserError

sys.path.insert(0, str(Path(__file__).parents[1] / "scan"))
from sphere_scan import edit, write_sphere  # pyright: ignore[reportMissingImports]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sphere(tmp_path_factory.mktemp("check") / "scan")


def command(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sl_nerfstudio.cli.check", *arguments], capture_output=True, text=True, timeout=300
    )


def test_a_good_scan(good: Path) -> None:
    done = command(str(good))
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert lines[0] == f"{good}: no faults"
    assert lines[1:5] == [
        "  frames              4, 72 x 60 pixels",
        "  projector           OPENCV, 128 x 96 pixels",
        "  units               mm, scale unknown",
        "  working distance    270.1 mm (median)",
    ]
    assert lines[6].startswith("  starting poses      epipolar residual ")


def test_a_faulty_scan(good: Path, tmp_path: Path) -> None:
    root = write_sphere(tmp_path / "scan")
    edit(root, lambda document: document["projector"].update(fl_x=0))
    (root / "masks" / "frame_00001.png").unlink()
    done = command(str(root))
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        f"error: 2 faults in {root}\n"
        "transforms.json: projector.fl_x: is 0\n"
        "    cause:  it was not filled in, or has the sign of OpenGL's projection\n"
        "    remedy: give the focal length in pixels, a number greater than 0\n"
        "masks/frame_00001.png: is missing\n"
        "    cause:  it was moved, renamed or never written, or its name differs in upper and lower case\n"
        "    remedy: restore it or correct the path\n"
    )


def test_an_ordinary_data_set_gets_one_sentence(tmp_path: Path) -> None:
    root = write_sphere(tmp_path / "scan")

    def ordinary(document: dict) -> None:
        for key in ("projector", "sl_format", "scale", "units"):
            del document[key]
        document["frames"] = [{"file_path": f["file_path"], "transform_matrix": 0} for f in document["frames"]] * 99

    edit(root, ordinary)
    done = command(str(root))
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        f"error: 1 fault in {root}\n"
        "transforms.json: projector: is missing: there is no projector in this data set\n"
        "    cause:  it is an ordinary data set of nerfstudio, captured without a pattern projector\n"
        "    remedy: make a scan from captures of a projected pattern with sl-process\n"
    )


def test_no_such_folder(tmp_path: Path) -> None:
    done = command(str(tmp_path / "nowhere"))
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: 1 fault in {tmp_path / 'nowhere'}\ntransforms.json: is missing: ")
    assert "Traceback" not in done.stderr


def test_help_and_usage() -> None:
    done = command("--help")
    assert done.returncode == 0
    assert "List every fault of a scan folder at once" in done.stdout
    assert "DIR" in done.stdout
    assert command().returncode == 2


def test_help_does_not_load_what_it_does_not_need() -> None:
    code = "import sl_nerfstudio.cli.check, sys; print({'torch', 'nerfstudio', 'scipy', 'open3d'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "set()\n"


def test_notes_are_no_faults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from PIL import Image

    root = write_sphere(tmp_path / "scan")
    Image.new("L", (72, 60), 255).save(root / "masks" / "frame_00002.png")
    check(root)
    assert "  note                the mask covers the whole image in frame_00002\n" in capsys.readouterr().out


def test_how_commands_end(capsys: pytest.CaptureFixture[str]) -> None:
    def user() -> None:
        raise UserError("the flag\n    remedy: another")

    def interrupted() -> None:
        raise KeyboardInterrupt

    def broken() -> None:
        raise RuntimeError("ours")

    run(lambda: None)
    with pytest.raises(SystemExit) as end:
        run(user)
    assert end.value.code == 1
    assert capsys.readouterr().err == "error: the flag\n    remedy: another\n"
    with pytest.raises(SystemExit) as end:
        run(interrupted)
    assert end.value.code == 130
    with pytest.raises(RuntimeError, match="ours"):
        run(broken)


def test_a_reader_that_goes_away(good: Path) -> None:
    code = "import sys; from sl_nerfstudio.cli.run import run\nrun(lambda: [print('x' * 1000) for _ in range(10000)])"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None and process.stderr is not None
    process.stdout.read(10)
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == 1


def test_a_fault_in_words() -> None:
    fault = Fault("images/f7.png", "f7", None, "is empty", "a full disk", "copy it")
    assert str(fault) == "images/f7.png: is empty\n    cause:  a full disk\n    remedy: copy it"
    other = Fault("transforms.json", "f7", "w", "is 0", "a slip", "give it")
    assert str(other).splitlines()[0] == "transforms.json: frame f7: w: is 0"
    error = ScanError([fault, other], "scan")
    assert str(error).splitlines()[0] == "2 faults in scan"
    assert isinstance(error, UserError)
    assert str(ScanError([fault])).splitlines()[0] == "1 fault in the scan"


def test_the_verdict_on_the_starting_poses(good: Path, tmp_path: Path) -> None:
    """A frame that is turned about the object is no fault of the folder, but the coordinates contradict it."""
    lines = command(str(good)).stdout.splitlines()
    assert [line[:22].strip() for line in lines[7:10]] == ["coverage", "frames agree", "verdict"]
    assert lines[7].endswith("% of a frame's points seen by others")
    assert "px (median)" in lines[8] and "noise" in lines[8]
