"""Everything that is to be known of a GPU, within nine minutes, into one file.

    python -m benchmarks.gpu [--scan FOLDER] [--device cpu --steps 2 --paper-steps 3 --default-steps 30] [--only NAME]

In order of value: the kernels against double precision; times of a step and of the loop around it, waits and memory, of
both methods with every backend, with and without a CUDA graph; the kernels' shares of a step, and the least that the
device's bandwidth and arithmetic allow; recording beside a thread that uses the GPU; a recording that fails; new
recordings while levels are switched on; a training that goes on from its checkpoint against one in one go; whole
trainings, with their surfaces against the truth, and against the same training on the CPU; reading a photograph; what
torch.compile makes of the plain field; the same step with nerfstudio's own encoding. A part that fails is written down
with its error, and the next one begins; what there is no time for is left out by name; the file is written after each
part. With `--device cpu` all of it runs without a GPU, except for what needs one. Without open3d, `--scan` is needed
(one with its truth), and distances are those of the true surface's points from the field's zero, by its values and
slopes.
"""

import copy
import gc
import json
import statistics
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.common.iteration_step import SIZES, Ours, Theirs, softplus
from benchmarks.common.measuring import describe, parsed
from benchmarks.common.training import Training, model_of, settings
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.decoding.grid_networks import LoadedNetworks
from sl_nerfstudio.errors import first_line
from sl_nerfstudio.field.backend import BackendName
from sl_nerfstudio.field.field import FieldConfig, SDFField
from sl_nerfstudio.field.torch_backend import TorchField
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.model.loop import CudaRecorder
from sl_nerfstudio.model.run_files import checkpoints_in
from sl_nerfstudio.parallel import DeviceName, one_library_thread
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.write import read_ground_truth

METHODS = {"paper": "sl-neus-paper", "default": "sl-neus"}
_GROUPS = 10  # of timed steps; their median counts


@dataclass(frozen=True)
class Config:
    """All measurements on one device."""

    device: str = "cuda"  # where the field is; cpu: to try this command
    scan: Path | None = None  # by default one is made in outputs/bench
    frames: int = 22  # of the scan that is made
    resolution: int = 400
    steps: int = 200  # timed ones of each variant, after the first ones that are not timed
    paper_steps: int = 10_000  # length of the whole training of sl-neus-paper on the device
    default_steps: int = 1000  # of sl-neus, on the device and on the CPU
    compared_steps: int = 300  # of the trainings of sl-neus-paper that compare the device with the CPU
    mesh_resolution: int = 256  # cells along the scene's box of the surfaces that are compared
    seconds: int = 520  # no part begins after these
    only: tuple[str, ...] = ()  # parts of the names of what is measured; by default all
    output: Path = Path("benchmarks/results/gpu.json")


def main(config: Config) -> dict[str, Any]:
    """Measure part after part; print and write each."""
    warnings.simplefilter("ignore")
    scan = config.scan or _made(config)
    result: dict[str, Any] = {"machine": describe_device(config.device)}
    begin = time.monotonic()
    with one_library_thread():
        for name, part in parts(config, scan).items():
            try:
                late = time.monotonic() - begin > config.seconds
                result[name] = {"left out": f"{config.seconds} s are over"} if late else part()
            except Exception as error:  # whatever a driver or a library does, the other figures are still wanted
                result[name] = {"error": first_line(error), "where": traceback.format_exc(limit=-3)}
            print(f"{name}: {json.dumps(result[name])}", flush=True)
            result["seconds"] = round(time.monotonic() - begin, 1)
            config.output.parent.mkdir(parents=True, exist_ok=True)
            config.output.write_text(json.dumps(result, indent=1) + "\n")
    return result


