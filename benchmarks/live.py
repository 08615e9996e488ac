"""Live scans from videos of walks around an object: what is kept, how long a frame takes, and how far poses are off.

    python -m benchmarks.live [--walks round lost jolted] [--scene head] [--full] [--folder FOLDER] [--output FILE]

Each walk is rendered as a video of 640 x 480 pixels (kept in FOLDER for the next run) and given to the tracker, image
by image, as a camera would. Poses are compared with the truth after the similarity that fits all camera centres best:
a scan without a known length has no unit. With --full, the kept frames also go through `sl-process`.
"""

import argparse
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from benchmarks.common.measuring import options, write_rows
from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.capture.camera import Video
from sl_nerfstudio.cli.process import process_photographs
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses, fit_similarity
from sl_nerfstudio.live.session import Session
from sl_nerfstudio.live.sources import CameraSource
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.write import encode_intrinsics
from sl_nerfstudio.storage import write_atomic
from sl_nerfstudio.synthesis.appearance import Appearance, make_appearance
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DISTANCE, DevicePair, disturb_image, make_devices, make_paths
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, above_the_table, make_surroundings, render_capture
from sl_nerfstudio.synthesis.scenes import make_scene
from sl_nerfstudio.synthesis.synthesise import GAIN

# Walks: which place of a lap each image of the video is taken from, and what disturbs it.

LAP = 40  # places of a walk once around the object: 9 degrees apart
FRAMES_A_SECOND = 2.0  # of the videos
_SIZE = 640, 480
_NOISE = 0.012
_AWAY = Rotation.from_rotvec([0.0, np.radians(35.0), 0.0])  # the camera looks past the object
_JOLT_DEG = 7.0  # by which a jolted projector is turned about the object


@dataclass(frozen=True)
class Step:
    """One image of a walk."""

    place: int  # along the lap
    blur_px: float = 0.0  # length of a motion while it was exposed
    away: bool = False  # the object is out of view
    jolts: int = 0  # of the projector so far


def _pause(place: int, count: int, **how: float) -> list[Step]:
    return [Step(place, **how) for _ in range(count)]  # pyright: ignore[reportArgumentType]


def _round() -> list[Step]:
    """Once around, with two pauses and a few blurred images."""
    steps = [Step(k, blur_px=14.0 if k % 13 == 6 else 0.0) for k in range(LAP)]
    return steps[:12] + _pause(12, 3) + steps[12:25] + _pause(25, 3) + steps[25:]


def _lost() -> list[Step]:
    """The object is lost twice: found where it was lost, and found far back where the walk had been before."""
    there = [Step(k) for k in range(14)] + [Step(14, away=True)] * 3 + [Step(k) for k in range(15, 27)]
    return there + [Step(26, blur_px=30.0)] * 2 + [Step(26, away=True)] * 3 + [Step(k) for k in range(4, 9)]


def _jolted() -> list[Step]:
    """The projector is jolted twice, once while the camera stands still."""
    steps = [Step(k, jolts=int(k >= 9)) for k in range(20)]
    return steps + _pause(19, 2, jolts=2) + [Step(k, jolts=2) for k in range(20, 30)]


WALKS = {"round": _round, "lost": _lost, "jolted": _jolted}


@dataclass(frozen=True)
class Recording:
    """A video, the files that sl-scan needs with it, and the truth of every image."""

    folder: Path
    steps: tuple[Step, ...]
    truth: DevicePoses  # millimetres

    @property
    def video(self) -> Path:
        """The video."""
        return self.folder / "walk.avi"

    @property
    def pattern(self) -> Path:
        """Its pattern.json."""
        return self.folder / "pattern.json"

    @property
    def intrinsics(self) -> Path:
        """The intrinsics of both devices."""
        return self.folder / "intrinsics.json"


