"""How commands end after signals: cleaned up, with the status that shells expect, and without a traceback."""

import signal
import subprocess
import sys

import pytest

_WAITING = """
import sys, time
from pathlib import Path
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.storage import NewFolder
def main():
    with NewFolder(Path(sys.argv[1])) as folder:
        folder.write("inner/a", b"")
        print("ready", flush=True)
        time.sleep(60)
run(main)
"""


@pytest.mark.parametrize(
    ("number", "status", "said"), [(signal.SIGINT, 130, "interrupted\n"), (signal.SIGTERM, 143, "terminated\n")]
)
def test_a_signal_ends_a_command_with_its_status_and_nothing_stays(tmp_path, number, status, said):
    process = subprocess.Popen(
        [sys.executable, "-c", _WAITING, tmp_path / "new"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "ready\n" and (tmp_path / "new" / "inner" / "a").exists()
    process.send_signal(number)
    assert process.communicate() == ("", said) and process.returncode == status
    assert list(tmp_path.iterdir()) == []


def test_a_second_signal_during_the_clean_up_changes_nothing_but_the_status(tmp_path):
    before, after = _WAITING.split('print("ready", flush=True)')
    slow = (
        f"{before}try: print('ready', flush=True); time.sleep(60)\n"
        f"        finally: print('cleaning', flush=True); time.sleep(60){after}"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", slow, tmp_path / "new"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    for said, number in (("ready\n", signal.SIGINT), ("cleaning\n", signal.SIGTERM)):
        assert process.stdout.readline() == said
        process.send_signal(number)
    assert process.communicate() == ("", "terminated\n") and process.returncode == 143
    assert list(tmp_path.iterdir()) == []


def test_the_handler_of_the_calling_program_stays():
    from sl_nerfstudio.cli.run import run

    seen, own = [], lambda *_: None
    before = signal.signal(signal.SIGTERM, own)
    try:
        run(lambda: seen.append(signal.getsignal(signal.SIGTERM)))
        assert seen == [own] and signal.getsignal(signal.SIGTERM) == own
    finally:
        signal.signal(signal.SIGTERM, before)
    run(lambda: seen.append(signal.getsignal(signal.SIGTERM)))
    assert signal.getsignal(signal.SIGTERM) == before != seen[1]


def test_names_that_no_encoding_can_show_are_printed_with_escapes():
    code = "import sys; from sl_nerfstudio.cli.run import run; run(lambda: print('wrote', sys.argv[1]))"
    done = subprocess.run([sys.executable, "-c", code, b"x\xff"], capture_output=True, check=True)
    assert done.stdout == b"wrote x\\udcff\n" and done.stderr == b""
