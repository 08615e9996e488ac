"""sl-scan: from photographs, or a scan folder, to a judged mesh, in one folder and as often as anything changes."""

import hashlib
import json
import os
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sl_nerfstudio.cli.arguments import PHOTOGRAPHS, flag_name, given_flags, parse
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import command, duration, next_steps, paragraph, phase, say, short_path
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from sl_nerfstudio.model.preview import Preview
    from sl_nerfstudio.processing.config import ProcessConfig
    from sl_nerfstudio.scan import Scan


@dataclass(frozen=True)
class ScanConfig:
    """From photographs to a mesh with a verdict: process, train, export and evaluate, all in one folder.

    The same command again goes on where it was stopped, and does again only what other flags change: a length that is
    added later takes no training. With a scan folder in place of the photographs, it begins with the training.
    """

    photographs: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOGRAPHS|SCAN")] = None
    """folder of the photographs, one for each frame or one sub-folder for each Gray-code sequence; a video; or a scan
    folder, which holds transforms.json; none with --live"""
    output: Path = tyro.MISSING
    """folder for all results: a new one, or one that this command has begun"""
    pattern: Path | None = None
    """pattern.json of the projected pattern, as written by sl-pattern or sl-synth; needed for photographs"""
    intrinsics: Path | None = None
    """intrinsics of both devices, from sl-calibrate or another program"""
    rig: Literal["free", "rigid", "static-projector"] = "free"
    """how the devices moved: each by itself, both fixed to each other, or only the camera"""
    known_length: str | None = None
    """one true length: "baseline of frame 0 = 85 mm", or "distance between frame 3 (410.5, 200) and frame 7 (35, 80) =
    50 mm" with pixels x, y of the photographs; without it, the unit is arbitrary"""
    object_only: bool = False
    """leave out the plane that the object stands on, walls, and what is not connected to the object"""
    masks: Path | None = None
    """folder with one mask for each frame, named like the frame: white is used, black is not"""
    color: Path | None = None
    """folder with photographs without the pattern, each from the same place as the frame that it is named like"""
    full_size: bool = False
    """decode every pixel of the photographs; otherwise large ones are shrunk as they are read"""
    quality: Literal["draft", "normal", "fine"] = "normal"
    """draft: a fifth of the training and coarse cells; fine: three times the training and finer cells"""
    preview: bool = False
    """show in a browser what has been found so far: cameras, projectors and points, then the surface as it trains"""
    live: bool = False
    """scan with a live model: each image of --camera is placed at once, kept if it adds something, and shown on a page
    that says where to go next; then everything as with photographs"""
    camera: str | None = None
    """for --live: number of the camera (0 is the first), a video file, or a folder that fills up"""
    share: bool = False
    """let others in the network open the page of --live or --preview, such as a telephone"""

    @property
    def is_scan(self) -> bool:
        """Whether a scan folder is given instead of photographs."""
        return (self.captures / "transforms.json").is_file()

    @property
    def captures(self) -> Path:
        """What the scan is made from: the given folder or video, or the frames that a live scan keeps."""
        return self.output / LIVE / "captures" if self.photographs is None else self.photographs

    @property
    def words(self) -> list[str]:
        """The words of this command, to copy and for the record; without `--preview`, on which no result depends."""
        photographs = [] if self.photographs is None else [str(self.photographs)]
        return ["sl-scan", *photographs, *given_flags(self, without=("photographs", "preview", "share"))]

    @property
    def better(self) -> "ScanConfig | None":
        """The same with the next quality; None for the finest."""
        names = list(_STEPS)
        following = names[names.index(self.quality) + 1 :]
        return replace(self, quality=following[0]) if following else None

    def check(self) -> None:
        """Raise UserError for flags that do not belong together."""
        self._check_live()
        if self.is_scan:
            names = ("pattern", "intrinsics", "known_length", "masks", "color")
            given = [flag_name(name) for name in names if getattr(self, name) is not None]
            given += ["--full-size"] if self.full_size else []
            if given:
                raise UserError(
                    f"{', '.join(given)}: {self.captures} is a scan folder, which states all of that itself\n"
                    "    cause:  these flags are for photographs\n"
                    "    remedy: leave them out, or give the folder of the photographs"
                )
        elif self.pattern is None:
            raise UserError(
                f"--pattern: is missing\n    cause:  {self.captures} has no transforms.json, so it is taken for "
                "photographs\n    remedy: give the pattern.json of what was projected; or give a scan folder"
            )
        outer, inner = (os.path.realpath(path) for path in (self.captures, self.output))
        if os.path.commonpath([outer, inner]) == outer:
            raise UserError(
                f"--output {self.output}: is in {self.captures}, and would become one of the captures\n"
                f"    remedy: give a folder outside of it, such as {Path(outer).parent / 'result'}"
            )

    def _check_live(self) -> None:
        """Raise UserError for flags that a live scan lacks, or that have no meaning for it."""
        if not self.live:
            if self.photographs is None:
                raise UserError(
                    "no photographs are given\n"
                    "    cause:  the first word is missing: a folder, a video or a scan folder\n"
                    "    remedy: give one; or --live with --camera, to scan with a camera"
                )
            if self.camera is not None:
                raise UserError(f"--camera {self.camera}: is for --live; give both, or the photographs alone")
        elif self.photographs is not None:
            raise UserError(
                f"--live: {self.photographs} is given as well\n"
                "    cause:  a live scan takes its images from --camera\n"
                f"    remedy: give --camera {self.photographs} for a video or a folder that fills up; or no --live"
            )
        else:
            for name in ("camera", "pattern", "intrinsics"):
                if getattr(self, name) is None:
                    raise UserError(
                        f"{flag_name(name)}: is missing\n"
                        "    cause:  --live needs to know where images come from, what is projected, and both devices\n"
                        f"    remedy: give {flag_name(name)}"
                    )
            for name in ("masks", "color"):
                if getattr(self, name) is not None:
                    raise UserError(
                        f"{flag_name(name)}: is named like the frames, which --live has yet to choose\n"
                        f"    remedy: leave it out; later give {self.captures} without --live, and {flag_name(name)}"
                    )
        if self.share and not (self.live or self.preview):
            raise UserError("--share: there is no page to share; give --live or --preview as well")

    def processing(self) -> "ProcessConfig":
        """What sl-process is asked for."""
        from sl_nerfstudio.processing.config import ProcessConfig

        assert self.pattern is not None
        return ProcessConfig(
            self.captures, self.pattern, self.intrinsics, self.output / "scan", known_length=self.known_length,
            rig=self.rig, masks=self.masks, object_only=self.object_only, color=self.color,
            full_size=self.full_size,
        )  # fmt: skip


