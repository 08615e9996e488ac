"""Which node is which: the graph network, window matching, and consensus among neighbours."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.decoding.grid_detection import (
    NodeRecogniser,
    edge_width,
    line_blur,
    measure_exposure,
    measure_noise,
    shows_readable_symbols,
)
from sl_nerfstudio.decoding.grid_graph import GridGraph
from sl_nerfstudio.decoding.grid_phases import GridAppearance, rectify
from sl_nerfstudio.pattern.codes import code_array
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import make_setup
from tests.decoding.test_grid_graph import lattice
from tests.decoding.test_grid_phases import maps_of
from training.graphs import Damage, damage_graph

CODES = code_array(20, 24, seed=5)


@pytest.fixture(scope="module")
def recogniser():
    return NodeRecogniser(GridPattern(w=480, h=400, codes=CODES))


@pytest.mark.parametrize(
    "damage, most_wrong",
    [
        (Damage(0, 0, 0), 0.002),
        (Damage(0.1, 0.2), 0.005),
        (Damage(0.2, 0.2), 0.01),
        (Damage(0.2, 0.1, torn=True), 0.06),
    ],
)
def test_nearly_every_node_finds_its_place_and_hardly_any_a_wrong_one(recogniser, damage, most_wrong):
    right = wrong = total = 0
    for index in range(6):
        graph = damage_graph(np.random.default_rng([9, index]), CODES, damage, index % 4, 0.5)
        assignment = recogniser.assign(graph.as_grid())
        assert assignment.turn == graph.turn
        same = (assignment.place == graph.place).all(-1)
        right, total = right + same.sum(), total + len(same)
        wrong += (~same & assignment.known).sum()
    assert right > 0.93 * total and wrong <= most_wrong * total


# A refused capture is told the causes that it has, each by its own measurement, and no others.


CAUSES = {
    "another pattern": "it shows another pattern",
    "mirrored": "is mirrored:",
    "blurred": "is blurred:",
    "too dark": "is too dark",
    "saturated": "is saturated:",
    "out of view": "is out of view",
    "too weak": "is too weak",
}


@pytest.fixture(scope="module")
def radiance():
    return make_setup(SynthConfig(resolution=280, frames=2, seed=3)).render(0, 2).radiance


@pytest.fixture(scope="module")
def decoders():
    """The one of the pattern that is seen, and that of another one."""
    codes = np.random.default_rng(8).integers(0, 5, (40, 40)).astype(np.int8)
    return {"right": GridImageDecoder(GridPattern()), "other": GridImageDecoder(GridPattern(codes=codes))}


def capture(radiance, gain=1.05, blur=0.0, turned=False):
    light = cv2.GaussianBlur(radiance, (0, 0), blur) if blur > 0 else radiance
    image = disturb_image(light, gain, 0.012, np.random.default_rng(0))
    return np.ascontiguousarray(image[:, ::-1]) if turned else image


def causes_told(decoder, image):
    with pytest.raises(DecodingError) as caught:
        decoder.decode(image)
    assert caught.value.remedy
    words = caught.value.cause
    found = {name for name, part in CAUSES.items() if part in words}
    assert found or "not known" in words
    return found


@pytest.mark.parametrize(
    ("decoder", "fault", "told", "perhaps"),  # of two faults one may hide the other
    [
        ("right", {"turned": True}, {"mirrored"}, {}),
        ("right", {"blur": 3.0}, {"blurred"}, {}),
        ("right", {"gain": 0.012}, {"too dark"}, {}),
        ("right", {"gain": 40.0}, {"saturated"}, {}),
        ("right", {"gain": 10.0, "turned": True}, {"mirrored", "saturated"}, {}),
        ("right", {"gain": 0.02, "blur": 3.0}, {}, {"too dark", "blurred"}),
        ("other", {}, {"another pattern"}, {}),
        ("other", {"turned": True}, {"another pattern"}, {}),
        ("other", {"gain": 0.012}, {"too dark"}, {}),  # its symbols cannot be read
        ("other", {"gain": 10.0}, {}, {"another pattern", "saturated"}),
    ],
)
@pytest.mark.slow
def test_every_fault_is_told_and_none_is_made_up(decoders, radiance, decoder, fault, told, perhaps):
    assert set(told) <= causes_told(decoders[decoder], capture(radiance, **fault)) <= {*told, *perhaps}


def test_a_scene_without_the_pattern_is_out_of_view(decoders):
    scene = np.full((240, 300), 60, np.uint8)
    cv2.circle(scene, (120, 100), 60, (150,), -1)
    cv2.rectangle(scene, (200, 30), (260, 200), (20,), -1)
    noise = np.random.default_rng(0).normal(0, 1.5, scene.shape)
    assert causes_told(decoders["right"], np.clip(scene + noise, 0, 255).astype(np.uint8)) == {"out of view"}


@pytest.mark.parametrize("texture", ["checks", "noise", "bricks"])
@pytest.mark.slow
def test_texture_behind_the_object_is_no_reason_to_refuse(decoders, texture):
    truth = make_setup(SynthConfig(resolution=280, frames=2, seed=3)).render(1, 2)
    y, x = np.mgrid[:280, :280]
    behind = {
        "checks": (x // 7 + y // 7) % 2,
        "noise": cv2.GaussianBlur(np.random.default_rng(0).normal(0.5, 2, (280, 280)), (0, 0), 1.5),
        "bricks": ((x + 9 * (y // 10 % 2)) % 18 > 2) & (y % 10 > 1),
    }[texture]
    light = np.where(truth.mask, truth.radiance, 0.25 + 0.35 * np.clip(behind, 0, 1)).astype(np.float32)
    decoded = decoders["right"].decode(disturb_image(light, 1.05, 0.012, np.random.default_rng(0)))
    both = decoded.decoded & truth.mask
    error = np.linalg.norm(decoded.coords[both] - truth.coords[both], axis=-1)
    assert both.sum() > 0.75 * truth.mask.sum() and (error > 10).mean() < 0.02
    assert (decoded.decoded & ~truth.mask).sum() < 0.08 * both.sum()


def test_noise_and_contrast_are_measured():
    rng, x = np.random.default_rng(0), np.arange(300, dtype=np.float32)
    wave = np.broadcast_to(0.4 + 0.1 * np.sin(2 * np.pi * x / 14), (300, 300)).astype(np.float32)
    noisy = wave + rng.normal(0, 0.02, wave.shape).astype(np.float32)
    assert measure_noise(noisy) == pytest.approx(0.02, rel=0.1)
    exposure = measure_exposure(noisy)
    assert exposure.contrast == pytest.approx(0.1 / np.sqrt(2), rel=0.15)
    assert exposure.saturated == 0 and exposure.bright == pytest.approx(0.5, abs=0.06)
    noisy[:75] = 1
    assert measure_exposure(noisy).saturated == pytest.approx(0.25)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
def test_the_width_of_edges_is_measured(sigma):
    image = np.zeros((200, 200), np.float32)
    image[:, 100:] = 0.7
    blurred = cv2.GaussianBlur(image, (0, 0), sigma) + np.random.default_rng(0).normal(0, 0.004, image.shape)
    assert edge_width(blurred.astype(np.float32)) == pytest.approx(sigma, rel=0.2)


@pytest.mark.parametrize("sigma", [0.06, 0.12, 0.2])
def test_the_blur_of_lines_is_measured(sigma):
    pattern = GridPattern(w=400, h=400)
    drawn = cv2.GaussianBlur(pattern.render(), (0, 0), sigma * pattern.period)
    image = (0.1 + 0.6 * drawn + np.random.default_rng(0).normal(0, 0.01, drawn.shape)).astype(np.float32)
    rectified = rectify(image, GridAppearance(pattern.period, 0.0))
    maps = maps_of(rectified, 14.0, 0.0)
    maps = replace(maps, vector=-maps.vector)  # the first node lies half a period from the corner
    measured = line_blur(rectified, maps, maps.mask > 0, pattern)
    assert measured == pytest.approx(sigma, abs=0.03)


def test_symbols_are_readable_only_in_a_consistent_grid_of_all_five():
    _, cells, neighbour = lattice(8, 9)
    place = np.array(cells, dtype=np.float32)[:, ::-1]
    symbol = np.random.default_rng(1).integers(0, 5, len(cells))
    certain = np.eye(5, dtype=np.float32)[symbol]
    assert shows_readable_symbols(GridGraph(place, neighbour, certain))
    assert not shows_readable_symbols(GridGraph(place, neighbour, 0.2 + 0.2 * (certain - 0.2)))  # uncertain
    assert not shows_readable_symbols(GridGraph(place, neighbour, np.eye(5, dtype=np.float32)[symbol % 2]))
    assert not shows_readable_symbols(GridGraph(place, np.full_like(neighbour, -1), certain))
