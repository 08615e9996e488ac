"""The surface as cells, and where to go next."""

import numpy as np
import pytest

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.live.next_view import next_view
from sl_nerfstudio.live.surfels import ENOUGH, Surfels
from sl_nerfstudio.live.tracker import Kept, Model
from tests.live.walks import RIG, sights


def true_model(places: list[int]) -> Model:
    """Some places, kept where they truly are."""
    model = Model()
    for number, place in enumerate(places):
        T, relative = RIG.T_world_camera[place].numpy(), RIG.T_camera_projector[place].numpy()
        sight = sights()[place]
        model.kept.append(Kept(sight.frame, sight.cloud.pose.T_camera_projector, 0.0))
        model.nodes[number] = Similarity(float(np.linalg.norm(relative[:3, 3])), T[:3, :3], T[:3, 3])
        model.draw()
    return model


def test_a_frame_that_is_seen_again_is_counted_and_doubles_the_information():
    seen, S = sights()[0].frame.map, Similarity.identity()
    once = Surfels.none(0.05).with_frame(seen, S, 0.0)
    twice = once.with_frame(seen, S, 0.0)
    np.testing.assert_array_equal(twice.key, once.key)
    np.testing.assert_array_equal(twice.views, 2 * once.views)
    np.testing.assert_allclose(twice.sigma, once.sigma / np.sqrt(2))
    np.testing.assert_allclose(twice.position, once.position)
    assert once.thin_share(seen, S) == twice.thin_share(seen, S) == 1
    thrice = twice.with_frame(seen, S, 0.0)
    assert ENOUGH == 3 and thrice.thin_share(seen, S) == 0
    doubtful = Surfels.none(0.05).with_frame(seen, S, 0.1)  # as its pose is
    assert (doubtful.sigma > once.sigma).all() and doubtful.sigma.min() >= 0.1


def test_cells_lie_on_the_true_surface_whatever_frame_saw_them():
    """Points of one cell differ by no more than a cell, and so do their means; frames agree where both see it."""
    both = true_model([0, 1]).surfels
    shared = both.views == 2
    assert shared.mean() > 0.3
    np.testing.assert_array_less(
        np.abs(both.position - (np.floor(both.position / both.size) + 0.5) * both.size), both.size
    )


@pytest.mark.parametrize("places", [[0, 1, 2], [6, 7, 8, 9]])
def test_the_next_view_is_another_one_that_shares_surface_with_what_is_there(places):
    model = true_model(places)
    found = next_view(model)
    assert found is not None and found.gain > 0
    R = found.T_world_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0
    cosine = np.array([S.R[:, 2] @ R[:, 2] for S in model.nodes.values()])
    apart = np.degrees(np.arccos(cosine.max()))
    assert 8 < apart < 60
    middle = np.median(model.surfels.position, axis=0)
    ahead = middle - found.T_world_camera[:3, 3]
    assert -R[:, 2] @ ahead / np.linalg.norm(ahead) > 0.99  # it looks at the object


def test_a_surface_that_is_known_from_everywhere_gains_little():
    few, many = true_model([0, 1]), true_model(list(range(24)))
    gains = [next_view(model) for model in (few, many)]
    assert gains[0] is not None
    per_cell = [0.0 if g is None else g.gain / len(m.surfels) for g, m in zip(gains, (few, many), strict=True)]
    assert per_cell[1] < per_cell[0] / 2
