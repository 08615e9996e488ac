"""What single images show, and why others show nothing."""

import numpy as np
import pytest
import torch

from benchmarks.live import Stage, Step
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.live.sight import Eye, Fault, sampled


@pytest.fixture(scope="module")
def stage() -> Stage:
    return Stage("head", 0, (400, 300), lap=6)


@pytest.fixture(scope="module")
def eye(stage) -> Eye:
    return Eye(NetworkDecoder(stage.pattern), stage.devices.camera, stage.devices.projector)


@pytest.mark.parametrize("step", [1, 2, 3, 5])
def test_sampled_pixels_keep_their_rays(step):
    camera = Device(101, 64, 90.0, 95.0, 50.3, 31.7, 0.05, -0.01, 0.001, 0.002)
    few = sampled(camera, step)
    column, row = np.meshgrid(np.arange(few.w), np.arange(few.h))
    uv = np.stack([column, row], -1).reshape(-1, 2) + 0.5
    original = np.stack([column, row], -1).reshape(-1, 2) * step + step // 2 + 0.5
    assert original[:, 0].max() < camera.w and original[:, 1].max() < camera.h
    rays = [unproject(Intrinsics.of(d, torch.float64), torch.from_numpy(x)) for d, x in ((few, uv), (camera, original))]
    torch.testing.assert_close(rays[0], rays[1])


def test_a_frame_has_the_true_relative_pose_and_the_second_half_of_decoding_is_as_always(stage, eye):
    image = stage.image(Step(0), 0)
    sight = eye.look(image)
    assert sight.frame is not None and sight.fault is None and sight.sharp
    T_world_camera, T_world_projector = stage.poses_of(Step(0))
    truth = np.linalg.inv(T_world_camera) @ T_world_projector
    found = sight.cloud.pose.T_camera_projector
    cosine = (np.trace(found[:3, :3].T @ truth[:3, :3]) - 1) / 2
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 0.3
    direction = truth[:3, 3] / np.linalg.norm(truth[:3, 3])
    assert direction @ found[:3, 3] > np.cos(np.radians(0.5))
    assert sight.first is not None  # at full size
    whole, halves = eye.decoder.images.decode(image), eye.decoder.images.finished(sight.first)
    np.testing.assert_array_equal(whole.coords, halves.coords)


@pytest.mark.parametrize(
    ("image", "faults"),
    [
        (np.zeros((300, 400), dtype=np.uint8), {Fault.DARK}),
        (np.full((300, 400), 255, dtype=np.uint8), {Fault.BRIGHT}),
        (np.random.default_rng(0).integers(60, 200, (300, 400)).astype(np.uint8), {Fault.NO_PATTERN}),
    ],
)
def test_images_without_a_grid_say_why(eye, image, faults):
    sight = eye.look(image)
    assert sight.frame is None and sight.fault in faults


def test_a_blurred_image_is_called_so(stage, eye):
    sight = eye.look(stage.image(Step(0, blur_px=24.0), 0))
    assert sight.frame is None and sight.fault is Fault.BLURRED
