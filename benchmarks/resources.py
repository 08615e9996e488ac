"""Memory and time per step against the number and size of frames.

    python -m benchmarks.resources [--frames 5 22 57] [--sizes 400 1200] [--steps 60] [--output FILE]

Every scan is checked, read, adjusted and trained for a few steps in a separate process, with the code that `ns-train
sl-neus` runs. Larger images are those of the 400-pixel scan with every pixel repeated: they contain no more detail, but
cost as much as real ones.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.machine import write_rows
from benchmarks.common.parts import Part, measured
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.write import ScanWriter
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

BASE = 400


@dataclass(frozen=True)
class Row:
    """One scan."""

    frames: int
    size: int
    peak_gb: float  # resident memory of the whole process, including libraries
    check_seconds: float
    read_seconds: float
    adjust_seconds: float
    step_ms: float  # median


def enlarged(device: Device, factor: int) -> Device:
    """The same camera with every pixel split into factor x factor."""
    return replace(
        device,
        w=device.w * factor,
        h=device.h * factor,
        fl_x=device.fl_x * factor,
        fl_y=device.fl_y * factor,
        cx=device.cx * factor,
        cy=device.cy * factor,
    )


def make_scan(source: Path, frames: int, factor: int, to: Path) -> None:
    """The first frames of a scan, enlarged."""
    scan = read_scan(source)

    def large(image: np.ndarray) -> np.ndarray:
        return np.repeat(np.repeat(image, factor, 0), factor, 1)

    pattern = (scan.read_pattern() * 255).round().astype(np.uint8)
    camera = enlarged(scan.frames[0].camera, factor)
    with ScanWriter(
        to, units=scan.units, scale=scan.scale, projector=scan.projector, pattern=pattern, camera=camera
    ) as writer:
        for frame in scan.frames[:frames]:
            writer.add_frame(
                frame.name,
                image=large(frame.read_image()),
                coords=large(frame.read_coords()),
                mask=large(frame.read_mask()),
                T_world_camera=frame.T_world_camera,
                T_world_projector=frame.T_world_projector,
            )


def measure_here(scan: Path, steps: int, with_check: bool = True) -> dict[str, dict[str, float]]:
    """Check, read, adjust and train a scan in this process: what each part took; of the steps, the median."""
    from sl_nerfstudio.dataparser.dataparser import load_scan
    from sl_nerfstudio.methods import sl_neus
    from sl_nerfstudio.scan import check_scan

    parts: dict[str, Part] = {}
    if with_check:
        faults, parts["check"] = measured(lambda: check_scan(scan))
        if faults:
            raise SystemExit("\n".join(map(str, faults)))
    _, parts["read"] = measured(lambda: load_scan(scan))
    with tempfile.TemporaryDirectory() as folder:
        config = replace(sl_neus.config, output_dir=Path(folder), max_num_iterations=1000)
        config.pipeline.datamanager.data = scan
        config.pipeline.model.warm_start = 0.0  # type: ignore[attr-defined]  # rendering from the first step on
        config.set_timestamp()
        trainer = config.setup(local_rank=0, world_size=1)
        _, parts["set up"] = measured(trainer.setup)
        model, samples = trainer.pipeline.model, trainer.pipeline.datamanager.samples
        _, parts["adjust"] = measured(lambda: model.adjust_poses(samples))
        _, parts["measure noise"] = measured(lambda: model.measure_noise(samples))
        each = []
        for step in range(1, steps + 1):
            model.anneal(step)
            _, taken = measured(lambda step=step: trainer.train_iteration(step))
            each.append(taken)
        late = each[len(each) // 3 :]
        seconds, cpu = (float(np.median([getattr(p, name) for p in late])) for name in ("seconds", "cpu_seconds"))
        parts["step"] = Part(seconds, cpu, max(p.peak_gb for p in late))
    return {name: asdict(part) for name, part in parts.items()}


def measure(scan: Path, steps: int, with_check: bool = True) -> dict[str, Part]:
    """The same in a fresh process, so that its memory is measured alone."""
    command = [sys.executable, "-m", "benchmarks.resources", "--scan", str(scan), "--steps", str(steps)]
    command += [] if with_check else ["--no-check"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stdout + done.stderr)
    found = json.loads(done.stdout.strip().splitlines()[-1])
    return {name: Part(**part) for name, part in found.items()}


def row_of(frames: int, size: int, parts: dict[str, Part]) -> Row:
    """The figures of one scan."""
    return Row(
        frames=frames,
        size=size,
        peak_gb=max(part.peak_gb for part in parts.values()),
        check_seconds=parts["check"].seconds,
        read_seconds=parts["read"].seconds,
        adjust_seconds=parts["adjust"].seconds,
        step_ms=1000 * parts["step"].seconds,
    )


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", nargs="+", type=int, default=[5, 22, 57])
    parser.add_argument("--sizes", nargs="+", type=int, default=[400, 1200], help="multiples of 400")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--folder", type=Path, default=Path("outputs/resources"), help="folder of the scans, made once")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/resources.json"))
    parser.add_argument("--scan", type=Path, help="only measure this scan, in this process, and print the figures")
    parser.add_argument("--no-check", action="store_true", help="with --scan: without the check")
    options = parser.parse_args()
    if options.scan:
        print(json.dumps(measure_here(options.scan, options.steps, not options.no_check)))
        return
    source = options.folder / "source"
    if not source.exists():
        synthesise(SynthConfig(scene="frog", frames=max(options.frames), resolution=BASE, seed=1), source)
    rows = []
    for size in options.sizes:
        for frames in options.frames:
            scan = options.folder / f"{frames}x{size}"
            if not scan.exists():
                make_scan(source, frames, size // BASE, scan)
            rows.append(row_of(frames, size, measure(scan, options.steps)))
            print(rows[-1], flush=True)
    write_rows(options.output, rows)


if __name__ == "__main__":
    main()
