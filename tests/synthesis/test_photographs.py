"""Captures as photographs: files, repeatability, agreement with the truth, useless frames; plain ones as before."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.scan.check import check_scan
from sl_nerfstudio.scan.images import as_grey, read_image
from sl_nerfstudio.synthesis.appearance import HARD, REALISTIC
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import pixels
from sl_nerfstudio.synthesis.photograph import Shot, choose_useless, plan_shots, turn_away
from sl_nerfstudio.synthesis.synthesise import make_setup, synthesise

_CONFIG = SynthConfig(frames=8, resolution=90, seed=6, images_only=True, supersampling=1)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """One set of each appearance, on a table."""
    root = tmp_path_factory.mktemp("captures")
    for appearance in ("plain", "realistic", "hard"):
        synthesise(replace(_CONFIG, appearance=appearance, background="table"), root / appearance)
    return root


def _usable(root):
    return [frame["usable"] for frame in json.loads((root / "ground_truth/captures.json").read_text())["frames"]]


@pytest.mark.slow
def test_photographs_are_jpegs_in_colour_that_the_truth_shows_too(captures):
    for appearance in ("realistic", "hard"):
        files = sorted((captures / appearance / "images").iterdir())
        assert [f.name for f in files] == [f"frame_{n:05d}.jpg" for n in range(8)]
        for file in files:
            image = read_image(file)
            assert image.shape == (90, 90, 3) and image.dtype == np.uint8
            shown = read_image(captures / appearance / "ground_truth/images" / f"{file.stem}.png")
            assert np.abs(shown.astype(int) - image).max() <= 2, "two JPEG decoders may round differently"
        assert np.abs(image[..., 0].astype(int) - image[..., 2]).max() > 3, "grey"


@pytest.mark.slow
def test_the_truth_is_that_of_the_plain_scan_except_where_a_frame_looks_away(captures):
    plain = read_scan(captures / "plain/ground_truth")
    assert _usable(captures / "plain") == [True] * 8
    for appearance in ("realistic", "hard"):
        other = read_scan(captures / appearance / "ground_truth")
        away = 0
        for a, b in zip(plain.frames, other.frames, strict=True):
            if np.array_equal(a.T_world_camera, b.T_world_camera):
                np.testing.assert_array_equal(a.read_coords(), b.read_coords())
            else:
                away += 1
        assert away <= sum(not usable for usable in _usable(captures / appearance))


@pytest.mark.slow
def test_the_pattern_is_where_the_coordinates_say(captures):
    """The pattern, looked up at the coordinates, explains the local contrast of the usable images."""
    pattern = cv2.GaussianBlur(as_grey(read_image(captures / "realistic/pattern.png")), (0, 0), 3.0)
    agreement = []
    for appearance in ("realistic", "hard"):
        truth = read_scan(captures / appearance / "ground_truth")
        for frame, usable in zip(truth.frames, _usable(captures / appearance), strict=True):
            if not usable:
                continue
            grey, coords, mask = as_grey(frame.read_image()), frame.read_coords(), frame.read_mask()
            at = np.where(mask[..., None], coords, 0).astype(np.float32)
            shown = cv2.remap(pattern, at[..., 0] - 0.5, at[..., 1] - 0.5, cv2.INTER_LINEAR)
            local = [v - cv2.GaussianBlur(v, (0, 0), 2.5) for v in (grey, shown)]
            inner = cv2.erode(mask.astype(np.uint8), np.ones((7, 7))) > 0
            agreement.append(np.corrcoef(local[0][inner], local[1][inner])[0, 1])
    assert np.median(agreement) > 0.5 and min(agreement) > 0.15


@pytest.mark.slow
def test_same_flags_same_bytes_and_another_seed_another_look(tmp_path, captures):
    config = replace(_CONFIG, appearance="realistic", background="table", frames=8)
    synthesise(config, tmp_path / "again")
    for n in (0, 3, 7):
        name = f"images/frame_{n:05d}.jpg"
        assert (tmp_path / "again" / name).read_bytes() == (captures / "realistic" / name).read_bytes()
    looks = [make_setup(replace(config, seed=seed, frames=2)).photography.look for seed in (6, 7)]
    assert looks[0].gamma != looks[1].gamma and looks[0].lens != looks[1].lens
    assert not np.array_equal(looks[0].material.base, looks[1].material.base)


def test_a_scan_of_photographs_is_faultless(tmp_path):
    """Scans have no useless frames, because every frame of a scan must have coordinates."""
    config = SynthConfig(frames=5, resolution=80, seed=2, appearance="hard", background="walls", supersampling=1)
    synthesise(config, tmp_path / "scan")
    assert check_scan(tmp_path / "scan") == []
    scan = read_scan(tmp_path / "scan")
    assert all(np.isfinite(frame.read_coords()).any() for frame in scan.frames)
    assert scan.frames[0].read_image().shape == (80, 80, 3)


@pytest.mark.parametrize(("ranges", "least", "most"), [(REALISTIC, 1, 2), (HARD, 4, 4)])
def test_useless_frames_are_few_and_never_the_first(ranges, least, most):
    for seed in range(20):
        useless = choose_useless(40, ranges, np.random.default_rng(seed))
        assert least <= len(useless) <= most and 0 not in useless and max(useless) < 40


def test_shots_vary_and_the_spoiled_ones_say_why():
    rngs = [np.random.default_rng([1, n]) for n in range(60)]
    shots = plan_shots(HARD, rngs, frozenset(range(0, 60, 2)))
    assert len({shot.exposure for shot in shots}) == 60
    assert all(HARD.exposure[0] <= shot.exposure <= HARD.exposure[1] for shot in shots)
    assert all(shot.fault is None and shot.motion <= HARD.motion[1] for shot in shots[1::2])
    faults = [shot.fault for shot in shots[::2]]
    assert set(faults) == {"object out of view", "blurred by motion"}
    assert all(shot.motion >= HARD.shake[0] for shot in shots if shot.fault == "blurred by motion")


def test_a_camera_that_looks_away_does_not_show_the_object():
    setup = make_setup(SynthConfig(frames=30, resolution=64, seed=1))
    shots = (Shot(1.0, 0.0, 0.0, 90, "object out of view"),) * 29 + (Shot(1.0, 0.0, 0.0, 90),)
    turned = turn_away(setup.truth, shots, [np.random.default_rng([5, n]) for n in range(30)])
    assert np.array_equal(turned.T_world_camera[:, :3, 3], setup.truth.T_world_camera[:, :3, 3])
    assert np.array_equal(turned.T_world_projector, setup.truth.T_world_projector)
    seen = [pixels(setup.devices.camera, T, setup.scene.vertices)[1].any() for T in turned.T_world_camera]
    assert seen == [False] * 29 + [True]