def parts(config: Config, scan: Path) -> dict[str, Callable[[], dict[str, Any]]]:
    """All measurements by name."""
    there = config.device
    found: dict[str, Callable[[], dict[str, Any]]] = {"kernels": partial(against_double_precision, config)}
    for size in METHODS:
        for backend in reversed(backends(there)):
            for graph in (False, True) if there == "cuda" else (False,):
                name = f"step {size} {backend}{' graph' if graph else ''}"
                found[name] = partial(step_times, config, scan, size, backend, graph)
    for size in METHODS:
        found[f"bound {size}"] = partial(bound, config, scan, size)
    if there == "cuda":
        for size in METHODS:
            found[f"shares {size}"] = partial(shares, config, scan, size)
        found["beside a busy thread"] = partial(beside_a_busy_thread, config, scan)
        found["failed recording"] = partial(failed_recording, config, scan)
        found["new recordings"] = partial(new_recordings, config, scan)
    for size in METHODS:
        found[f"resume {size}"] = partial(resumed, config, scan, size)
    for device in dict.fromkeys((there, "cpu")):
        found[f"surface paper {device}"] = partial(surface, config, scan, "paper", device, config.compared_steps)
        found[f"surface default {device}"] = partial(surface, config, scan, "default", device, config.default_steps)
    long = partial(surface, config, scan, "paper", there, config.paper_steps)
    found[f"surface paper {config.paper_steps} steps"] = long
    found["decoding"] = partial(decoding, config, scan)
    for size in METHODS:
        found[f"compiled {size}"] = partial(compiled_step, config, scan, size)
    for size in SIZES:
        for name, make in encodings(there).items():
            found[f"encoding {size} {name}"] = partial(encoding_times, config, partial(make, SIZES[size]))
    return {name: part for name, part in found.items() if not config.only or any(x in name for x in config.only)}


def backends(device: str) -> list[BackendName]:
    """What can compute the field there."""
    return ["torch", "triton"] if device == "cuda" else ["torch", "numba"]


def encodings(device: str) -> dict[str, Callable[..., Ours | Theirs]]:
    """A step with our encoding and with nerfstudio's, in each implementation that there is."""
    found: dict[str, Callable[..., Ours | Theirs]] = {
        f"ours {backend}": partial(Ours, device=device, backend=backend) for backend in backends(device)
    }
    found["nerfstudio torch"] = partial(Theirs, activation=softplus, device=device)
    if device == "cuda" and find_spec("tinycudann") is not None:
        found["nerfstudio tiny-cuda-nn"] = partial(Theirs, activation=softplus, device=device, implementation="tcnn")
    return found


def begun(
    scan: Path,
    size: str,
    device: str,
    steps: int,
    backend: BackendName,
    graph: bool,
    adjust: bool,
    checkpoint: Path | None = None,
) -> Training:
    """A training whose run folder is forgotten; with a checkpoint it goes on from there."""
    run = settings(METHODS[size], scan, Path(tempfile.mkdtemp()), device, steps)
    run.cuda_graph, run.load_checkpoint = graph, checkpoint
    model_of(run).sdf.backend = backend
    torch.manual_seed(0)
    return Training(run, adjust)


def step_times(config: Config, scan: Path, size: str, backend: BackendName, graph: bool) -> dict[str, Any]:
    """Milliseconds of a step in which rays are rendered, and memory."""
    _forget_memory(config.device)
    training = begun(scan, size, config.device, 1000, backend, graph, adjust=False)
    training.done = 601  # all levels have their weight
    begin = time.perf_counter()
    training.trainer._compile_kernels()
    found: dict[str, Any] = {"compile_s": round(time.perf_counter() - begin, 2)}
    found |= _timed(training.step, config.steps, config.device)

    def turn() -> None:
        training.step()
        training.after()

    found["loop_ms"] = _timed(turn, config.steps, config.device)["ms"]
    if config.device == "cuda":
        found["waits"] = waits(turn)
    return {**found, "graph": training.trainer.recorded is not None, **_memory(config.device)}


def bound(config: Config, scan: Path, size: str) -> dict[str, Any]:
    """Least time of a step: its matrix products and the rows of the table that it touches, at the device's own speeds.

    Rows as in benchmarks.iteration_time: four times 32 bytes each for values and gradients, seven for Adam.
    """
    source = torch.randn(1 << (28 if config.device == "cuda" else 24), device=config.device)
    target, side = torch.empty_like(source), 8192 if config.device == "cuda" else 1024
    a, b = torch.randn(side, side, device=config.device), torch.randn(side, side, device=config.device)
    bandwidth = 2 * source.nbytes / _timed(lambda: target.copy_(source), 20, config.device)["best_ms"] * 1e3
    speed = 2 * side**3 / _timed(lambda: torch.mm(a, b), 20, config.device)["best_ms"] * 1e3
    backend: BackendName = "triton" if config.device == "cuda" else "torch"
    training = begun(scan, size, config.device, 1000, backend, graph=False, adjust=False)
    training.done = 601
    training.before()
    table = training.model.field.encoding.table
    with FlopCounterMode(display=False) as counter:
        _, terms, _ = training.pipeline.get_train_loss_dict(step=601)
        torch.stack(list(terms.values())).sum().backward()
    assert table.grad is not None
    rows, flop = int((table.grad != 0).any(1).sum()), counter.get_total_flops()
    products_ms, memory_ms = flop / speed * 1e3, rows * 32 * (4 + 7) / bandwidth * 1e3
    return {
        "tflops": round(speed / 1e12, 2), "bandwidth_gb": round(bandwidth / 1e9), "gflop": round(flop / 1e9, 2),
        "rows": rows, "products_ms": round(products_ms, 3), "memory_ms": round(memory_ms, 3),
    }  # fmt: skip


