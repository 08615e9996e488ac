"""The networks that read images of a coded grid, here on the CPU or for all processes on one GPU."""

import threading
from multiprocessing import get_context
from multiprocessing.managers import BaseManager, RemoteError
from typing import Protocol, runtime_checkable

from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.decoding.grid_edges import load_edge_network, load_unet
from sl_nerfstudio.decoding.grid_phases import Maps, NetworkOnDevice
from sl_nerfstudio.errors import UserError, first_line, last_line
from sl_nerfstudio.parallel import DeviceName, end_with_parent, no_interrupts


@runtime_checkable
class ImageNetworks(Protocol):
    """Both networks as functions of arrays (`Maps`)."""

    def unet(self, channels: Float32[ndarray, "c h2 w2"]) -> Float32[ndarray, "h w outputs"]:
        """Outputs of the U-Net."""
        ...

    def edges(self, channels: Float32[ndarray, "c h2 w2"]) -> Float32[ndarray, "h w outputs"]:
        """Outputs of the edge network."""
        ...


class LoadedNetworks:
    """The trained networks on one device, for one image at a time, which bounds the memory that they take there."""

    def __init__(self, device: DeviceName = "cpu") -> None:
        self._device = device
        self._unet, self._edges = NetworkOnDevice(load_unet(), device), NetworkOnDevice(load_edge_network(), device)
        self._one = threading.Lock()

    def unet(self, channels: Float32[ndarray, "c h2 w2"]) -> Float32[ndarray, "h w outputs"]:
        """See `ImageNetworks`. Raises UserError if a GPU fails."""
        return self._applied(self._unet, channels)

    def edges(self, channels: Float32[ndarray, "c h2 w2"]) -> Float32[ndarray, "h w outputs"]:
        """See `ImageNetworks`. Raises UserError if a GPU fails."""
        return self._applied(self._edges, channels)

    def _applied(self, network: Maps, channels: Float32[ndarray, "c h2 w2"]) -> Float32[ndarray, "h w outputs"]:
        try:
            with self._one:
                return network(channels)
        except RuntimeError as error:
            if self._device == "cpu":
                raise
            raise _failed(first_line(error)) from error


def _failed(why: str) -> UserError:
    return UserError(
        f"the networks that read photographs fail on the GPU: {why}\n"
        "    cause:  other programs use its memory, or its driver fails\n"
        "    remedy: give --device cpu; frames decoded so far are kept"
    )


class _Server(BaseManager):
    """A process that has the networks; what is sent to other processes leads to it."""


_Server.register("networks", LoadedNetworks, exposed=("unet", "edges"))


def networks_for_all_processes(device: DeviceName) -> ImageNetworks:
    """The networks on a device that is opened once, by a process of its own that ends with this one.

    They can be given to processes that this one starts. Of a GPU's memory they take what one process and one image
    need. Raises UserError if they cannot be loaded there.
    """
    server = _Server(ctx=get_context("spawn"))
    with no_interrupts():
        server.start(end_with_parent)
    try:
        return server.networks(device)  # type: ignore[attr-defined]
    except RemoteError as error:
        raise _failed(last_line(error)) from error