class Stage:
    """An object on a table, and two devices that see it from a lap around it."""

    def __init__(self, scene: str, seed: int, size: tuple[int, int] = _SIZE, lap: int = LAP) -> None:
        w, h = size
        config = SynthConfig(scene, background="table", resolution=h, seed=seed)
        self.scene = above_the_table(make_scene(scene, 1.0, seed))
        self.poses = make_paths(self.scene, lap, "hand-held", np.random.default_rng([seed, 1]))
        self.pattern = GridPattern()
        square = make_devices(self.scene, self.poses, (self.pattern.w, self.pattern.h), config)
        wide = replace(square.camera, w=w, h=h, cx=square.camera.cx + (w - h) / 2)
        self.devices = DevicePair(wide, square.projector)
        surroundings = make_surroundings(self.scene, "table", np.random.default_rng([seed, 2]))
        self._caster = RayCaster(self.scene, surroundings)
        self._picture, self._seed = self.pattern.render(), seed
        rng = np.random.default_rng([seed, 3])
        self._appearance: Appearance = make_appearance(self.scene, DISTANCE * self.scene.size, rng)

    def poses_of(self, step: Step) -> tuple[Float64[ndarray, "4 4"], Float64[ndarray, "4 4"]]:
        """`T_world_camera` and `T_world_projector` of an image."""
        T_world_camera, T_world_projector = (
            T[step.place].copy() for T in (self.poses.T_world_camera, self.poses.T_world_projector)
        )
        if step.away:
            T_world_camera[:3, :3] = T_world_camera[:3, :3] @ _AWAY.as_matrix()
        turn = Rotation.from_rotvec([0.0, 0.0, np.radians(_JOLT_DEG * step.jolts)]).as_matrix()
        T_world_projector[:3, :3] = turn @ T_world_projector[:3, :3]
        centre = self.scene.centre
        T_world_projector[:3, 3] = centre + turn @ (T_world_projector[:3, 3] - centre)
        return T_world_camera, T_world_projector

    def image(self, step: Step, number: int, noise: float = _NOISE) -> UInt8[ndarray, "h w"]:
        """The image, grey, with the sensor's noise."""
        geometry = FrameGeometry(self._caster, self.devices, *self.poses_of(step))
        radiance = render_capture(geometry, self._picture, self._appearance, 2).radiance
        if step.blur_px:
            kernel = np.zeros((1, 2 * round(step.blur_px / 2) + 1), dtype=np.float32)
            kernel[:] = 1 / kernel.size
            radiance = np.asarray(cv2.filter2D(radiance, -1, kernel))
        return disturb_image(radiance, GAIN, noise, np.random.default_rng([self._seed, 4, number]))

    def intrinsics(self) -> bytes:
        """The file with the intrinsics of both devices."""
        return encode_intrinsics("mm", self.devices.camera, self.devices.projector)


def record(folder: Path, scene: str, steps: Sequence[Step], seed: int) -> Recording:
    """Render a walk as a video with its files, unless the folder has it."""
    stage = Stage(scene, seed)
    poses = [stage.poses_of(step) for step in steps]
    truth = DevicePoses(np.stack([camera for camera, _ in poses]), np.stack([projector for _, projector in poses]))
    found = Recording(folder, tuple(steps), truth)
    note = repr((scene, seed, steps)).encode()
    done = folder / "walk.txt"
    if done.exists() and done.read_bytes() == note:
        return found
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(found.pattern, stage.pattern.encode())
    write_atomic(found.intrinsics, stage.intrinsics())
    writer = cv2.VideoWriter(str(found.video), cv2.VideoWriter.fourcc(*"MJPG"), FRAMES_A_SECOND, _SIZE)
    for number, step in enumerate(steps):
        writer.write(np.repeat(stage.image(step, number)[..., None], 3, -1))
    writer.release()
    write_atomic(done, note)
    return found


# A session, and its poses against the truth.


@dataclass(frozen=True)
class LiveRow:
    """What one walk gave. Errors are those of the camera: RMS and largest."""

    walk: str
    images: int
    tracked: int
    uncertain: int
    lost: int
    kept: int
    seconds: float  # median of an image, from image to updated model
    slowest: float  # nine of ten are faster
    cpu: float  # seconds of processor time an image, mean: the machine may be shared
    first_half: float  # median seconds an image in the first and in the second half of those that were tracked
    second_half: float
    rotation_deg: tuple[float, float]  # of all tracked images
    position: tuple[float, float]  # millimetres
    wrong: int  # tracked images whose place is off by more than 1 degree or 1 % of the distance
    full_rotation_deg: float | None = None  # RMS of the kept frames after sl-process
    full_position: float | None = None
    kept_rotation_deg: float | None = None  # RMS of the same frames live
    kept_position: float | None = None


