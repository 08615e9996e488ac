"""Every plane of a case, and why it is surroundings or part of the object."""

import numpy as np
import pytest


def _verdicts(found):
    return [(f.plane, f.verdict, f.is_surroundings) for f in found.findings]


@pytest.mark.parametrize(("background", "verdict"), [("table", "leaves the views"), ("plate", "object stands on it")])
def test_the_supporting_plane_is_found_where_it_is(separated, background, verdict):
    """The box stands on z = 0; a plate as large as the box is high has edges that the frames see."""
    plane, found, surroundings = _verdicts(separated("box", background, 0.6))[0]
    assert (found, surroundings) == (verdict, True)
    assert plane.normal[2] > 0.9999 and abs(plane.offset) < 0.15


def test_sides_of_a_box_have_cameras_or_surface_behind_them(separated):
    judged = _verdicts(separated("box", "none"))
    assert len(judged) >= 4
    assert {verdict for _, verdict, _ in judged} <= {"cameras on both sides", "surface behind it"}


def test_the_face_of_a_plaque_alone_is_kept(separated):
    plane, verdict, surroundings = _verdicts(separated("plaque", "none"))[0]
    assert plane.normal[2] > 0.999 and not surroundings
    assert verdict in ("edges seen", "surface behind it")


def test_facts_are_shares(separated):
    for f in separated("box", "table").findings:
        values = np.array([f.share, f.cameras_in_front, f.behind, f.above, f.continues, f.around])
        assert ((values >= 0) & (values <= 1)).all() and f.area_ratio >= 0
