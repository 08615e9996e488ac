"""What was trained and comes with the package."""

from pathlib import Path

import torch
from safetensors.torch import load_file

from sl_nerfstudio.decoding.grid.edges.network import EdgeNetwork
from sl_nerfstudio.decoding.grid.gcn import GraphNetwork
from sl_nerfstudio.decoding.grid.unet import UNet

_WEIGHTS = Path(__file__).parent / "weights"


def load_unet() -> UNet:
    """The trained U-Net, in evaluation mode."""
    network = UNet()
    network.load_state_dict(_weights("unet"))
    return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def load_graph_network() -> GraphNetwork:
    """The trained graph network, in evaluation mode."""
    network = GraphNetwork()
    network.load_state_dict(_weights("gcn"))
    return network.eval()


def load_edge_network() -> EdgeNetwork:
    """The trained edge network, in evaluation mode."""
    network = EdgeNetwork()
    network.load_state_dict(_weights("edges"))
    return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def weight_files() -> list[Path]:
    """All files of weights, sorted by name."""
    return sorted(_WEIGHTS.glob("*.safetensors"))


def _weights(name: str) -> dict[str, torch.Tensor]:
    return load_file(_WEIGHTS / f"{name}.safetensors")
