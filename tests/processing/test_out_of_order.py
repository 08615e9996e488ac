"""Captures whose order says nothing: frames are registered again only with other poses of their projectors."""

import numpy as np
import pytest

from sl_nerfstudio.processing import process as stages
from sl_nerfstudio.registration.register import ProjectorChoice
from sl_nerfstudio.registration.result import Registration, UndecidedProjector

NAMES = ("a", "b", "c")
ORDER = "the frames do not follow each other in the order of capture: --unordered says so"
DOUBT = UndecidedProjector("b", 20.0)


@pytest.fixture
def registered(monkeypatch):
    """Makes the choices of projectors, by neighbours and by all; lists what is registered, by which order."""

    def registered(by_neighbours, by_all, in_order=False):
        calls = []

        def register(chosen, sequence, *_):
            calls.append((chosen, sequence))
            poses = np.tile(np.eye(4) * (1 + len(calls)), (3, 1, 1))
            return Registration(NAMES, poses, np.ones(3), np.ones(3, dtype=bool), np.zeros(3, dtype=np.int64),
                                np.ones(3), (), (), (), ordered=sequence and in_order)  # fmt: skip

        doubts = {True: (), False: (DOUBT,)}
        choices = {True: by_neighbours, False: by_all}
        monkeypatch.setattr(
            stages,
            "choose_projectors",
            lambda clouds, sequence, _: ProjectorChoice(choices[sequence], doubts[sequence]),
        )
        monkeypatch.setattr(stages, "chosen_clouds", lambda clouds, chosen: chosen)
        monkeypatch.setattr(stages, "register", register)
        return calls

    return registered


def number(registration):
    """Which of the calls made it."""
    return registration.T_world_camera[0, 0, 0] - 1


def run(unordered):
    log = []
    return *stages._register([], unordered, 0, None, log.append), log


def test_the_same_poses_are_registered_once_and_what_all_frames_say_of_them_counts(registered):
    calls = registered((0, 1, 0), (0, 1, 0))
    chosen, found, log = run(unordered=False)
    assert calls == [((0, 1, 0), True)] and log == [ORDER]
    assert chosen == (0, 1, 0) and found.exclusions == (DOUBT,) and number(found) == 1


def test_other_poses_are_registered_again(registered):
    calls = registered((0, 1, 0), (0, 0, 0))
    chosen, found, log = run(unordered=False)
    assert calls == [((0, 1, 0), True), ((0, 0, 0), False)] and log == [ORDER]
    assert chosen == (0, 0, 0) and found.exclusions == (DOUBT,) and number(found) == 2


@pytest.mark.parametrize("unordered", [False, True])
def test_where_the_order_is_known_nothing_is_repeated(registered, unordered):
    calls = registered((0, 1, 0), (0, 0, 0), in_order=True)
    chosen, found, log = run(unordered)
    wanted = (0, 0, 0) if unordered else (0, 1, 0)
    assert calls == [(wanted, not unordered)] and chosen == wanted and log == []
    assert found.exclusions == ((DOUBT,) if unordered else ())