def camera_errors(
    T_world_camera: Float64[ndarray, "n 4 4"], truth: Float64[ndarray, "n 4 4"]
) -> tuple[Float64[ndarray, "n"], Float64[ndarray, "n"]]:
    """Degrees and millimetres by which cameras are off, after the similarity that fits their centres best."""
    S = fit_similarity(T_world_camera[:, :3, 3], truth[:, :3, 3])
    aligned = S.poses(T_world_camera)
    turned = Rotation.from_matrix(aligned[:, :3, :3].transpose(0, 2, 1) @ truth[:, :3, :3]).magnitude()
    return np.degrees(turned), np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)


def run_session(recording: Recording, output: Path) -> tuple[Session, float]:
    """Give a video to a new session; returns it with the processor time it took, seconds."""
    shutil.rmtree(output, ignore_errors=True)
    camera, projector = recording_devices(recording)
    decoder = NetworkDecoder(GridPattern())
    source = CameraSource(Video(recording.video))
    begun = time.process_time()
    with Session(output, decoder, camera, projector, output.parent / "scan.work") as session:
        session.run(source, lambda update: None)
    source.close()
    return session, time.process_time() - begun


def recording_devices(recording: Recording) -> tuple[Device, Device]:
    """Camera and projector, as the files of a recording say."""
    pattern = GridPattern()
    return (
        read_device_file(recording.intrinsics, "camera", _SIZE),
        read_device_file(recording.intrinsics, "projector", (pattern.w, pattern.h)),
    )


def measure(walk: str, recording: Recording, output: Path, full: bool) -> LiveRow:
    """One walk."""
    session, cpu = run_session(recording, output)
    rows, poses, truth = session.rows, session.poses, recording.truth.T_world_camera
    state = np.array([row.state for row in rows])
    tracked = (state == "tracked") & np.isfinite(poses).all((1, 2))
    turned, moved = camera_errors(poses[tracked], truth[tracked])
    distance = float(np.median(np.linalg.norm(truth[:, :3, 3], axis=1)))
    seconds = np.array([row.seconds for row in rows])
    halves = [float(np.median(part)) for part in np.array_split(seconds[tracked][3:], 2)]
    found = LiveRow(
        walk, len(rows), int(tracked.sum()), int((state == "uncertain").sum()), int((state == "lost").sum()),
        sum(row.kept >= 0 for row in rows), float(np.median(seconds)), float(np.quantile(seconds, 0.9)),
        cpu / len(rows), halves[0], halves[1], _rms_and_largest(turned), _rms_and_largest(moved),
        int(((turned > 1) | (moved > 0.01 * distance)).sum()),
    )  # fmt: skip
    return _with_full(found, recording, session) if full else found


def _rms_and_largest(errors: Float64[ndarray, "n"]) -> tuple[float, float]:
    return float(np.sqrt((errors**2).mean())), float(errors.max())


def _with_full(found: LiveRow, recording: Recording, session: Session) -> LiveRow:
    """The same with the poses that sl-process gives the kept frames."""
    scan = session.root.parent / "scan"
    shutil.rmtree(scan, ignore_errors=True)
    process_photographs(ProcessConfig(session.captures, recording.pattern, recording.intrinsics, scan, jobs=1))
    frames = {frame.name: frame.T_world_camera for frame in read_scan(scan).frames}
    images = [k for k, row in enumerate(session.rows) if row.kept >= 0]
    both = [(frames[name], k) for n, k in enumerate(images) if (name := f"frame_{n:04d}") in frames]
    T, index = np.stack([np.asarray(T, dtype=np.float64) for T, _ in both]), [k for _, k in both]
    truth = recording.truth.T_world_camera[index]
    full, live = camera_errors(T, truth), camera_errors(session.poses[index], truth)
    rms = [_rms_and_largest(errors)[0] for errors in (*full, *live)]
    return replace(
        found, full_rotation_deg=rms[0], full_position=rms[1], kept_rotation_deg=rms[2], kept_position=rms[3]
    )


def main() -> None:
    """Run the benchmark."""
    config: argparse.Namespace = options(
        __doc__, walks=WALKS, scene="head", seed=0, full=False, folder=Path("outputs/bench/live"), output=Path
    )
    rows: list[LiveRow] = []
    for walk in config.walks:
        folder = config.folder / config.scene / walk
        recording = record(folder / "recording", config.scene, WALKS[walk](), config.seed)
        rows.append(measure(walk, recording, folder / "live", config.full))
        print(rows[-1], flush=True)
        write_rows(config.output, rows, scene=config.scene, seed=config.seed)


if __name__ == "__main__":
    main()