def shares(config: Config, scan: Path, size: str) -> dict[str, Any]:
    """Microseconds that each kernel takes in a step that is repeated by a CUDA graph, the longest ones by name."""
    training = begun(scan, size, config.device, 1000, "auto", True, adjust=False)
    training.done = 601
    for _ in range(10):
        training.step()
    _wait(config.device)
    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        for _ in range(_GROUPS):
            training.step()
        _wait(config.device)
    rows = [(x.key[:80], round(x.device_time_total / _GROUPS, 1), x.count / _GROUPS) for x in seen.key_averages()]
    rows = sorted((row for row in rows if row[1]), key=lambda row: -row[1])
    return {"us": round(sum(row[1] for row in rows), 1), "launches": sum(row[2] for row in rows), "longest": rows[:30]}


def compiled_step(config: Config, scan: Path, size: str) -> dict[str, Any]:
    """`step_times` of the plain field, whose three functions torch compiles."""
    names = ("evaluate", "pull_back", "pull_back_gradient")
    plain = {name: getattr(TorchField, name) for name in names}
    with ExitStack() as stack:
        for name in names:
            stack.enter_context(patch.object(TorchField, name, torch.compile(plain[name], dynamic=False)))
        return step_times(config, scan, size, "torch", config.device == "cuda")


def waits(turn: Callable[[], Any]) -> dict[str, int]:
    """Where the host waited for the GPU in ten turns of the loop, as torch notices it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            for _ in range(10):
                turn()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    places = [f"{Path(x.filename).name}:{x.lineno}" for x in caught if "called a synchronizing" in str(x.message)]
    return {place: places.count(place) for place in dict.fromkeys(places)}


def against_double_precision(config: Config) -> dict[str, Any]:
    """Greatest differences of values, slopes and all gradients from torch's in float64, over the greatest of these."""
    torch.manual_seed(0)
    exact = SDFField(FieldConfig(backend="torch")).double()
    with torch.no_grad():
        exact.encoding.table.normal_(0, 0.05)
    p = torch.rand(30_000, 3, dtype=torch.float64) * 2.2 - 1.1
    wanted = _derivatives(copy.deepcopy(exact), p)
    found = {}
    for backend in backends(config.device):
        field = copy.deepcopy(exact).float().to(config.device)
        field.config = FieldConfig(backend=backend)
        got = _derivatives(field, p.to(config.device, torch.float32))
        errors = [float((a - b).abs().max() / b.abs().max()) for a, b in zip(got, wanted, strict=True)]
        found[backend] = [float(f"{error:.1e}") for error in errors]
    return found


