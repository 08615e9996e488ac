"""Tensors on the pretended GPU."""

from typing import Any

import torch
from torch import Tensor

CUDA = torch.device("cuda:0")


class DeviceTensor(Tensor):
    """A tensor that says it is on `cuda:0`; its values are in a CPU tensor, to which only `PretendedGpu` gets."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "DeviceTensor":
        """It shares the memory of the CPU tensor `values`."""
        made = Tensor._make_wrapper_subclass(
            cls, values.shape, strides=values.stride(), storage_offset=values.storage_offset(), dtype=values.dtype
        )
        made.values = values.detach()
        return made

    @property
    def device(self) -> torch.device:  # pyright: ignore
        """Where it pretends to be; torch's own code sees a tensor on the CPU."""
        return CUDA

    @property
    def is_cuda(self) -> bool:  # pyright: ignore
        """As on a GPU."""
        return True

    def numpy(self, *_: Any, **__: Any) -> Any:  # pyright: ignore
        """Raise TypeError, as on a GPU."""
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first")

    def __array__(self, *_: Any, **__: Any) -> Any:  # pyright: ignore
        self.numpy()

    def __repr__(self, **_: Any) -> str:  # pyright: ignore
        return f"DeviceTensor({self.values!r})"

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Files hold the values: they are read with `map_location="cpu"`."""
        return self.values.__reduce_ex__(protocol)

    def __tensor_flatten__(self) -> tuple[list[str], None]:
        return ["values"], None  # torch then exchanges a module's parameters for those on another device

    @staticmethod
    def __tensor_unflatten__(inner: dict[str, Tensor], _: None, size: Any, stride: Any) -> "DeviceTensor":
        return DeviceTensor(inner["values"])

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Only PretendedGpu computes with such tensors."""
        raise RuntimeError(f"{func} on the pretended GPU after it was switched off")


def on_cpu(x: Any) -> Any:
    """The values of a tensor, anything else as it is."""
    return x.values if isinstance(x, DeviceTensor) else x


def on_gpu(x: Any) -> Any:
    """A tensor as one of the pretended GPU, anything else as it is."""
    return DeviceTensor(x) if isinstance(x, Tensor) and not isinstance(x, DeviceTensor) else x
