"""Our methods, the paper's, and fusion, run on a scan of the benchmark; results as anybody hands them in."""

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.baselines.poses import refined_poses, register
from benchmarks.baselines.tsdf import fuse
from benchmarks.common.runs import export, process, train
from benchmarks.open.scans import OpenScan
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import write_mesh
from sl_nerfstudio.scan import Scan, read_scan, write_transforms
from sl_nerfstudio.storage import write_atomic

RECORD = "method.json"


@dataclass(frozen=True)
class Job:
    """One method on one scan."""

    scan: OpenScan
    method: str
    data: Path
    folder: Path  # where the result goes
    steps: int | None  # of training; None: what the method recommends


def hand_in(job: Job) -> float:
    """Run a method, record how many seconds it took, and return them. Ends the program if one of its commands fails."""
    begin = time.monotonic()
    work = job.folder / "work"
    work.mkdir(parents=True)
    (_fused if job.method in FUSIONS else _trained)(job, work)
    shutil.rmtree(work)
    seconds = time.monotonic() - begin
    record = {"method": job.method, "steps": job.steps, "seconds": seconds}
    write_atomic(job.folder / RECORD, (json.dumps(record, indent=1) + "\n").encode())
    return seconds


def _scan_folder(job: Job, work: Path, adjusted: bool) -> Path:
    """The scan folder; of photographs the one that sl-process makes, with or without the joint adjustment."""
    root = job.data / job.scan.name
    if not job.scan.photographs:
        return root
    fault = process(root, work / "scan", work / "scan.work", 1, *(() if adjusted else ("--no-adjust",)))
    if fault:
        raise UserError(f"{root}: sl-process made no scan\n{fault}")
    return work / "scan"


def _trained(job: Job, work: Path) -> None:
    data, poses = _scan_folder(job, work, adjusted=job.method == "sl-neus"), work / "poses"
    steps = () if job.steps is None else ("--max-num-iterations", job.steps)
    export(train(data, work, "now", steps, job.method), job.folder / "mesh.ply", poses)
    shutil.copyfile(poses / "transforms.json", job.folder / "transforms.json")


def _fused(job: Job, work: Path) -> None:
    scan = read_scan(_scan_folder(job, work, adjusted=job.method == "fusion-refined"))
    poses = FUSIONS[job.method](scan)
    write_mesh(job.folder / "mesh.ply", fuse(scan, poses))
    write_transforms(job.folder / "transforms.json", scan, poses)


FUSIONS: dict[str, Callable[[Scan], DevicePoses]] = {
    "fusion-start": lambda scan: scan.poses,
    "fusion-icp": lambda scan: register(scan, scan.poses),
    "fusion-refined": refined_poses,
}
METHODS = ("sl-neus", "sl-neus-paper", *FUSIONS)