def _derivatives(field: SDFField, p: torch.Tensor) -> list[torch.Tensor]:
    p = p.clone().requires_grad_()
    f, slopes = field.sdf_and_last_gradients(p, len(p) * 2 // 3)
    (f.square().sum() + (slopes.norm(dim=-1) - 1).square().sum()).backward()
    found = (f, slopes, p.grad, *(y.grad for y in field.parameters()))
    return [x.detach().double().cpu() for x in found if x is not None]


def beside_a_busy_thread(config: Config, scan: Path) -> dict[str, Any]:
    """Whether a step is recorded while another thread, as the viewer's, allocates, computes and waits."""
    training = begun(scan, "default", config.device, 1000, "auto", True, adjust=False)
    training.done, stop, errors = 601, threading.Event(), []

    def busy() -> None:
        while not stop.is_set() and not errors:
            try:
                torch.arange(1 << 22, device="cuda").cpu()  # random numbers are the recording's
                torch.cuda.empty_cache()
            except RuntimeError as error:
                errors.append(first_line(error))

    thread = threading.Thread(target=busy)
    thread.start()
    try:
        for _ in range(10):
            training.step()
    finally:
        stop.set()
        thread.join()
    return {"graph": training.trainer.recorded is not None, "errors_of_the_thread": errors}


def failed_recording(config: Config, scan: Path) -> dict[str, Any]:
    """Losses of steps of which none can be recorded, because they wait, and of the same steps on plain launches."""
    losses = {}
    for graph in (False, True):
        training = begun(scan, "default", config.device, 1000, "auto", graph, adjust=False)
        training.done, operations = 601, training.trainer._operations

        def waiting(rates: Any, operations: Any = operations) -> Any:
            torch.cuda.synchronize()
            return operations(rates)

        with patch.object(training.trainer, "_operations", waiting):
            if graph:
                training.trainer.record_steps(
                    CudaRecorder([training.pipeline.datamanager.train_pixel_sampler.generator])
                )
            losses["waiting" if graph else "plain"] = [float(training.step()[0]) for _ in range(8)]
    return {**losses, "graph": training.trainer.recorded is not None}


def new_recordings(config: Config, scan: Path) -> dict[str, Any]:
    """Steps of a short training that took far longer than the others, and the memory at its end."""
    _forget_memory(config.device)
    training = begun(scan, "default", config.device, 120, "auto", True, adjust=False)
    slow = []
    for step in range(140):
        begin = time.perf_counter()
        training.step()
        training.after()
        _wait(config.device)
        if time.perf_counter() - begin > 0.02:
            slow.append((step, round(time.perf_counter() - begin, 3)))
    return {"slow_steps": slow, "graph": training.trainer.recorded is not None, **_memory(config.device)}


def resumed(config: Config, scan: Path, size: str) -> dict[str, Any]:
    """Greatest difference of weights after N steps, a checkpoint and N more from 2 N steps, over the greatest weight.

    And that of 2 N steps from the same again: on a GPU sums are in no fixed order.
    """
    steps = config.steps

    def taken(training: Training, until: int) -> Training:
        while training.done < until:
            training.step()
            training.after()
        return training

    begin = partial(begun, scan, size, config.device, 2 * steps, "auto", True, False)
    half = taken(begin(), steps)
    half.trainer.save_checkpoint(steps - 1)
    again = begin(checkpoint=checkpoints_in(half.trainer.checkpoint_dir)[-1])
    again.done = steps
    wanted = taken(begin(), 2 * steps)
    others = {"resumed": taken(again, 2 * steps), "in_one_go": taken(begin(), 2 * steps)}
    return {"steps": steps, **{name: _difference(wanted.model, other.model) for name, other in others.items()}}


def _difference(one: torch.nn.Module, other: torch.nn.Module) -> float:
    pairs = [x for x in zip(one.parameters(), other.parameters(), strict=True) if x[0].numel()]
    return float(f"{max(float((a - b).abs().max() / a.abs().max().clamp_min(1e-30)) for a, b in pairs):.1e}")


def decoding(config: Config, scan: Path) -> dict[str, Any]:
    """Seconds of the networks that read photographs, for the pattern itself seen from the front, and what differs."""
    pattern = read_layout(scan / "pattern.json")
    image = cv2.imread(str(scan / "pattern.png"), cv2.IMREAD_GRAYSCALE)
    assert isinstance(pattern, GridPattern) and image is not None
    image = np.asarray(cv2.resize(image, (600, 600), interpolation=cv2.INTER_AREA), np.uint8)
    found, coords = {}, []
    devices: list[DeviceName] = ["cuda", "cpu"] if config.device == "cuda" else ["cpu"]
    for device in devices:
        decoder = GridImageDecoder(pattern, LoadedNetworks(device))
        decoder.decode(image)  # what is loaded or compiled at first use
        begin = time.perf_counter()
        coords.append(decoder.decode(image).coords)
        found[f"{device}_s"] = round(time.perf_counter() - begin, 3)
    both = np.isfinite(coords[0][..., 0]) & np.isfinite(coords[-1][..., 0])
    found["decoded"] = [round(float(np.isfinite(x[..., 0]).mean()), 5) for x in coords]
    found["largest_difference_px"] = float(np.abs(coords[0][both] - coords[-1][both]).max())
    return found


def encoding_times(config: Config, make: Callable[[], Ours | Theirs]) -> dict[str, Any]:
    """Milliseconds of a step of benchmarks.iteration_time."""
    _forget_memory(config.device)
    return {**_timed(make().step, config.steps, config.device), **_memory(config.device)}


def surface(config: Config, scan: Path, size: str, device: str, steps: int) -> dict[str, Any]:
    """Seconds of a whole training without its start, and the distance of its surface from the truth."""
    _forget_memory(device)
    begin = time.perf_counter()
    training = begun(scan, size, device, steps, "auto", True, adjust=True)
    prepared = time.perf_counter()
    for _ in range(steps):
        training.step()
    _wait(device)
    trained = time.perf_counter()
    return {
        "steps": steps, "prepare_s": round(prepared - begin, 2), "train_s": round(trained - prepared, 2),
        **rmse(config.mesh_resolution, training), **_memory(device),
    }  # fmt: skip


def rmse(resolution: int, training: Training) -> dict[str, Any]:
    """RMS and median distance of the observed surface from the truth, in mm, after rigid alignment.

    Without open3d: of the true surface's points, but for the farthest fifth, which may not have been observed.
    """
    model = training.model.eval()
    if find_spec("open3d") is None:
        return _by_values(model)
    from sl_nerfstudio.evaluation.evaluate import read_reference, score_alignments
    from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
    from sl_nerfstudio.meshing.visibility import trim_to_observed

    whole = extract_mesh(model.sdf, resolution, device=model.device).mapped(model.S_scene_world.inverse())
    observed = trim_to_observed(whole, model.scan, model.poses()).mesh
    truth = read_ground_truth(model.scan)
    reference = read_reference(truth.mesh_path, model.scan, truth.poses or model.poses(), 100_000, 0)
    assert reference is not None
    scores = score_alignments(IndexedMesh(observed), reference, model.poses(), truth.poses)
    accuracy = scores["rigid"].accuracy
    return {"rmse_mm": round(accuracy.rmse, 4), "median_mm": round(accuracy.median, 4)}


def _by_values(model: Any) -> dict[str, Any]:
    import trimesh

    mesh = trimesh.load(read_ground_truth(model.scan).mesh_path, force="mesh")
    points = torch.from_numpy(
        model.S_scene_world.points(trimesh.sample.sample_surface(mesh, 50_000, seed=0)[0])
    ).float()
    with torch.no_grad():
        f, slopes = model.field.sdf_and_gradient(points.to(model.device))
    distance = (f.abs() / slopes.norm(dim=-1).clamp_min(0.1)).sort().values[: len(f) * 4 // 5].cpu()
    distance = distance / model.S_scene_world.scale
    return {
        "rmse_mm": round(float(distance.square().mean().sqrt()), 4),
        "median_mm": round(float(distance.median()), 4),
    }


def _made(config: Config) -> Path:
    from benchmarks.common.runs import made_once
    from sl_nerfstudio.synthesis.config import SynthConfig

    return made_once(SynthConfig(frames=config.frames, resolution=config.resolution), Path("outputs/bench")).scan.root


def describe_device(device: str) -> dict[str, Any]:
    """The machine, the GPU, its driver, and the versions that matter."""
    found: dict[str, Any] = dict(describe())
    found["triton"] = version("triton") if find_spec("triton") is not None else None
    if device == "cuda":
        properties = torch.cuda.get_device_properties(0)
        found |= {"gpu": properties.name, "gpu_mb": properties.total_memory >> 20, "cuda": torch.version.cuda}
        driver = Path("/proc/driver/nvidia/version")
        found["driver"] = driver.read_text().splitlines()[0] if driver.exists() else "unknown"
    return found


def _timed(step: Callable[[], Any], steps: int, device: str) -> dict[str, float]:
    for _ in range(max(3, min(steps, 20))):
        step()
    _wait(device)
    size = max(steps // _GROUPS, 1)
    times = []
    for _ in range(min(_GROUPS, steps)):
        begin = time.perf_counter()
        for _ in range(size):
            step()
        _wait(device)
        times.append((time.perf_counter() - begin) / size * 1e3)
    return {"ms": round(statistics.median(times), 3), "best_ms": round(min(times), 3)}


def _wait(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def _forget_memory(device: str) -> None:
    gc.collect()  # trainings before, which hold themselves
    if device == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def _memory(device: str) -> dict[str, int]:
    if device != "cuda":
        return {}
    return {"peak_mb": torch.cuda.max_memory_allocated() >> 20, "reserved_mb": torch.cuda.max_memory_reserved() >> 20}


if __name__ == "__main__":
    main(parsed(Config, __doc__))
