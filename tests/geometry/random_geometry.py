"""Random motions, devices and points for property tests: float64, any batch shape, reproducible from a seed."""

import torch
from hypothesis import strategies as st
from torch import Tensor

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import exp_se3

BATCHES = [(), (1,), (3, 1, 2)]
seeds = st.integers(0, 2**31 - 1)
batches = st.sampled_from(BATCHES)
# Rotation angles: ordinary ones, values at which a formula changes, values next to 0 and to pi.
angles = st.one_of(
    st.floats(0.0, 3.1),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-9, 1e-6, 1e-5, 1.1e-5, 1e-3, 0.2999999, 0.3, 0.3000001]),
    st.sampled_from([torch.pi - d for d in (1e-3, 1e-6, 1e-9, 1e-12)]),
)


def generator(seed: int) -> torch.Generator:
    """A seeded source of random numbers."""
    return torch.Generator().manual_seed(seed)


def directions(batch: tuple[int, ...], source: torch.Generator) -> Tensor:
    """Unit vectors (*batch, 3)."""
    d = torch.randn(*batch, 3, generator=source, dtype=torch.float64)
    return d / d.norm(dim=-1, keepdim=True)


def twists(batch: tuple[int, ...], angle: float, source: torch.Generator) -> Tensor:
    """Twists (*batch, 6) of one rotation angle, translations of order 1."""
    v = torch.randn(*batch, 3, generator=source, dtype=torch.float64)
    return torch.cat([v, angle * directions(batch, source)], -1)


def motions(batch: tuple[int, ...], source: torch.Generator, angle: float = 1.0) -> Tensor:
    """Rigid motions (*batch, 4, 4)."""
    return exp_se3(twists(batch, angle, source))


DEVICES = {
    "pinhole": Device(800, 600, 900.0, 950.0, 410.0, 290.0),
    "lens": Device(800, 600, 900.0, 950.0, 410.0, 290.0, k1=-0.21, k2=0.06, p1=1.5e-3, p2=-2e-3),
    "DOE": Device(800, 600, 700.0, 720.0, 390.0, 310.0, model="DOE"),
    "DOE with a lens": Device(800, 600, 700.0, 720.0, 390.0, 310.0, k1=0.12, k2=-0.03, p1=-1e-3, p2=2e-3, model="DOE"),
}


def points_in_view(batch: tuple[int, ...], source: torch.Generator) -> Tensor:
    """Points (*batch, 3) in device axes that every device of DEVICES sees, 1 to 3 away."""
    xy = torch.rand(*batch, 2, generator=source, dtype=torch.float64) * 0.6 - 0.3
    z = -1 - 2 * torch.rand(*batch, 1, generator=source, dtype=torch.float64)
    return torch.cat([-xy * z, z], -1)
