"""A live scan from its first image to the last: tracking, the folder of kept frames, going on after an interruption.

What is needed to go on is on disk after every image: the same images give the same scan, however often the session was
interrupted. Kept frames are a folder of captures like any other.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.capture.camera import CaptureFolder
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.live.next_view import NextView, next_view
from sl_nerfstudio.live.sight import Eye, Sight
from sl_nerfstudio.live.sources import Shot, Source, require_size
from sl_nerfstudio.live.tracker import Kept, Model, Placed, Tracker, TrackerState
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.processing.config import FEWEST_FRAMES
from sl_nerfstudio.processing.records import DecodedStore, decode, encode
from sl_nerfstudio.registration.evidence import Commonness, Frame
from sl_nerfstudio.registration.pairs import PairMatch, Rival
from sl_nerfstudio.registration.surfaces import FrameCloud
from sl_nerfstudio.relative_pose.estimation import Degeneracy, RelativePose
from sl_nerfstudio.storage import read_checked, write_checked

STATE = "state.npz"
VERSION = 1  # of the files


@dataclass(frozen=True)
class Row:
    """What became of one image."""

    name: str  # in the source
    state: str
    cause: str  # "": tracked
    kept: int  # number among the kept frames; -1: not kept
    anchor: int  # the kept frame by which its place is known; -1: none
    seconds: float  # from the image to the updated model
    sigma_rotation_deg: float
    sigma_position: float  # in the unit of the model
    S_anchor_camera: Similarity | None


@dataclass(frozen=True)
class KeptFile:
    """A kept frame on disk."""

    cloud: FrameCloud
    sigma_position: float
    matches: tuple[PairMatch, ...]


@dataclass(frozen=True)
class SessionState:
    """All that changes from image to image."""

    version: int
    rows: tuple[Row, ...]
    tracker: TrackerState
    factor: float  # at which images are decoded


_CLASSES = (
    SessionState, Row, KeptFile, TrackerState, Similarity, FrameCloud, RelativePose, Degeneracy, Device, PairMatch,
    Rival, Commonness,
)  # fmt: skip


@dataclass(frozen=True)
class Update:
    """One image, what it shows, where it was taken, and what is there now."""

    sight: Sight
    placed: Placed
    row: Row
    rows: Sequence[Row]
    model: Model
    next_view: NextView | None


Watch = Callable[[Update], None]


@dataclass
class Session:
    """Takes images and keeps those that add something. Use it as a context: it holds its folders."""

    root: Path  # of captures/ and of what is needed to go on
    decoder: NetworkDecoder
    camera: Device
    projector: Device
    work: Path | None = None  # of sl-process, which finds there what was decoded at full size
    seed: int = 0
    rows: list[Row] = field(default_factory=list)

    def __enter__(self) -> "Session":
        size = self.camera.w, self.camera.h
        self.tracker = Tracker(self.seed)
        self._eye = Eye(self.decoder, self.camera, self.projector, self.seed)
        self._next: NextView | None = None
        self._folder = CaptureFolder(self.captures, self.decoder.layout, size).__enter__()
        try:
            self._resume()
        except BaseException as error:
            self._folder.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self._folder.__exit__(None, None, None)

    @property
    def captures(self) -> Path:
        """The folder of the kept frames."""
        return self.root / "captures"

    @property
    def poses(self) -> Float64[ndarray, "n 4 4"]:
        """Camera poses of all images (`T_world_camera`), by the kept frame that each was placed with; NaN: unknown."""
        out = np.full((len(self.rows), 4, 4), np.nan)
        for k, row in enumerate(self.rows):
            if row.S_anchor_camera is not None and row.anchor in self.tracker.model.nodes:
                out[k] = (self.tracker.model.nodes[row.anchor] @ row.S_anchor_camera).poses(np.eye(4))
        return out

    def run(self, source: Source, watch: Watch, stopped: Callable[[], bool] = lambda: False) -> None:
        """Take all images of a source, until it ends or is stopped."""
        for shot in source.shots([row.name for row in self.rows]):
            if stopped():
                break
            if shot is not None:
                require_size(shot, (self.camera.w, self.camera.h), source.name)
                self.take(shot, watch)

    def take(self, shot: Shot, watch: Watch) -> Row:
        """Place one image, keep it if it adds something, and say so before anything else is done."""
        begun = time.monotonic()
        sight = self._eye.look(shot.image)
        before = self.tracker.model
        placed = self.tracker.place(sight)
        restarted = self.tracker.model is not before
        number = self.tracker.keep(sight, placed) if placed.adds and sight.sharp else -1
        model = self.tracker.model
        if number >= 0:
            self._next = next_view(model)
            anchor, S_anchor_camera = number, Similarity.identity()
        else:
            anchor, S_anchor_camera = placed.anchor, placed.S_anchor_camera
        row = Row(
            shot.name, placed.state.value, "" if placed.cause is None else placed.cause.value, number, anchor,
            time.monotonic() - begun, placed.sigma_rotation_deg, placed.sigma_position, S_anchor_camera,
        )  # fmt: skip
        if restarted:  # places relative to the model that was given up mean nothing
            self.rows = [replace(r, anchor=-1, S_anchor_camera=None, kept=-1) for r in self.rows]
        self.rows.append(row)
        watch(Update(sight, placed, row, self.rows, model, self._next))
        if number >= 0:
            self._keep(sight, placed, number)
        self._note()
        return row

    def require_enough(self) -> None:
        """Raise UserError if too few frames were kept for a scan."""
        if len(self._folder.frames) < FEWEST_FRAMES:
            found: dict[str, int] = {}
            for row in self.rows:
                found[row.cause or "placed"] = found.get(row.cause or "placed", 0) + 1
            seen = ", ".join(f"{count} {cause}" for cause, count in sorted(found.items(), key=lambda x: -x[1]))
            raise UserError(
                f"{self.captures}: {len(self._folder.frames)} frames were kept, a scan needs {FEWEST_FRAMES}\n"
                f"    cause:  of {len(self.rows)} images: {seen or 'none came'}\n"
                "    remedy: walk slowly around the object, with the pattern in view and in focus; the same command "
                "goes on"
            )

    # ---- on disk

    def _keep(self, sight: Sight, placed: Placed, number: int) -> None:
        assert sight.cloud is not None
        kept = self.tracker.model.kept[number]
        content = encode(KeptFile(sight.cloud, kept.sigma_position, placed.matches))
        write_checked(self._kept_path(number), content)
        for path in self._folder.frames[number:]:
            path.unlink()  # of a model that was given up
        path = self._folder.add(sight.image)
        if sight.first is not None and self.work is not None:
            frame = CapturedFrame(path.stem, (path,))
            store = DecodedStore(self.work, self.decoder.key)
            with one_library_thread():
                store.save(frame, store.key(frame), self.decoder.images.finished(sight.first), sight.image)

    def _note(self) -> None:
        state = SessionState(VERSION, tuple(self.rows), self.tracker.state, self._eye.factor)
        write_checked(self.root / STATE, encode(state))

    def _kept_path(self, number: int) -> Path:
        return self.root / f"kept-{number:04d}.npz"

    def _resume(self) -> None:
        """Take up what an earlier run left. Frames that were written after the last note come again."""
        content = read_checked(self.root / STATE)
        if content is None:
            if self._folder.frames:
                raise self._damaged(self.root / STATE)
            return
        try:
            state: SessionState = decode(content, _CLASSES)
            count = len(state.tracker.nodes)
            files = [self._kept_file(number) for number in range(count)]
        except (KeyError, ValueError, TypeError) as error:
            raise self._damaged(self.root / STATE) from error
        if state.version != VERSION or len(self._folder.frames) < count:
            raise self._damaged(self.captures)
        for path in self._folder.frames[count:]:
            path.unlink()
        self.rows = list(state.rows)
        self._eye.factor = state.factor
        frames = [Frame.of(file.cloud) for file in files]
        kept = [
            Kept(f, file.cloud.pose.T_camera_projector, file.sigma_position)
            for f, file in zip(frames, files, strict=True)
        ]
        self.tracker.resume(state.tracker, kept, [file.matches for file in files])
        if count:
            self._next = next_view(self.tracker.model)

    def _kept_file(self, number: int) -> KeptFile:
        content = read_checked(self._kept_path(number))
        if content is None:
            raise self._damaged(self._kept_path(number))
        return decode(content, _CLASSES)

    @staticmethod
    def _damaged(path: Path) -> UserError:
        return UserError(
            f"{path}: is missing, damaged, or of another version\n    cause:  files of the live scan were removed or "
            "changed\n    remedy: give another --output; or give the folder captures/ to sl-scan without --live"
        )


def open_session(root: Path, source: Source, pattern: Path, intrinsics: Path, work: Path | None = None) -> Session:
    """A session for the images of a source, with the devices that files describe; they tell the images' size.

    Raises UserError for files that do not fit.
    """
    layout = read_layout(pattern)
    if not isinstance(layout, GridPattern):
        raise UserError(
            f"{pattern}: is no coded grid\n"
            "    cause:  --live places single images, and Gray code needs several of each\n"
            "    remedy: project a coded grid (sl-pattern --kind grid); or capture the sequences with sl-capture"
        )
    camera = read_device_file(intrinsics, "camera", source.size)
    projector = read_device_file(intrinsics, "projector", (layout.w, layout.h))
    return Session(root, NetworkDecoder(layout), camera, projector, work)