_INPUTS = {"photographs": "give the folder with the photographs, or a scan folder", **PHOTOGRAPHS}
_GROUPS = {
    "photographs": ("pattern", "intrinsics", "known_length", "masks", "color", "full_size"),
    "the scan": ("rig", "object_only", "quality"),
    "a live scan": ("live", "camera"),
    "this run": ("preview", "share"),
}
LIVE = "live"  # folder of a live scan, in the output
_STEPS = {"draft": 200, "normal": 1000, "fine": 3000}  # of the training
_CELLS = {"draft": 256, "normal": 512, "fine": 768}  # along each side of the scene's box
_REFINED = {"free": "free", "rigid": "rigid-rig", "static-projector": "static-projector"}


# What has been done: a small file in the output that names, for each stage, what its result was made from.

RECORD = "sl-scan.json"
_RESULTS = ("mesh.ply", "mesh.glb", "poses/transforms.json", "poses/training.json", "poses/pose_covariance.npz")
_JUDGED = ("evaluation.json", "report.html")


class Progress:
    """The stages that are complete in an output folder, and the files that they wrote there."""

    def __init__(self, root: Path) -> None:
        """Read the record. Raises UserError for a folder with other things in it, or with a damaged record."""
        from sl_nerfstudio.storage import LOCK

        self.root, self._path = root, root / RECORD
        self.stages: dict[str, str] = {}  # key of what a stage was made from
        self.files: dict[str, str] = {}  # SHA-256 of each result; "" while it is being written
        others = sorted(set(os.listdir(root)) - {LOCK})
        if others and RECORD not in others:
            raise UserError(
                f"--output {root}: is not empty (it holds {others[0]}), and sl-scan did not make it\n"
                "    cause:  the folder is used for something else\n    remedy: give a new folder"
            )
        if others:
            try:
                found = json.loads(self._path.read_bytes())
                self.stages, self.files = dict(found["stages"]), dict(found["files"])
            except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
                raise UserError(
                    f"{self._path}: cannot be read\n    cause:  the file was edited or damaged\n"
                    "    remedy: give a new folder with --output; sl-process finds again what was decoded"
                ) from error

    def is_done(self, stage: str, key: str, results: tuple[str, ...]) -> bool:
        """Whether the stage is complete for the same inputs, and its results are there."""
        return self.stages.get(stage) == key and all((self.root / name).exists() for name in results)

    @contextmanager
    def making(self, stage: str, key: str, results: tuple[str, ...] = ()) -> Iterator[None]:
        """Note that a stage begins, and, unless it fails, that it is complete.

        Raises UserError if one of its results is there, but not as it was written.
        """
        changed = [name for name in results if self._is_anothers(name)]
        if changed:
            raise UserError(
                f"{', '.join(str(self.root / name) for name in changed)}: would be overwritten\n"
                "    cause:  it was changed or made by another program, not by sl-scan\n"
                "    remedy: move it to another folder, and run the same command again"
            )
        self.stages.pop(stage, None)
        self.files |= dict.fromkeys(results, "")
        self._write()
        yield
        self.stages[stage] = key
        self.files |= {name: _digest(self.root / name) for name in results}
        self._write()

    def _is_anothers(self, name: str) -> bool:
        path = self.root / name
        return path.exists() and self.files.get(name) != "" and _digest(path) != self.files.get(name)

    def _write(self) -> None:
        from sl_nerfstudio.storage import write_atomic

        document = {"stages": self.stages, "files": self.files}
        write_atomic(self._path, json.dumps(document, indent=2).encode() + b"\n")


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else ""


