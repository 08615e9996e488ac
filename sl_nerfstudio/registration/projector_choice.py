"""Frames of which two poses of the projector explain the coordinates: which one, by what neighbouring frames saw.

A wrong pose of the projector bends the surface of its frame, so it agrees less with those of other frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sl_nerfstudio.geometry.similarity import angle_deg
from sl_nerfstudio.progress import track
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.pairs.edge_weights import is_accepted
from sl_nerfstudio.registration.pairs.pair_registration import register_pair, search_score
from sl_nerfstudio.registration.result import UndecidedProjector
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, RegistrationSettings
from sl_nerfstudio.registration.surface_map import SurfaceMap, build_surface_map
from sl_nerfstudio.threads import one_library_thread, results


@dataclass(frozen=True)
class ProjectorChoice:
    """Which cloud of every frame, and the frames where the choice is not certain."""

    chosen: tuple[int, ...]  # for every frame 0, its own cloud, or the number of an alternative from 1
    undecided: tuple[UndecidedProjector, ...]


def chosen_clouds(clouds: Sequence[FrameCloud], chosen: Sequence[int]) -> list[FrameCloud]:
    """Of every frame the cloud that was chosen, without alternatives."""
    return [replace((cloud, *cloud.alternatives)[k], alternatives=()) for cloud, k in zip(clouds, chosen, strict=True)]


@one_library_thread()
def choose_projectors(
    clouds: Sequence[FrameCloud],
    sequence: bool = True,
    seed: int = 0,
    settings: RegistrationSettings = REGISTRATION_DEFAULTS,
) -> ProjectorChoice:
    """Of every frame the cloud that agrees best with those of its neighbours; the first where nothing tells."""
    open_frames = [k for k, c in enumerate(clouds) if c.alternatives]
    if not open_frames:
        return ProjectorChoice((0,) * len(clouds), ())
    search = _Choice(clouds, sequence, np.random.default_rng(seed), settings)
    chosen, undecided = [0] * len(clouds), []
    for k in track(open_frames, "comparing poses of projectors"):
        support = search.support(k)
        best = int(np.argmax(support))
        chosen[k] = best
        rivals = [h for h in range(len(support)) if h != best and support[h] >= settings.choice.rival * support[best]]
        if rivals:
            angle = max(_angle_deg(search.choices[k][best], search.choices[k][h]) for h in rivals)
            undecided.append(UndecidedProjector(clouds[k].name, angle))
    return ProjectorChoice(tuple(chosen), tuple(undecided))


class _Choice:
    """All clouds of all frames, and how well pairs of them agree."""

    def __init__(
        self, clouds: Sequence[FrameCloud], sequence: bool, rng: np.random.Generator, settings: RegistrationSettings
    ) -> None:
        self.choices = [(c, *c.alternatives) for c in clouds]
        maps = iter(
            results([partial(build_surface_map, c, settings.surface_map) for all_ in self.choices for c in all_])
        )
        self._maps = [[next(maps) for _ in choice] for choice in self.choices]
        self._sequence, self._rng, self._settings = sequence, rng, settings

    def support(self, k: int) -> list[float]:
        """For every cloud of a frame the sum of what agrees with its neighbours, less what contradicts."""
        partners = self._partners(k)
        pairs = [(m, j) for m in self._maps[k] for j in partners]
        tasks = [
            partial(self._agreement, *pair, rng) for pair, rng in zip(pairs, self._rng.spawn(len(pairs)), strict=True)
        ]
        return np.reshape(results(tasks), (len(self._maps[k]), -1)).sum(1).tolist()

    def _partners(self, k: int) -> list[int]:
        """Frames taken shortly before and after; of an unordered set those that look most alike."""
        s, n = self._settings.choice, len(self.choices)
        if self._sequence:
            return [j for j in range(max(0, k - s.reach), min(n, k + s.reach + 1)) if j != k]
        search = self._settings.pair.anywhere
        others = [j for j in range(n) if j != k]
        tasks = [
            partial(search_score, (self._maps[k][0], self._maps[j][0]), search, rng, self._settings.pair)
            for j, rng in zip(others, self._rng.spawn(len(others)), strict=True)
        ]
        return [others[i] for i in np.argsort(-np.array(results(tasks)), kind="stable")[: 2 * s.reach]]

    def _agreement(self, own: SurfaceMap, partner: int, rng: np.random.Generator) -> float:
        pair = self._settings.pair
        search = pair.neighbours if self._sequence else pair.anywhere
        best = 0.0
        for other in self._maps[partner]:
            match = register_pair((own, other), (0, 1), search, rng, None, pair)
            if match is not None and is_accepted(match, self._settings.edge):
                contradicting = match.overlap * (1 / match.fitness - 1)
                best = max(best, match.overlap - pair.agreement.penalty * contradicting)
        return best


def _angle_deg(a: FrameCloud, b: FrameCloud) -> float:
    R = a.pose.T_camera_projector[:3, :3] @ b.pose.T_camera_projector[:3, :3].T
    return angle_deg(R)
