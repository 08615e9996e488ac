"""Runs the benchmarks that take minutes, one after another: `make bench`, or `python -m benchmarks [NAME ...]`."""

import subprocess
import sys
import time
from pathlib import Path

RESULTS = Path("benchmarks/results")
SCAN = Path("outputs/bench/cone-and-cylinder")

BENCHMARKS: dict[str, list[str]] = {
    "iteration_time": [],
    "mesh_time": [],
    "tsdf_baseline": [str(SCAN)],
    "decoding": [],
    "decoding_graphs": [],
}
"""Module names, and their arguments besides --output."""


def main(names: list[str]) -> int:
    """Run the named benchmarks, or all. Return the exit status of the first that fails, or 0."""
    unknown = sorted(set(names) - BENCHMARKS.keys())
    if unknown:
        print(f"error: no benchmark named {', '.join(unknown)}; choose from {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 1
    for name in names or BENCHMARKS:
        status = make_scan() if str(SCAN) in BENCHMARKS[name] else 0
        status = status or run(f"benchmarks.{name}", *BENCHMARKS[name], "--output", str(RESULTS / f"{name}.json"))
        if status:
            return status
    return 0


def make_scan() -> int:
    """Make the synthetic scan that several benchmarks use, unless it exists. Return the exit status."""
    if (SCAN / "transforms.json").exists():
        return 0
    return run("sl_nerfstudio.cli.synth", "--output", str(SCAN))


def run(module: str, *arguments: str) -> int:
    """Run a module with the same Python, showing its output as it comes. Return its exit status."""
    print(f"\n$ python -m {module} {' '.join(arguments)}", flush=True)
    start = time.monotonic()
    status = subprocess.run([sys.executable, "-m", module, *arguments], check=False).returncode
    print(f"{module}: {time.monotonic() - start:.0f} s", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
