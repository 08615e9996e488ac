"""Where the camera is, image by image: each frame is registered with the kept frames that see the same surface.

A pair is registered as everywhere (`registration/pairs.py`), and what all pairs of a frame say together is decided by
the same evidence (`registration/assembly.py`). So a place that another one rivals is not certain here either. A frame
is compared with a few kept frames, however many there are.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import partial

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, angle_deg
from sl_nerfstudio.live.sight import Fault, Sight
from sl_nerfstudio.live.surfels import CELLS, Surfels
from sl_nerfstudio.parallel import one_library_thread, results
from sl_nerfstudio.registration.assembly import LARGEST_BASELINE, Assembly
from sl_nerfstudio.registration.evidence import Commonness, Frame, KeptResiduals, ScanEvidence
from sl_nerfstudio.registration.pairs import (
    ANYWHERE,
    NEARBY,
    PairMatch,
    Search,
    is_accepted,
    is_ambiguous,
    register_pair,
    search_score,
)
from sl_nerfstudio.registration.pose_graph import Component, EdgeArrays, Pivots, optimise_at_places
from sl_nerfstudio.registration.register import LARGEST_SIGMA_ROTATION_DEG

PARTNER_ANGLES_DEG = 0.0, 20.0, 40.0  # to kept frames it is registered with: near ones are found, far ones stop drift
PARTNERS = len(PARTNER_ANGLES_DEG)
OTHERS = 5  # kept frames around those, by which a place is judged as well
RECENT = 8  # kept frames of late: one partner is older, where there is one, so that loops close
LARGEST_ANGLE_DEG = 60.0  # between lines of sight of a frame and a partner
NEAR_AFTER = 2  # frames without a certain place, after which it is looked for everywhere first
COMPARED = 10  # kept frames of which those that look most like a frame are partners, when it is lost
LEAST_CONFIRMING = 2  # pairs, or frames one after the other, that must say a place after a loss
LARGEST_JUMP_DEG = 40.0  # that a camera turns about the object from one frame to the next without being lost
SMALLEST_FITNESS = 0.7  # share of the points that should be seen and agree

# When a frame adds something.
NEW_SHARE = 0.15  # of what it sees at places that were seen too few times
LEAST_TURN_DEG, USUAL_TURN_DEG = 4.0, 12.0  # from the nearest kept frame: never below, always beyond

BEFORE_RESTART = 4  # frames that do not fit the first one, after which another is taken for it
LOCAL = 12  # kept frames that are moved when one more is kept; all of them where a loop closes
LOOP_GAP = 8  # kept frames between two that close a loop


class State(Enum):
    """How well the place of a frame is known."""

    TRACKED = "tracked"
    UNCERTAIN = "uncertain"
    LOST = "lost"


class Doubt(Enum):
    """Why a frame's place is not certain, or not known."""

    RIVAL = "rival"  # another place is nearly as likely
    SLIPS = "slips"  # the surface may turn or slide without a change
    UNSTEADY = "unsteady"  # the rotation is hardly known
    RELATIVE_POSE = "relative pose"  # of the projector: several poses explain the image
    UNCONFIRMED = "unconfirmed"  # found again, by one frame only
    JUMP = "jump"  # far from the place before
    NO_OVERLAP = "no overlap"  # what it shows fits nothing that was seen
    TOO_FAST = "too fast"  # the same, just after a frame whose place was known
    WEAK_START = "weak start"  # the first frame must know its projector's pose well


@dataclass(frozen=True)
class Placed:
    """A frame after tracking. Lengths are in the model's unit, the first baseline; poses are None where unknown."""

    state: State
    cause: Fault | Doubt | None = None  # None: tracked
    S_world_camera: Similarity | None = None  # its scale is the baseline
    covariance: Float64[ndarray, "7 7"] | None = None  # of (v, w, l) about the frame's centroid, see pose_graph
    sigma_rotation_deg: float = float("nan")
    sigma_position: float = float("nan")  # of the camera, relative to the kept frames around
    thin_share: float = 0.0  # of what it sees at places seen too few times
    turn_deg: float = float("nan")  # of the line of sight, from the nearest kept frame
    matches: tuple[PairMatch, ...] = ()  # source: -1, the frame; target: kept frames
    anchor: int = -1  # the kept frame nearest to it
    S_anchor_camera: Similarity | None = None

    @property
    def adds(self) -> bool:
        """Whether the frame shows something that the kept frames do not show well."""
        if self.state is not State.TRACKED:
            return False
        far = self.turn_deg >= USUAL_TURN_DEG
        return far or (self.turn_deg >= LEAST_TURN_DEG and self.thin_share >= NEW_SHARE)


