"""Other processes that hold an output."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def another_process(code: str, *arguments: str | Path) -> Iterator[subprocess.Popen]:
    """A process that runs `code` with `sys` and `Path` until it prints `ready`, and then waits; killed afterwards."""
    begin = "import sys\nfrom pathlib import Path\nsys.argv[0] = 'sl-other'\n"
    code = f"{begin}{code}\nprint('ready', flush=True); sys.stdin.read()"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    with process:
        assert process.stdout.readline() == "ready\n"
        try:
            yield process
        finally:
            process.send_signal(signal.SIGKILL)


def kill(process: subprocess.Popen) -> None:
    """As the kernel does when memory is short."""
    process.send_signal(signal.SIGKILL)
    process.wait()
