"""Runs the benchmarks that need minutes, one after the other: `make bench`, or `python -m benchmarks [NAME ...]`."""

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
"""Name of the module, and its arguments besides --output."""


def main(names: list[str]) -> int:
    """Run the named benchmarks, or all; the exit status is that of the first that fails."""
    unknown = sorted(set(names) - BENCHMARKS.keys())
    if unknown:
        print(f"error: no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 1
    for name in names or BENCHMARKS:
        status = make_scan() if str(SCAN) in BENCHMARKS[name] else 0
        status = status or run(f"benchmarks.{name}", *BENCHMARKS[name], "--output", str(RESULTS / f"{name}.json"))
        if status:
            return status
    return 0


def make_scan() -> int:
    """The synthetic scan that several benchmarks use, made once."""
    if (SCAN / "transforms.json").exists():
        return 0
    return run("sl_nerfstudio.cli.synth", "--output", str(SCAN))


def run(module: str, *arguments: str) -> int:
    """Run a module with the same Python; what it prints is shown as it comes."""
    print(f"\n$ python -m {module} {' '.join(arguments)}", flush=True)
    start = time.monotonic()
    status = subprocess.run([sys.executable, "-m", module, *arguments], check=False).returncode
    print(f"{module}: {time.monotonic() - start:.0f} s", flush=True)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