@dataclass
class Kept:
    """A frame of the model."""

    frame: Frame
    T_camera_projector: Float64[ndarray, "4 4"]  # baseline one
    sigma_position: float
    common: Commonness | None = None  # what its pairs say of its points
    noise: tuple[float, ...] = ()  # of its points, by each of its last pairs


@dataclass
class Model:
    """The kept frames with their places, and the pairs between them."""

    kept: list[Kept] = field(default_factory=list)
    nodes: Component = field(default_factory=dict)  # S_world_camera
    edges: list[PairMatch] = field(default_factory=list)
    drawn: Component = field(default_factory=dict)  # the places at which their surfaces are in `surfels`
    surfels: Surfels = field(default_factory=lambda: Surfels.none(1.0))

    def __len__(self) -> int:
        """Number of kept frames."""
        return len(self.kept)

    @property
    def poses(self) -> DevicePoses:
        """Both devices of the kept frames, lengths in the unit of the model."""
        cameras, projectors = np.tile(np.eye(4), (2, len(self), 1, 1))
        for k, S in self.nodes.items():
            cameras[k] = S.poses(np.eye(4))
            projectors[k] = S.poses(self.kept[k].T_camera_projector)
        return DevicePoses(cameras, projectors)

    def angles_deg(self, S_world_camera: Similarity) -> Float64[ndarray, "n"]:
        """Between the lines of sight of the kept frames and that of a camera."""
        sight = np.array([S.R[:, 2] for S in self.nodes.values()], dtype=np.float64)
        return np.degrees(np.arccos(np.clip(sight @ S_world_camera.R[:, 2], -1, 1)))

    def draw(self) -> None:
        """Bring the surface to where the kept frames are; all of it where one has moved too far."""
        size = self.kept[0].frame.map.radius / CELLS
        new = [k for k in self.nodes if k not in self.drawn]
        if any(_moved(self.kept[k].frame, S, self.nodes[k]) > size / 2 for k, S in self.drawn.items()):
            self.surfels, self.drawn, new = Surfels.none(size), {}, list(self.nodes)
        elif not self.drawn:
            self.surfels = Surfels.none(size)
        for k in new:
            self.surfels = self.surfels.with_frame(self.kept[k].frame.map, self.nodes[k], self.kept[k].sigma_position)
            self.drawn[k] = self.nodes[k]


def _moved(frame: Frame, before: Similarity, now: Similarity) -> float:
    """How far the middle of what a frame sees has moved; its edges, where it turned."""
    centre = frame.map.centroid[None]
    shift = float(np.linalg.norm(before.points(centre) - now.points(centre)))
    return shift + now.scale * frame.map.radius * float(np.radians(angle_deg(before.R.T @ now.R)))


@dataclass(frozen=True)
class TrackerState:
    """What tracking remembers besides kept frames and pairs."""

    nodes: tuple[Similarity, ...]
    drawn: tuple[Similarity, ...]
    count: int
    last: Similarity | None
    lost: int
    unconfirmed: Similarity | None
    misfits: int