def _key(*parts: object) -> str:
    """Digest of what a stage depends on, this version among it."""
    from sl_nerfstudio import __version__

    return hashlib.sha256(repr((__version__, parts)).encode()).hexdigest()


def _state_of(path: Path | None) -> list[tuple[str, int, int]]:
    """Name, size and time of a file, or of all files below a folder: enough to see that something was changed."""
    if path is None or not path.exists():
        return []
    paths = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    return [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in paths]


# The stages. Each calls what its own command calls, and imports it when it is its turn.

_DOING = {  # as the preview says it
    "live": "scanning",
    "process": "reading, decoding and registering the photographs",
    "train": "preparing the training",
    "export": "exporting mesh and poses",
    "evaluate": "judging them",
}


@dataclass(frozen=True)
class Work:
    """The stages of one command in its output folder."""

    config: ScanConfig
    done: Progress
    preview: "Preview | None" = None

    @property
    def scan_root(self) -> Path:
        """The scan folder: the given one, or that made of the photographs."""
        return Path(os.path.abspath(self.config.captures if self.config.is_scan else self.config.output / "scan"))

    def begin(self, stage: str) -> None:
        """Say that a stage is no longer as it was, and is made."""
        say(f"-- {stage} --")
        if self.preview is not None:
            self.preview.say(_DOING[stage])

    def scan_live(self) -> None:
        """Take the images of a camera until they end, unless that was done before."""
        config, folder = self.config, self.config.output / LIVE
        assert config.camera is not None and config.pattern is not None and config.intrinsics is not None
        key = _key(config.camera, _state_of(config.pattern), _state_of(config.intrinsics))
        if self.done.is_done("live", key, (f"{LIVE}/captures",)):
            return say(_kept("live", config.captures))
        self.begin("live")
        assert self.preview is not None
        with phase("start"):
            from sl_nerfstudio.live.page import Console, LivePage
            from sl_nerfstudio.live.session import open_session
            from sl_nerfstudio.live.sources import open_source
        with self.done.making("live", key):
            source = open_source(config.camera)
            work = config.processing().work_folder
            try:
                with open_session(folder, source, config.pattern, config.intrinsics, work) as session:
                    console = Console(say, len(session.rows))
                    with LivePage(self.preview, session.camera, session.projector) as page:
                        session.run(source, lambda update: (page.show(update), console.show(update))[0], page.stopped)
                    session.require_enough()
            finally:
                source.close()
            say(console.summary(session.rows))

    def process(self) -> None:
        """Make the scan folder, unless it was made of the same photographs with the same flags."""
        config = self.config.processing()
        paths = (config.images, config.pattern, config.intrinsics, config.masks, config.color)
        key = _key(replace(config, output=Path()), [_state_of(path) for path in paths])
        if self.done.is_done("process", key, ("scan/transforms.json",)):
            return say(_kept("process", config.output))
        self.begin("process")
        from sl_nerfstudio.cli.process import findings, process_photographs

        with self.done.making("process", key):
            result = process_photographs(config, self.preview and self.preview.registered)
            print(findings(result, " on the photographs"))

    @cached_property
    def scan(self) -> "Scan":
        """What the scan folder holds."""
        from sl_nerfstudio.scan import read_scan

        return read_scan(self.scan_root)

    def train(self) -> Path:
        """Train, or go on with a training that was stopped; returns the config.yml of the run.

        A run is found by what it was trained on, so flags that were tried before need no other training.
        """
        refined, output = _REFINED[self.config.rig], Path(os.path.abspath(self.config.output))
        quality, steps, runs = self.config.quality, _STEPS[self.config.quality], output / "training" / "sl-neus"
        key = _key(output, _state_of(self.scan_root), refined, steps)
        trained = sorted(runs.glob(f"*-{self.done.stages.get('run')}/config.yml"))
        if self.done.is_done("train", key, ()) and trained:
            say(_kept("train", trained[0].parent))
            return trained[0]
        with phase("start"):
            from sl_nerfstudio.late_imports import compiler_on_demand

            with compiler_on_demand(stays_out=True):
                from sl_nerfstudio.model.run_files import read_checkpoint
                from sl_nerfstudio.model.train import settings_of_run, train_within
                from sl_nerfstudio.runs.other_length import follow_scan, training_key
                from sl_nerfstudio.runs.run import last_checkpoint

        digest = _key(training_key(self.scan), refined, steps)[:12]
        path = runs / f"{quality}-{digest}" / "config.yml"
        with self.done.making("train", key):
            if path.exists() and any(path.parent.glob("nerfstudio_models/*.ckpt")):
                with phase("read"):
                    config = follow_scan(path, self.scan_root, output)
                complete = read_checkpoint(last_checkpoint(config, path)).step >= config.last_step
            else:
                shutil.rmtree(path.parent, ignore_errors=True)  # stopped before it had saved anything
                config = settings_of_run("sl-neus", self.scan_root, output, "training", path.parent.name, steps)
                config.pipeline.model.refine_poses = refined
                complete = False
            if complete:
                say(_kept("train", path.parent))
            else:
                self.begin("train")
                train_within(shlex.join(self.config.words), config, self.preview and self.preview.trained)
            self.done.stages["run"] = digest
        return path

    def export(self, run_config: Path) -> str:
        """Write mesh and poses of the run, unless they are there; returns the key of this stage."""
        cells, only = _CELLS[self.config.quality], self.config.object_only and self.config.is_scan
        key = _key(_state_of(run_config.parent / "nerfstudio_models"), _state_of(self.scan_root), cells, only)
        if self.done.is_done("export", key, _RESULTS[:3]):
            say(_kept("export", self.config.output / "mesh.ply"))
            return key
        self.begin("export")
        from sl_nerfstudio.cli.export import ExportConfig, description, export_trained
        from sl_nerfstudio.cli.run import load_run
        from sl_nerfstudio.meshing.files import write_mesh
        from sl_nerfstudio.model.run_files import part_of

        root, better = self.config.output, self.config.better
        flags = ExportConfig(
            run_config, root / "mesh.ply", root / "poses", resolution=cells, object_only=only, overwrite=True
        )
        with self.done.making("export", key, _RESULTS):
            with phase("load"):
                trained = load_run(run_config, self.scan_root)
            with phase("export"), part_of(shlex.join(better.words)) if better else nullcontext():
                exported = export_trained(trained, flags)
                write_mesh(root / "mesh.glb", exported.mesh, exported.properties, self.scan.units, None)
            print(description(flags, trained.model.scan, exported))
        return key

    def evaluate(self, exported: str) -> None:
        """Judge mesh and poses, and write the report, unless it is there; says the verdict."""
        root = self.config.output
        key = _key(exported, _state_of(self.scan_root / "ground_truth"))
        if self.done.is_done("evaluate", key, _JUDGED):
            say(_kept("evaluate", root / "report.html"))
            verdict = json.loads((root / "evaluation.json").read_bytes())
            return print("\n".join([f"verdict: {verdict['verdict']}", *(f"  {why}" for why in verdict["reasons"])]))
        self.begin("evaluate")
        from sl_nerfstudio.cli.evaluate import EvalConfig, evaluate_scan

        mesh, poses, json_path, report = (root / name for name in ("mesh.ply", _RESULTS[2], *_JUDGED))
        with self.done.making("evaluate", key, _JUDGED):
            evaluate_scan(EvalConfig(mesh, self.scan_root, poses, json=json_path, report=report))


