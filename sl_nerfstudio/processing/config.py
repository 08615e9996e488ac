"""What `sl-process` is asked for; the docstrings of the fields are its help text."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sl_nerfstudio.errors import UserError


@dataclass(frozen=True)
class ProcessConfig:
    """Make a scan folder from photographs. Every length in it is relative unless one is known."""

    images: Path
    """folder of the captures: one image a frame, or for Gray code one sub-folder of images a frame"""
    pattern: Path
    """pattern.json of the pattern that was projected, as sl-pattern or sl-synth wrote it"""
    intrinsics: Path
    """camera, and projector unless it has a file of its own: .json, OpenCV .yml .xml, COLMAP cameras.txt"""
    output: Path
    """scan folder to write; it must be new or empty"""
    projector_intrinsics: Path | None = None
    """file of the projector, where --intrinsics describes the camera alone"""
    projector_model: Literal["OPENCV", "DOE"] | None = None
    """the projector's model, where its file does not say it; default: what the file says, else OPENCV"""
    procam_step: int = 1
    """graycode_step that procam-calibration was run with, if the intrinsics are from there"""
    decoder: Literal["network", "graycode"] | None = None
    """how captures are decoded; default: as the pattern needs it"""
    known_length: str | None = None
    """one true length: "baseline of frame 0 = 85 mm", or "distance between frame 3 (410.5, 200) and frame 7 (35, 80) =
    50 mm" with pixels x, y; without it the scan's unit is arbitrary"""
    unordered: bool = False
    """the frames were not taken one beside the other: every pair is tried"""
    poses: Path | None = None
    """transforms.json with rough camera poses to start from (within 20 degrees); the scan takes over axes and unit"""
    refine_projector_focal: bool = False
    """the projector's focal length is only roughly known: find it from all frames"""
    jobs: int | None = None
    """processes that decode frames side by side; default: one for each core"""
    work: Path | None = None
    """where decoded frames are kept for the next run; default: OUTPUT.work"""
    seed: int = 0
    """of everything random: same captures and flags, same scan"""

    def check(self) -> None:
        """Raise UserError naming the flag if a value makes no sense."""
        rules = (
            (self.jobs is None or self.jobs >= 1, "--jobs", self.jobs, "give at least 1"),
            (self.procam_step >= 1, "--procam-step", self.procam_step, "give at least 1"),
            (self.seed >= 0, "--seed", self.seed, "seeds are at least 0"),
        )
        for holds, flag, value, why in rules:
            if not holds:
                raise UserError(f"{flag} {value}: {why}")

    @property
    def work_folder(self) -> Path:
        """Where decoded frames are kept."""
        return self.work or self.output.with_name(self.output.name + ".work")
