"""The result of `sl-process`, for the report and for programs."""

from dataclasses import dataclass, field, replace
from typing import Any

from sl_nerfstudio.processing.capture_files.captured import CaptureNotes
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.placed import PlacedGroup
from sl_nerfstudio.processing.projector.found import FoundProjector
from sl_nerfstudio.processing.selection.object_only import ObjectOnly
from sl_nerfstudio.processing.selection.object_words import object_document
from sl_nerfstudio.verdict.verdict import Verdict


@dataclass(frozen=True)
class FrameRecord:
    """The figures of one frame, and why it was left out if it was. Figures that do not exist are None."""

    name: str
    in_scan: bool
    stage: str  # in which it failed: reading, decoding, calibrating, registering, separating; "" if it did not
    reason: str  # problem, cause and remedy
    decode_rate: float | None = None  # of the visible pattern
    mask_share: float | None = None
    shared_decoded: float | None = None  # of the surface that other frames show, where this one sees the pattern
    missing_share: float | None = None  # of the surface that other frames show in its sight: where it saw no pattern
    epipolar_px: float | None = None  # robust standard deviation of the epipolar error, pattern pixels
    own_share: float | None = None  # of the decoded pixels, those that agree with the pose of the frame's projector
    relative_sigma_rotation_deg: float | None = None  # of the projector against the camera, from this frame alone
    relative_sigma_direction_deg: float | None = None
    component: int = -1  # group of frames that registration connects: 0 the largest, which is in the scan; -1: none
    undecided: bool = False  # registration could not decide its pose
    sigma_rotation_deg: float | None = None  # of the camera in the scan, 1 sigma per axis
    fitness: float | None = None  # share of the points seen by other frames, too, that agree with them
    seen_share: float | None = None  # of its points, those that other frames can judge by their coordinates
    cross_share: float | None = None  # of these, those that agree: the median over the frames it is compared with
    cross_px_median: float | None = None  # their residual, pattern pixels, the same median
    cross_px_p95: float | None = None  # 95 % of the residuals are smaller
    cross_excess: float | None = None  # residual in units of what is expected, relative to the scan's better pairs
    baseline: float | None = None  # camera to projector, in the scan's unit
    degeneracies: tuple[str, ...] = ()


@dataclass(frozen=True)
class EdgeRecord:
    """Two frames that were registered with each other."""

    frames: tuple[str, str]
    overlap: float
    fitness: float
    used: bool
    undecided: bool


@dataclass(frozen=True)
class ProcessResult:
    """Everything the report shows."""

    config: ProcessConfig
    decoder: str
    units: str
    scale_source: str  # "": not known
    frames: tuple[FrameRecord, ...]
    edges: tuple[EdgeRecord, ...]
    remarks: tuple[str, ...]
    recapture: tuple[str, ...]  # what to capture again or in addition, and why
    joint_px: tuple[float, float] | None  # cross-frame residual before and after the joint adjustment
    cross_px: tuple[float, float] | None  # the same over all points that two frames saw: median, 95 %
    verdict: Verdict
    versions: dict[str, str]
    projector: FoundProjector | None = None  # None: the projector is the stated one
    contradiction: str = ""  # which intrinsics the captures contradict; it is among the remarks, too
    object_only: ObjectOnly | None = None  # None: surroundings were not looked for
    captured: CaptureNotes | None = None  # on the captures
    placed: tuple[PlacedGroup, ...] = field(default=(), compare=False)  # for the 3D view of the report

    @property
    def registered(self) -> int:
        """Number of frames in the scan."""
        return sum(frame.in_scan for frame in self.frames)

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "verdict": self.verdict.band,
            "reasons": list(self.verdict.reasons),
            "decoder": self.decoder,
            "units": self.units,
            "scale": self.scale_source or None,
            "projector": None if self.projector is None else self.projector.document(),
            "frames": [
                {key: value for key, value in vars(frame).items() if value not in (None, "", ())}
                for frame in self.frames
            ],
            "overlaps": [vars(edge) for edge in self.edges],
            "remarks": list(self.remarks),
            "recapture": list(self.recapture),
            "joint_adjustment_px": self.joint_px,
            "captures": None if self.captured is None else self.captured.document(),
            "object_only": None if self.object_only is None else object_document(self.object_only),
            "cross_frame_px": self.cross_px,
            "versions": self.versions,
        }


def with_object_only(result: ProcessResult, found: ObjectOnly) -> ProcessResult:
    """The result with what was left out; frames that show nothing of the object are not in the scan."""
    reason = (
        "shows nothing of the object\n    cause:  all decoded pixels belong to its surroundings, by --object-only\n"
        "    remedy: capture the object in this view, or leave --object-only out"
    )
    empty = set(found.empty_frames())
    frames = tuple(
        replace(f, in_scan=False, stage="separating", reason=reason) if f.in_scan and f.name in empty else f
        for f in result.frames
    )
    placed = tuple(group.only_object(found.parts) for group in result.placed)
    return replace(result, frames=frames, object_only=found, placed=placed)
