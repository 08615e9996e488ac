"""The flags of `sl-process`; the docstrings of the fields are their help text."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.layout import SequenceName

Rig = Literal["free", "rigid", "static-projector"]
FEWEST_FRAMES = 2  # of a scan


@dataclass(frozen=True)
class ProcessConfig:
    """Make a scan folder from photographs. Without a known length, its unit is arbitrary."""

    images: Path
    """folder of the captures: one image per frame, or for Gray code one sub-folder of images per frame; or a video, of
    which the sharp frames are taken"""
    pattern: Path
    """pattern.json of the projected pattern, as written by sl-pattern or sl-synth; for the Gray code of another program
    the projector's resolution, as 1024x768"""
    intrinsics: Path | None = None
    """intrinsics of the camera, usually of both devices: .json, OpenCV .yml .xml, COLMAP cameras.txt; without those of
    the camera, its focal length comes from the photographs' EXIF data, and is refined"""
    output: Path = tyro.MISSING
    """scan folder to write: new or empty, or the scan that this command made of the same captures, which is renewed"""
    projector_intrinsics: Path | None = None
    """file of the projector, if --intrinsics describes only the camera"""
    projector_model: Literal["OPENCV", "DOE"] | None = None
    """model of the projector, if its file does not state it; default: what the file states, otherwise OPENCV"""
    procam_step: int = 1
    """graycode_step with which procam-calibration was run, if the intrinsics come from it"""
    decoder: str | None = None
    """decoder of the captures: network for a coded grid, graycode for Gray code; default: the one for the pattern"""
    sequence: SequenceName | None = None
    """order of the images of a Gray-code sequence, by the program that showed it; default: what pattern.json states, or
    for a --pattern that is a resolution what the images show"""
    cell: int | None = None
    """side of the squares that a Gray code numbers, in projector pixels, if --pattern is a resolution; default: what
    the number of images says"""
    known_length: str | None = None
    """one true length: "baseline of frame 0 = 85 mm", or "distance between frame 3 (410.5, 200) and frame 7 (35, 80) =
    50 mm" with pixels x, y of the photographs; without it, the unit of the scan is arbitrary"""
    not_mosaic: bool = False
    """the images are not raw mosaics of a colour filter (Bayer), although their pixels alternate like those"""
    full_size: bool = False
    """decode every pixel of the photographs; otherwise large ones are shrunk as they are read, to 12 pixels or more a
    period of a coded grid, and so are their masks and colours"""
    unordered: bool = False
    """the frames were not captured in order around the object: try every pair"""
    poses: Path | None = None
    """transforms.json with rough camera poses to start from (within 20 degrees); the scan gets their axes and unit"""
    rig: Rig = "free"
    """how the devices moved: each by itself, both fixed to each other, or only the camera"""
    no_adjust: bool = False
    """leave the poses as registration (ICP) finds them, without adjusting all frames together: for methods that refine
    poses themselves, and to see what the adjustment is worth"""
    estimate_projector: bool = False
    """nobody has calibrated the projector: find its intrinsics from all frames; those in a file are only a start"""
    masks: Path | None = None
    """folder with one mask for each frame, named like the frame: white is used, black is not"""
    object_only: bool = False
    """leave out the plane that the object stands on, walls, and what is not connected to the object; the report shows
    what was left out"""
    color: Path | None = None
    """folder with photographs without the pattern, each from the same place as the frame that it is named like: the
    colours of the mesh; Gray code needs none, it has images in full light"""
    device: Literal["cuda", "cpu"] | None = None
    """where the networks that read a coded grid are computed; default: on the GPU if there is one that works, which one
    process opens for all"""
    jobs: int | None = None
    """number of processes that decode frames; default: one for each core, as far as there is memory for
    them"""
    work: Path | None = None
    """folder in which decoded frames, the registration and the adjustment are kept for the next run; default:
    that of an earlier run with the same captures, else OUTPUT.work"""
    seed: int = 0
    """seed of all random choices: the same captures and flags give the same scan"""

    def check(self) -> None:
        """Raise UserError naming the flag if a value makes no sense."""
        rules = (
            (self.jobs is None or self.jobs >= 1, "--jobs", self.jobs, "give at least 1"),
            (self.procam_step >= 1, "--procam-step", self.procam_step, "give at least 1"),
            (self.cell is None or self.cell >= 1, "--cell", self.cell, "give at least 1"),
            (self.seed >= 0, "--seed", self.seed, "seeds are at least 0"),
        )
        for holds, flag, value, why in rules:
            if not holds:
                raise UserError(f"{flag} {value}: {why}")
        if self.no_adjust and (self.finds_projector or self.rig != "free"):
            other = "--estimate-projector" if self.estimate_projector else f"--rig {self.rig}"
            raise UserError(
                f"--no-adjust and {other}: only the joint adjustment can do what {other} asks for\n"
                "    remedy: leave one of them out"
            )
        work, output, images = (os.path.realpath(path) for path in (self.work_folder, self.output, self.images))
        for flag, inner, outer, what in (
            ("--output", output, images, "the captures, and would become one of them"),
            ("--work", work, images, "the captures, and would become one of them"),
            ("--work", work, output, "the output, which is to hold the scan alone"),
        ):
            if os.path.commonpath([inner, outer]) == outer:
                path = self.output if flag == "--output" else self.work_folder
                raise UserError(
                    f"{flag} {path}: is in {what}\n    remedy: give a folder outside of it, such as "
                    f"{Path(outer).parent / ('scan' if flag == '--output' else 'scan.work')}"
                )

    @property
    def finds_projector(self) -> bool:
        """Whether frames are decoded before anything is known of the projector's poses."""
        return self.estimate_projector or self.rig == "static-projector"

    @property
    def work_folder(self) -> Path:
        """The folder in which results of stages are kept."""
        output = self.output if self.output.name not in ("", "..") else Path(os.path.abspath(self.output))
        return self.work or output.parent / f"{output.name}.work"