def _kept(stage: str, where: Path) -> str:
    return f"-- {stage}: as before, in {short_path(where)}"


def scan_photographs(config: ScanConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    config.check()
    import time

    from sl_nerfstudio.storage import locked

    begun = time.monotonic()
    with locked(config.output), ExitStack() as stack:
        done = Progress(config.output)
        shown = config.preview or config.live
        work = Work(config, done, stack.enter_context(_opened_preview(config)) if shown else None)
        if config.live:
            work.scan_live()
        if not config.is_scan:
            work.process()
        run_config = work.train()
        work.evaluate(work.export(run_config))
    print(_closing(config, run_config, work.scan, time.monotonic() - begun))


def _opened_preview(config: ScanConfig) -> "Preview":
    with phase("start"):
        from sl_nerfstudio.model.preview import Preview

    preview = Preview(config.output.name if config.live else config.captures.name, config.share)
    print(paragraph("preview", preview.where), flush=True)
    return preview


def _closing(config: ScanConfig, run_config: Path, scan: "Scan", seconds: float) -> str:
    """Where everything is, and what to do next."""
    root = config.output
    results: Mapping[str, str] = {
        "report": f"{root / 'report.html'} (open it in a browser)",
        "surface": f"{root / 'mesh.ply'}, {root / 'mesh.glb'}",
        "poses": f"{root / _RESULTS[2]}",
        "took": duration(seconds),
    }
    steps = [command("ns-viewer", "--load-config", short_path(run_config), "--viewer.websocket-host", "127.0.0.1")]
    if not (config.is_scan or scan.scale.known):
        length = f"baseline of frame {scan.frames[0].name} = 85 mm"
        steps.insert(0, command(*config.words, "--known-length", length))
        steps.insert(1, "    (with the length that you measure; this takes no training)")
    return "\n".join([*(f"{name:<12}{text}" for name, text in results.items()), next_steps(steps)])


def _main() -> None:
    config = parse(ScanConfig, "sl-scan", _INPUTS, _GROUPS)
    try:
        scan_photographs(config)
    except KeyboardInterrupt:
        print(f"to go on: {shlex.join(config.words)}", file=sys.stderr)
        raise


def main() -> None:
    """Entry point of the command."""
    run(_main)


if __name__ == "__main__":
    main()
