"""Runs the benchmarks that take minutes, one after another: `make bench`, or `python -m benchmarks [NAME ...]`."""

import subprocess
import sys
import time
from pathlib import Path

RESULTS = Path("benchmarks/results")
SCAN = Path("outputs/bench/cone-and-cylinder")
BENCHMARKS = {"iteration_time": (), "tsdf_baseline": (str(SCAN),), "decoding": ()}
"""Module names, and their arguments besides --output."""


def main(names: list[str]) -> int:
    """Run the named benchmarks, or all. Return the exit status of the first that fails, or 0."""
    unknown = sorted(set(names) - BENCHMARKS.keys())
    if unknown:
        print(f"error: no benchmark named {', '.join(unknown)}; choose from {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 1
    if not (SCAN / "transforms.json").exists() and (not names or "tsdf_baseline" in names):
        status = run("sl_nerfstudio.cli.synth", "--output", str(SCAN))
        if status:
            return status
    for name in names or BENCHMARKS:
        status = run(f"benchmarks.{name}", *BENCHMARKS[name], "--output", str(RESULTS / f"{name}.json"))
        if status:
            return status
    return 0


def run(module: str, *arguments: str) -> int:
    """Run a module with the same Python, showing its output as it comes. Return its exit status."""
    print(f"\n$ python -m {module} {' '.join(arguments)}", flush=True)
    start = time.monotonic()
    status = subprocess.run([sys.executable, "-m", module, *arguments], check=False).returncode
    print(f"{module}: {time.monotonic() - start:.0f} s", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