class Tracker:
    """Places frames one after the other. The same frames give the same places."""

    def __init__(self, seed: int = 0) -> None:
        self.model = Model()
        self._seed, self._count = seed, 0
        self._last: Similarity | None = None  # S_world_camera of the last frame whose place was known
        self._lost = 0  # frames since then
        self._unconfirmed: Similarity | None = None  # where the frame before was found again
        self._misfits = 0  # of frames with the first one

    @property
    def last(self) -> Similarity | None:
        """Where the camera was last known to be (`S_world_camera`)."""
        return self._last

    @one_library_thread()
    def place(self, sight: Sight) -> Placed:
        """Where a frame was taken; the model is not changed (see `keep`), but a first frame that nothing fits is."""
        self._count += 1
        placed = self._placed(sight)
        if placed.state is State.TRACKED:
            self._last, self._lost, self._unconfirmed = placed.S_world_camera, 0, None
        else:
            self._lost += 1
            found = placed.cause is Doubt.UNCONFIRMED
            self._unconfirmed = placed.S_world_camera if found else None
        return placed

    @one_library_thread()
    def keep(self, sight: Sight, placed: Placed) -> int:
        """Add a tracked frame to the model, and return its number."""
        assert sight.frame is not None and sight.cloud is not None and placed.S_world_camera is not None
        model, number = self.model, len(self.model)
        S = placed.S_world_camera
        sigma = 0.0 if number == 0 else placed.sigma_position
        kept = Kept(sight.frame, sight.cloud.pose.T_camera_projector, sigma)
        model.kept.append(kept)
        model.nodes[number] = S
        self._add_pairs(number, placed.matches)
        self._settle(number, placed.matches)
        model.draw()
        self._last = model.nodes[number]
        return number

    @property
    def state(self) -> TrackerState:
        """What is needed to go on, with the kept frames and their pairs."""
        nodes, drawn = (tuple(one[k] for k in range(len(self.model))) for one in (self.model.nodes, self.model.drawn))
        return TrackerState(nodes, drawn, self._count, self._last, self._lost, self._unconfirmed, self._misfits)

    def resume(self, state: TrackerState, kept: Sequence[Kept], matches: Sequence[Sequence[PairMatch]]) -> None:
        """Go on from a state; `matches` are the pairs with which each frame was kept."""
        self.model = Model(list(kept))
        for number, pairs in enumerate(matches):
            self._add_pairs(number, pairs)
        if kept:
            self.model.nodes = dict(enumerate(state.drawn))
            self.model.draw()
        self.model.nodes = dict(enumerate(state.nodes))
        self._count, self._last, self._lost = state.count, state.last, state.lost
        self._unconfirmed, self._misfits = state.unconfirmed, state.misfits

    # ---- one frame

    def _placed(self, sight: Sight) -> Placed:
        if sight.frame is None or sight.cloud is None:
            return Placed(State.LOST, sight.fault)
        if not len(self.model):
            return Placed(State.LOST, Doubt.WEAK_START) if sight.weak else _first()
        rng = np.random.default_rng([self._seed, self._count])
        guess = self._last if self._lost <= NEAR_AFTER else None
        placed = self._registered(sight, self._near(guess), guess, rng) if guess is not None else None
        if placed is None or placed.state is State.LOST:
            placed = self._registered(sight, self._alike(sight.frame, rng), None, rng)
        if len(self.model) > 1 or placed.state is State.TRACKED:
            return placed
        self._misfits += 1
        if self._misfits < BEFORE_RESTART or sight.weak:
            return placed
        self.model, self._misfits = Model(), 0  # one of two frames is wrong: the scan has hardly begun
        return _first()

    def _near(self, S_world_camera: Similarity) -> list[int]:
        """Kept frames that look nearly the same way as a camera, at several angles to it; and one that is older."""
        angle = self.model.angles_deg(S_world_camera)
        facing = [k for k in np.argsort(angle, kind="stable").tolist() if angle[k] < LARGEST_ANGLE_DEG]
        chosen: list[int] = []
        for wanted in PARTNER_ANGLES_DEG[: len(facing)]:
            chosen.append(min((k for k in facing if k not in chosen), key=lambda k: abs(angle[k] - wanted)))
        old = [k for k in facing if k < len(angle) - RECENT]
        if old and not any(k in chosen for k in old):
            chosen = [*chosen[: PARTNERS - 1], old[0]]
        return chosen

    def _alike(self, frame: Frame, rng: np.random.Generator) -> list[int]:
        """Kept frames that look most like a frame; some of many are compared, others for the next frame."""
        n = len(self.model)
        some = np.unique([(k * n // min(COMPARED, n) + self._count) % n for k in range(min(COMPARED, n))]).tolist()
        maps = [(frame.map, self.model.kept[k].frame.map) for k in some]
        rngs = rng.spawn(len(some))
        tasks = [partial(search_score, pair, ANYWHERE, one) for pair, one in zip(maps, rngs, strict=True)]
        order = np.argsort([-score for score in results(tasks)], kind="stable")
        return [some[k] for k in order[:PARTNERS]]

    def _registered(
        self, sight: Sight, partners: Sequence[int], guess: Similarity | None, rng: np.random.Generator
    ) -> Placed:
        """A frame by the pairs with some kept frames."""
        assert sight.frame is not None
        found = [m for m in self._pairs(sight.frame, partners, guess, rng) if m is not None]
        accepted = [m for m in found if is_accepted(m)]
        if not accepted:
            return Placed(State.LOST, Doubt.TOO_FAST if self._lost == 0 else Doubt.NO_OVERLAP)
        local = self._around(partners)
        model, own = self.model, len(local)
        number = {k: i for i, k in enumerate(local)} | {-1: own}
        frames = [*(model.kept[k].frame for k in local), sight.frame]
        pivots = Pivots(np.stack([f.map.centroid for f in frames]), np.array([f.map.radius for f in frames]))
        inside = [e for e in model.edges if e.source in number and e.target in number]
        edges = [replace(e, source=number[e.source], target=number[e.target]) for e in (*inside, *accepted)]
        nodes = {number[k]: model.nodes[k] for k in local}
        holding = [e for e in edges if e.holds]
        mine = [e for e in holding if own in (e.source, e.target)]
        scan = self._evidence(local, sight.frame, found)
        joint = Assembly(scan, pivots, holding).decide(nodes, {own: Similarity.identity()}) if mine else None
        best = max(accepted, key=lambda m: m.log_odds)
        S = model.nodes[best.target] @ best.S_target_source if joint is None else joint
        known = [e for e in mine if e.knows({**nodes, own: S})]
        if known:
            S = optimise_at_places(known, pivots, {**nodes, own: S}, [own]).S_world_camera[own]
        placed = self._judged(sight, S, known or [e for e in edges if own in (e.source, e.target)], pivots)
        confirming = tuple(m for m in accepted if m.holds and m.knows({**model.nodes, -1: S}))
        cause = self._doubt(sight, placed, joint is not None, accepted, confirming, best)
        state = State.TRACKED if cause is None else State.UNCERTAIN
        anchor = best.target
        return replace(
            placed, state=state, cause=cause, matches=confirming, anchor=anchor,
            S_anchor_camera=model.nodes[anchor].inverse() @ S,
        )  # fmt: skip

    def _pairs(
        self, frame: Frame, partners: Sequence[int], guess: Similarity | None, rng: np.random.Generator
    ) -> list[PairMatch | None]:
        search: Search = ANYWHERE if guess is None else NEARBY
        tasks = []
        for k, own in zip(partners, rng.spawn(len(partners)), strict=True):
            between = None if guess is None else self.model.nodes[k].inverse() @ guess
            frames = frame, self.model.kept[k].frame
            tasks.append(partial(register_pair, frames, (-1, k), search, own, between))
        return results(tasks)

    def _around(self, partners: Sequence[int]) -> list[int]:
        """The partners, and kept frames that pairs connect with them, those of the most pairs first."""
        count: dict[int, int] = {}
        for e in self.model.edges:
            for here, there in ((e.source, e.target), (e.target, e.source)):
                if here in partners and there not in partners:
                    count[there] = count.get(there, 0) + 1
        others = sorted(count, key=lambda k: (-count[k], k))[:OTHERS]
        return [*partners, *others]

    def _evidence(self, local: Sequence[int], frame: Frame, found: Sequence[PairMatch]) -> ScanEvidence:
        """Some kept frames and a new one, with what their pairs have shown of their points."""
        kept = [self.model.kept[k] for k in local]
        frames = [*(one.frame.evidence for one in kept), frame.evidence]
        common = [one.common or Commonness.none(len(one.frame.evidence.points)) for one in kept]
        noise = [float(np.median(one.noise)) if one.noise else 1.0 for one in kept]
        own = sum((m.common[0] for m in found), Commonness.none(len(frame.evidence.points)))
        noise.append(float(np.median([m.noise[0] for m in found])))
        return ScanEvidence(KeptResiduals(frames), [*common, own], np.array(noise))

    def _judged(self, sight: Sight, S: Similarity, edges: Sequence[PairMatch], pivots: Pivots) -> Placed:
        """The covariance of the last frame's place by its pairs, and what it adds."""
        assert sight.frame is not None
        covariance = EdgeArrays.of(edges).covariance_of(len(pivots) - 1, pivots)
        c, radius = sight.frame.map.centroid, sight.frame.map.radius
        J = np.concatenate([radius * np.eye(3), np.cross(np.eye(3), -c).T, -c[:, None]], 1)  # of the camera's centre
        return Placed(
            State.TRACKED, None, S, covariance,
            float(np.degrees(np.sqrt(np.trace(covariance[3:6, 3:6])))),
            float(S.scale * np.sqrt(np.trace(J @ covariance @ J.T))),
            self.model.surfels.thin_share(sight.frame.map, S),
            float(self.model.angles_deg(S).min()),
        )  # fmt: skip

    def _doubt(
        self, sight: Sight, placed: Placed, decided: bool, accepted: Sequence[PairMatch],
        confirming: Sequence[PairMatch], best: PairMatch,
    ) -> Doubt | None:  # fmt: skip
        """The first reason not to trust a place; None if there is none."""
        S = placed.S_world_camera
        assert S is not None
        if not any(m.holds for m in accepted):
            return Doubt.SLIPS
        if not decided or not confirming or (len(confirming) == 1 and is_ambiguous(confirming[0])):
            return Doubt.RIVAL
        if best.fitness < SMALLEST_FITNESS:
            return Doubt.RIVAL
        usual = np.median([np.log(node.scale) for node in self.model.nodes.values()])
        if abs(np.log(S.scale) - usual) > np.log(LARGEST_BASELINE):
            return Doubt.RIVAL
        if placed.sigma_rotation_deg > LARGEST_SIGMA_ROTATION_DEG:
            return Doubt.UNSTEADY
        if "ambiguous" in sight.weak:
            return Doubt.RELATIVE_POSE
        if self._lost == 0 and self._last is not None:
            return Doubt.JUMP if angle_deg(self._last.R.T @ S.R) > LARGEST_JUMP_DEG else None
        if len(confirming) >= LEAST_CONFIRMING:
            return None
        before = self._unconfirmed
        agrees = before is not None and angle_deg(before.R.T @ S.R) < LARGEST_JUMP_DEG / 2
        return None if agrees else Doubt.UNCONFIRMED

    # ---- the model

    def _add_pairs(self, number: int, matches: Sequence[PairMatch]) -> None:
        """Add the pairs with which a frame was kept, and what they say of the points of both of their frames."""
        for match in matches:
            self.model.edges.append(replace(match, source=number))
            for k, common, noise in zip((number, match.target), match.common, match.noise, strict=True):
                one = self.model.kept[k]
                one.common = common if one.common is None else one.common + common
                one.noise = (*one.noise[-LOCAL:], noise)

    def _settle(self, number: int, matches: Sequence[PairMatch]) -> None:
        """Move kept frames to where all pairs want them: those of late, or all of them where a loop closes."""
        model = self.model
        closes = any(number - m.target > LOOP_GAP for m in matches)
        free = [k for k in range(1, number + 1) if closes or k > number - LOCAL]
        near = set(free)
        edges = [e for e in model.edges if e.source in near or e.target in near]
        if len(edges) < 2:
            return
        maps = [kept.frame.map for kept in model.kept]
        pivots = Pivots(np.stack([m.centroid for m in maps]), np.array([m.radius for m in maps]))
        start = {k: model.nodes[k] for k in sorted({k for e in edges for k in (e.source, e.target)})}
        model.nodes |= optimise_at_places(edges, pivots, start, free).S_world_camera


def _first() -> Placed:
    return Placed(State.TRACKED, None, Similarity.identity(), np.zeros((7, 7)), 0.0, 0.0, 1.0, 180.0)
