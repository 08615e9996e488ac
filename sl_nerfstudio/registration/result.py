"""What registration found: poses, the pairs that support them, frames that were left out, and what is uncertain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from numpy import ndarray


@dataclass(frozen=True)
class Edge:
    """Two frames that were registered with each other."""

    frames: tuple[str, str]
    R_second_first: Float64[ndarray, "3 3"]  # between their cameras, as the pair says it
    overlap: float  # share of the points that agree
    fitness: float  # share of those that could be judged
    used: bool  # False: inconsistent with the other pairs
    undecided: bool  # a clearly different similarity fits nearly as well
    rotation_sigma_deg: float  # standard deviation of the rotation that this pair determines least
    by_tone: bool = False  # surfaces alone would let the frames slip: their tones hold them


@dataclass(frozen=True)
class SurfaceDisagrees:
    """A frame was left out because its surface does not agree with that of the other frames."""

    frame: str
    fitness: float  # of its points that other frames can judge, the share that agrees


@dataclass(frozen=True)
class NoCommonSurface:
    """A frame was left out because no other frame shares any surface with it."""

    frame: str


@dataclass(frozen=True)
class SeparateComponent:
    """A frame was left out because it, or its component, is not connected to the largest one with certainty."""

    frame: str
    component: tuple[str, ...]  # all frames of its component
    slips: bool  # every pair that connects it may slip along the surface
    partner: str | None  # the frame of the largest component with which it shares most; None: none


@dataclass(frozen=True)
class PoorPair:
    """A frame was left out because even its best pair overlaps or agrees too little."""

    frame: str
    partner: str
    overlap: float  # share of the points that agree
    fitness: float  # share of those that could be judged
    least_overlap: float  # that a pair must have
    least_fitness: float


@dataclass(frozen=True)
class PairsContradict:
    """A frame was left out because most of its pairs, counted by how well they fit, place it elsewhere."""

    frame: str
    pairs: int  # with registered frames
    contradicting: int


@dataclass(frozen=True)
class CoordinatesDisagree:
    """A frame was left out after the joint adjustment: its coordinates contradict those of the other frames."""

    frame: str
    group: tuple[str, ...]  # frames that agree with each other but not with the rest


@dataclass(frozen=True)
class UndecidedProjector:
    """A frame was left out because two poses of its projector explain its coordinates, and no other frame decides."""

    frame: str
    angle_deg: float  # between the two poses of the projector


Exclusion = (
    SurfaceDisagrees
    | NoCommonSurface
    | SeparateComponent
    | PoorPair
    | PairsContradict
    | CoordinatesDisagree
    | UndecidedProjector
)
"""Why a frame was not registered."""


@dataclass(frozen=True)
class UncertainRotation:
    """A frame may slip along the surface that other frames see, as on a vase without texture."""

    frame: str
    sigma_deg: float  # of the least known rotation, by the best pair


@dataclass(frozen=True)
class SeparatePoses:
    """Frames that are connected to each other but not to the largest component, in axes and a unit of their own."""

    frames: tuple[str, ...]
    T_world_camera: Float64[ndarray, "m 4 4"]  # in the axes of the first of these cameras
    baseline: Float64[ndarray, "m"]  # camera to projector


@dataclass(frozen=True)
class Registration:
    """Camera poses in the axes of the first registered frame's camera (looking along -z), and baselines."""

    names: tuple[str, ...]
    T_world_camera: Float64[ndarray, "n 4 4"]  # NaN where not registered
    baseline: Float64[ndarray, "n"]  # camera to projector; geometric mean 1 over the registered frames; NaN elsewhere
    registered: Bool[ndarray, "n"]
    component: Int64[ndarray, "n"]  # 0: the largest, which is registered; 1, 2, ...: others; -1: a single frame
    fitness: Float64[ndarray, "n"]  # share of each frame's judged points that agree; NaN where not registered
    edges: tuple[Edge, ...]
    exclusions: tuple[Exclusion, ...]  # one for each frame that was not registered
    uncertainties: tuple[UncertainRotation, ...]
    separate: tuple[SeparatePoses, ...] = ()  # of the other components
    turns_deg: tuple[float, ...] = ()  # after which the surface looks the same, so that pairs contradict each other
    ordered: bool = True  # frames follow each other in the order of capture; False: stated, or found not to be so
    by_order: bool = False  # which side each frame shows was decided by the order of capture


def without_frames(registration: Registration, exclusions: Sequence[Exclusion]) -> Registration:
    """The registration without the frames that the exclusions name, each as a frame by itself."""
    names = {exclusion.frame for exclusion in exclusions}
    out = np.array([name in names for name in registration.names])
    return replace(
        registration,
        T_world_camera=np.where(out[:, None, None], np.nan, registration.T_world_camera),
        baseline=np.where(out, np.nan, registration.baseline),
        registered=registration.registered & ~out,
        component=np.where(out, -1, registration.component),
        fitness=np.where(out, np.nan, registration.fitness),
        exclusions=(*registration.exclusions, *exclusions),
        uncertainties=tuple(u for u in registration.uncertainties if u.frame not in names),
    )


def without_undecided(registration: Registration, undecided: Sequence[UndecidedProjector]) -> Registration:
    """The registration without those of its frames whose projector may stand at two places.

    The surface of such a frame is bent if the wrong one was taken, and hardly any agreement tells.
    """
    names = {name for name, here in zip(registration.names, registration.registered, strict=True) if here}
    return without_frames(registration, [doubt for doubt in undecided if doubt.frame in names])
