"""Settings of a synthetic scan; the docstrings of the fields are the help text of `sl-synth`."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np

from sl_nerfstudio.errors import UserError

Units = Literal["m", "cm", "mm", "um", "arbitrary"]
PathKind = Literal["hand-held", "half-turn", "rigid-rig", "static-projector"]
MILLIMETRES = {"m": 1e-3, "cm": 0.1, "mm": 1.0, "um": 1e3, "arbitrary": 1.0}
"""A millimetre in each unit; an unknown unit counts as a millimetre."""


@dataclass(frozen=True)
class SynthConfig:
    """A synthetic scan. Lengths in flags are in millimetres, fractions are between 0 and 1."""

    scene: str = "cone-and-cylinder"
    """cone-and-cylinder, head, frog, chair, leaf, dog, vase, medal; with weak geometry: staircase, bottle, spheres,
    bump, relief, rod; parts that look the same from several sides but for one feature, another one for each --seed:
    flange, knob, disc, gear, box, labelled-bottle; or a mesh file (.ply .obj .stl .glb) whose lengths are in --units;
    chessboard, charuco: photographs of a calibration board under a pattern, for sl-calibrate"""
    appearance: Literal["plain", "realistic", "hard"] = "plain"
    """plain: grey images of a matte surface; realistic: colour photographs with texture, gloss, defocus, motion, room
    light, interreflection, changing exposure, gamma, JPEG and, among --images-only, a few useless frames; hard: all of
    it stronger"""
    background: Literal["none", "table", "walls"] = "none"
    """what stands around the object, lit by the same pattern: nothing, a table, or a table with boards and boxes; the
    devices then stay at least 26 degrees above the table"""
    frames: int = 22
    """number of captures"""
    resolution: int = 400
    """width and height of the camera's image, pixels"""
    pattern: Path | None = None
    """the projected pattern: a pattern.json or any image; default: an 800 x 800 coded grid"""
    seed: int = 0
    """random seed: the same flags give the same bytes"""

    path: PathKind = "hand-held"
    """hand-held: camera and projector move independently around the object; half-turn: likewise, but along one side of
    it; rigid-rig: they move together; static-projector: only the camera moves"""
    projector_model: Literal["OPENCV", "DOE"] = "OPENCV"
    """pinhole, or a diffractive element whose pattern is uniform in direction cosines"""
    camera_distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 of the camera, as defined by OpenCV"""
    projector_distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1 k2 p1 p2 of the projector"""
    supersampling: int = 2
    """rays per pixel and direction in captured images; correspondences are always exact at pixel centres"""

    noise: float = 0.3
    """standard deviation of decoded coordinates, pattern pixels"""
    missing: float = 0.15
    """fraction of pattern cells that were not decoded"""
    wrong: float = 0.02
    """fraction of pattern cells that were decoded as others, wrong by 1 to 5 periods"""
    sensor_noise: float = 0.012
    """noise of captured images at full scale, as a fraction of full scale"""
    pose_error: tuple[float, float] = (1.0, 3.0)
    """registration: RMS rotation (degrees) about the object and translation (mm) of a frame as a whole"""
    autocalibration_error: tuple[float, float, float] = (0.22, 0.37, 0.02)
    """auto-calibration: RMS rotation (degrees) of projector relative to camera, baseline direction (degrees) and
    length (fraction)"""
    clean: bool = False
    """no noise and exact poses, whatever the flags above are"""

    units: Units = "mm"
    """unit of the written lengths"""
    scale_known: bool = True
    """the baseline of frame 0 is exact and stated as known; with --no-scale-known no length is"""
    pose_sigma: bool = True
    """state the uncertainty of the starting poses (sl_pose_sigma)"""
    world_turn: int | None = None
    """rotate and shift the world at random, with this seed"""
    images_only: bool = False
    """write only what a user would have: images, pattern and intrinsics; the truth goes to ground_truth/"""

    def check(self) -> None:
        """Raise UserError, naming the flag, if a value is invalid."""
        rules = (
            (self.frames >= 2, "--frames", self.frames, "a scan needs at least 2 frames"),
            (self.resolution >= 16, "--resolution", self.resolution, "give at least 16 pixels"),
            (1 <= self.supersampling <= 8, "--supersampling", self.supersampling, "give 1 to 8"),
            (self.noise >= 0, "--noise", self.noise, "a standard deviation in pattern pixels is at least 0"),
            (self.sensor_noise >= 0, "--sensor-noise", self.sensor_noise, "it is at least 0"),
            (0 <= self.missing < 1, "--missing", self.missing, "it is a fraction: 15 % is 0.15"),
            (0 <= self.wrong < 1, "--wrong", self.wrong, "it is a fraction: 2 % is 0.02"),
            (self.missing + self.wrong <= 1, "--missing and --wrong", self.missing + self.wrong, "their sum is over 1"),
            (min(self.pose_error) >= 0, "--pose-error", self.pose_error, "errors are at least 0"),
            (min(self.autocalibration_error) >= 0, "--autocalibration-error", self.autocalibration_error,
             "errors are at least 0"),
            (self.autocalibration_error[2] < 0.5, "--autocalibration-error", self.autocalibration_error,
             "the third is a fraction of the baseline: 2 % is 0.02"),
            (self.seed >= 0, "--seed", self.seed, "seeds are at least 0"),
            ((self.world_turn or 0) >= 0, "--world-turn", self.world_turn, "seeds are at least 0"),
        )  # fmt: skip
        finite = [
            (bool(np.isfinite(value).all()), f"--{field.name.replace('_', '-')}", value, "not a finite number")
            for field in fields(self)
            if isinstance(value := getattr(self, field.name), float | tuple)
        ]
        for holds, flag, value, why in (*finite, *rules):
            if not holds:
                raise UserError(f"{flag} {value}: {why}")
