"""A scan decoded again with the surface and the poses of a run that was trained on it, written as a new scan."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.new_folder import NewFolder
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.progress import track
from sl_nerfstudio.redecoding.ambiguity import Ambiguity
from sl_nerfstudio.redecoding.frame import FrameFacts, redecode_frame
from sl_nerfstudio.redecoding.prediction import Surface
from sl_nerfstudio.runs.trained_run import TrainedRun
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.coordinates import encode_coords
from sl_nerfstudio.scan.document import TRANSFORMS, Record, read_document
from sl_nerfstudio.scan.file_error import read_bytes
from sl_nerfstudio.scan.partial_frame import FRAME_FILES
from sl_nerfstudio.scan.writing import encode_json
from sl_nerfstudio.threads import one_library_thread

RECORD = "redecoding.json"


@dataclass(frozen=True)
class RedecodeSettings:
    """Where the new scan goes, and how finely the surface is extracted."""

    output: Path  # a folder that is new or empty
    resolution: int = 256  # cells along each side of the scene's box


@dataclass(frozen=True)
class Redecoded:
    """What became of the frames."""

    frames: tuple[FrameFacts, ...]

    @property
    def share_before(self) -> float:
        """Share of the pixels with the pattern that were decoded."""
        return self._share("decoded_before")

    @property
    def share_after(self) -> float:
        """Share of the pixels with the pattern that are decoded now."""
        return self._share("decoded_after")

    def total(self, name: str) -> int:
        """Sum of one of the frames' numbers."""
        return sum(getattr(frame, name) for frame in self.frames)

    def _share(self, name: str) -> float:
        return self.total(name) / max(self.total("shown"), 1)


@one_library_thread()
def redecode_run(run: TrainedRun, settings: RedecodeSettings) -> Redecoded:
    """Write the scan of a run with coordinates that were decoded again; one frame is in memory at a time.

    All else is copied: images, masks, truth, and the starting poses with their sigma. Those are independent of the
    coordinates, while the refined ones already contain them: as a prior they would count the coordinates twice.
    Raises UserError if the output is not empty, there is no surface, or the scan was changed meanwhile.
    """
    model = run.model
    scan, poses = model.scan, model.poses()
    document = read_document(scan.root / TRANSFORMS)
    with NewFolder(settings.output) as folder:
        surface = Surface(
            extract_mesh(model.sdf, settings.resolution, device=model.device).mapped(model.S_scene_world.inverse())
        )
        pattern = scan.read_pattern()
        ambiguity, facts = Ambiguity.of(pattern), []
        for k, frame in enumerate(track(scan.frames, "decoding again")):
            predicted = surface.predict(
                frame.camera, scan.projector, poses.T_world_camera[k], poses.T_world_projector[k]
            )
            mask = None if frame.mask_path is None else frame.read_mask()
            coords, found = redecode_frame(
                frame.name, frame.read_pattern(), mask, frame.read_coords(), predicted, pattern, ambiguity
            )
            folder.write(_put_coords(document, k, frame.name), encode_coords(coords))
            facts.append(found)
        _copy_others(folder, scan, document)
        result = Redecoded(tuple(facts))
        folder.write(RECORD, encode_json(_record(result)))
        folder.write(TRANSFORMS, encode_json(document), last=True)
    return result


def _put_coords(document: Record, index: int, name: str) -> str:
    """The path of a frame's new coordinates, after it was put into the document."""
    frames = document.get("frames")
    if not isinstance(frames, list) or len(frames) <= index or Path(frames[index]["file_path"]).stem != name:
        raise UserError(
            f"{TRANSFORMS}: has other frames than when it was read\n"
            "    cause:  the file was edited meanwhile\n    remedy: try again"
        )
    frames[index]["sl_coords_path"] = f"coords/{name}.npz"
    return frames[index]["sl_coords_path"]


def _copy_others(folder: NewFolder, scan: Scan, document: Record) -> None:
    """Every file that transforms.json names, except coordinates; the truth; and descriptions (JSON) beside them."""
    keys = [key for key in FRAME_FILES if key != "sl_coords_path"]
    named = [document["projector"]["pattern_path"]]
    named += [record[key] for record in document["frames"] for key in keys if record.get(key)]
    truth = sorted(path for path in (scan.root / "ground_truth").rglob("*") if path.is_file())
    beside = sorted(path for path in scan.root.glob("*.json") if path.name not in (TRANSFORMS, RECORD))
    others = [path.relative_to(scan.root).as_posix() for path in (*truth, *beside)]
    for path in track(dict.fromkeys([*named, *others]), "copying"):
        folder.write(path, read_bytes(scan.root / path))


def _record(result: Redecoded) -> dict:
    return {
        "share_before": result.share_before,
        "share_after": result.share_after,
        "frames": [dataclasses.asdict(frame) for frame in result.frames],
    }
