"""Stated uncertainty against the actual errors, over many noisy scans of one scene."""

from math import radians

import pytest
import torch
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.adjust import adjust
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.covariance import inverted
from sl_nerfstudio.bundle_adjustment.gauge import gauge_directions
from sl_nerfstudio.bundle_adjustment.priors import PosePrior
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings
from sl_nerfstudio.geometry.se3 import inverse, log_se3

from .analytic import images_of, rig_of

FRAMES, SIZE, SCANS = 4, 100, 10
SIGMAS = (0.03, radians(1.0), 0.01, radians(0.3))
PRIOR = PosePrior(*(torch.full((FRAMES,), s, dtype=torch.float64) for s in SIGMAS), intrinsics=0.0)
SETTINGS = AdjustmentSettings(anchors_per_frame=150, frames_per_anchor=3, max_iterations=8)


def independent(generator: torch.Generator) -> Tensor:
    """The errors of all pixels are independent."""
    return 0.5 * torch.randn(FRAMES, SIZE, SIZE, 2, generator=generator)


def smooth(generator: torch.Generator) -> Tensor:
    """Errors are shared by whole corners of images, as with a lens that is modelled slightly wrong."""
    coarse = 0.3 * torch.randn(FRAMES, 2, 6, 6, generator=generator)
    return torch.nn.functional.interpolate(coarse, (SIZE, SIZE), mode="bicubic").permute(0, 2, 3, 1)


@pytest.mark.parametrize("errors", [independent, smooth])
def test_errors_of_frames_are_as_large_as_stated(errors):
    true = rig_of(FRAMES, SIZE)
    images = images_of(true, SIZE)
    generator = torch.Generator().manual_seed(0)
    found = []
    for _ in range(SCANS):
        noisy = [image + e for image, e in zip(images, errors(generator), strict=True)]
        one = adjust(true, CoordinateMaps.of(noisy), PRIOR, "known-rig", SETTINGS)
        delta = log_se3(one.rig.T_world_camera @ inverse(true.T_world_camera)).reshape(-1)
        G = gauge_directions(one.rig)[: 6 * FRAMES]
        off = delta - G @ torch.linalg.lstsq(G, delta).solution
        found.append(off / one.covariance.diagonal()[: 6 * FRAMES].sqrt())
    rms = float(torch.stack(found).pow(2).mean().sqrt())
    assert 0.4 < rms < 2.5


@pytest.mark.parametrize("size", [1, 7, 600])
def test_the_inverse_in_place(size):
    A = torch.randn(size, size + 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    H = A @ A.T
    wanted, found = torch.linalg.inv(H), inverted(H)
    assert torch.allclose(found, wanted, rtol=0, atol=1e-9 * float(wanted.abs().max()))
    assert torch.equal(found, found.T) and found.data_ptr() == H.data_ptr()
    with pytest.raises(ArithmeticError, match="order 1"):
        inverted(-torch.eye(3, dtype=torch.float64))


def test_sums_with_random_signs_state_the_same_sigma(monkeypatch):
    """As for scans of many frames."""
    true = rig_of(FRAMES, SIZE)
    maps = CoordinateMaps.of(image + smooth(torch.Generator().manual_seed(1))[0] for image in images_of(true, SIZE))
    exact = adjust(true, maps, PRIOR, "free", SETTINGS).sigma
    monkeypatch.setattr("sl_nerfstudio.bundle_adjustment.covariance._MOST_BLOCKS", 0)
    found = adjust(true, maps, PRIOR, "free", SETTINGS).sigma
    assert not torch.equal(found, exact) and ((found / exact).log().abs() < 0.2).all()
