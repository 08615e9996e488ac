"""The trained networks that come with the package."""

from importlib.resources import as_file, files

import torch
from safetensors.torch import load_file

from sl_nerfstudio.decoding.grid.gcn import GraphNetwork
from sl_nerfstudio.decoding.grid.unet import UNet


def load_unet() -> UNet:
    """The U-Net as shipped, ready to read."""
    network = UNet()
    network.load_state_dict(_weights("unet"))
    return network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def load_graph_network() -> GraphNetwork:
    """The graph network as shipped."""
    network = GraphNetwork()
    network.load_state_dict(_weights("gcn"))
    return network.eval()


def _weights(name: str) -> dict[str, torch.Tensor]:
    with as_file(files("sl_nerfstudio.decoding.grid") / "weights" / f"{name}.safetensors") as path:
        return load_file(path)
