"""What a scan is judged by, as facts. What a command does not know is None, and is not judged."""

from dataclasses import dataclass

from sl_nerfstudio.verdict.agreement import CrossFrameAgreement


@dataclass(frozen=True)
class FrameFacts:
    """One capture."""

    name: str
    in_scan: bool = True
    component: int | None = 0  # group of frames that registration connects: 0 the largest; None: none
    undecided: bool = False  # registration could not decide its pose
    sigma_rotation_deg: float | None = None  # of the camera in the scan, 1 sigma per axis
    decoded_share: float | None = None  # of the visible pattern
    shared_decoded: float | None = None  # of the surface that other frames show, where this one sees the pattern
    missing_share: float | None = None  # of the surface that other frames show in its sight: where it saw no pattern
    own_share: float | None = None  # of the decoded pixels, those that agree with the pose of the frame's own projector
    degenerate: bool = False  # the pose of its projector is determined weakly by the frame itself


@dataclass(frozen=True)
class PairFacts:
    """Two frames that registration connected."""

    frames: tuple[str, str]
    used: bool  # False: contradicted by other pairs
    support: float = 1.0  # how much their surfaces share, and how little of that contradicts: from 0 to 1


@dataclass(frozen=True)
class ScanFacts:
    """All captures of a scan, in order."""

    frames: tuple[FrameFacts, ...]
    pairs: tuple[PairFacts, ...] | None = None  # of registration
    cross: CrossFrameAgreement | None = None  # of the frames in the scan, in their order
    wrong_intrinsics: bool = False  # the captures contradict the stated intrinsics
    turns_deg: tuple[float, ...] = ()  # after which the surface looks the same, so that frames may be turned by them
    by_order: bool = False  # frames fit at several sides, and the order of capture decided
    adjusted: bool = True  # False: sl-process was told to leave the poses as registration found them

    @property
    def in_scan(self) -> tuple[FrameFacts, ...]:
        """Frames in the scan."""
        return tuple(frame for frame in self.frames if frame.in_scan)
