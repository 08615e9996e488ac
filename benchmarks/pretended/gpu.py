"""The pretended GPU: computes on the CPU, checks devices as CUDA does, and writes down what a GPU would do."""

import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

from sl_nerfstudio.field import device_kernels
from sl_nerfstudio.parallel import gpu_fault, gpu_found

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
        """True, as on a GPU."""
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


_NO_LAUNCH = {
    "alias", "as_strided", "detach", "diagonal", "empty", "empty_like", "empty_strided", "expand", "is_same_size",
    "lift_fresh", "narrow", "new_empty", "new_empty_strided", "permute", "result_type", "select", "set_", "slice",
    "split", "split_with_sizes", "squeeze", "squeeze_", "t_", "transpose_", "unsqueeze_", "sym_numel", "sym_size",
    "sym_stride", "t", "transpose", "unbind", "unfold", "unsqueeze", "view", "_reshape_alias", "_unsafe_view",
}  # fmt: skip

_READ, _COUNTED = "a value read by the host", "a result as long as its values say"
_WAITS = {
    **dict.fromkeys(("_local_scalar_dense", "item", "is_nonzero", "equal", "nanmedian"), _READ),
    **dict.fromkeys(("nonzero", "masked_select", "bincount", "repeat_interleave"), _COUNTED),
    **dict.fromkeys(("_unique", "_unique2", "unique_dim", "unique_consecutive"), _COUNTED),
}

_TAKE_SCALARS = {
    "copy_", "fill_", "index_put_", "index_put", "_index_put_impl_", "masked_fill_", "masked_fill", "where", "lerp",
    "lerp_", "_foreach_add_",
}  # fmt: skip
_INDEXED = {"index", "index_put_", "index_put", "_index_put_impl_", "_unsafe_index"}


def name_of(func: Any) -> str:
    """Its name without overload and namespace."""
    return func._schema.name.split("::")[-1]


def launches(func: Any) -> bool:
    """Whether it starts a kernel or a copy on the device."""
    return name_of(func) not in _NO_LAUNCH and not func.is_view


def takes_scalars_of_the_cpu(func: Any) -> bool:
    """Whether a CPU tensor without dimensions may be among tensors of a GPU."""
    return torch.Tag.pointwise in func.tags or name_of(func) in _TAKE_SCALARS


def indexes(func: Any) -> bool:
    """Whether its second argument is a list of indices, which may be on the CPU."""
    return name_of(func) in _INDEXED


def wait_of(func: Any, args: tuple[Any, ...]) -> str | None:
    """Why the host waits for the device in it, None if it does not."""
    if indexes(func) and any(index is not None and index.dtype in (torch.bool, torch.uint8) for index in args[1]):
        return "indexing with a mask"
    return _WAITS.get(name_of(func))


_OWN = "sl_nerfstudio"
_FACTORIES = {"arange", "eye", "full", "linspace", "ones", "scalar_tensor", "zeros"}
_KERNEL_RUN = device_kernels.run


class MixedDevicesError(RuntimeError):
    """An operation got tensors of two devices, which CUDA refuses."""


class Stream:
    """Copies on any other stream than the usual one are made as late as a GPU may make them: when it is waited for."""

    def __init__(self) -> None:
        self.queued: list[Callable[[], Any]] = []

    def wait_stream(self, other: "Stream") -> None:
        """Let what comes next on this stream see what the other one has done."""
        for copy in other.queued:
            copy()
        other.queued.clear()


@dataclass
class Seen:
    """What a GPU would have done."""

    launches: Counter[str] = field(default_factory=Counter)
    """Operations that launch a kernel or a copy, by name."""
    waits: Counter[str] = field(default_factory=Counter)
    """Why and where the host waited for the device, or copied from pageable memory."""


class PretendedGpu(TorchDispatchMode):
    """Use as a context. `seen` counts from the start or from the last `counting()`."""

    def __init__(self, kernels: bool = False, dry: bool = False) -> None:
        """`kernels`: those in Triton run, too, interpreted; otherwise none can be compiled.

        If `dry`, they are only counted: what they should have written is left as it was.
        """
        super().__init__()
        self.seen = Seen()
        self.on_kernel: list[Callable[[Callable[[], None]], None]] = []
        """Told of every kernel in Triton, as what runs it again."""
        self._kernels = kernels
        self._dry = dry
        self._functions = _Functions(self)
        self.works_there = False  # in an operation on the GPU, whose parts torch makes where it believes to be
        self.calls_factory = False  # for our own code, which says where
        self._stack = ExitStack()
        self._stream = self._usual_stream = Stream()

    def __enter__(self) -> "PretendedGpu":
        """Torch says that there is a GPU."""
        replaced: list[tuple[Any, str, Any]] = [
            (torch.cuda, "is_available", lambda: True), (torch.cuda, "device_count", lambda: 1),
            (torch.cuda, "mem_get_info", lambda *_: (8 << 30, 8 << 30)),
            (torch.cuda, "is_current_stream_capturing", lambda: False), (torch, "Generator", _Generator),
            (torch.cuda, "Stream", lambda *_: Stream()), (torch.cuda, "stream", self._on_stream),
            (torch.cuda, "current_stream", lambda *_: self._stream),
            (torch._C, "_group_tensors_by_device_and_dtype", _grouped(torch._C._group_tensors_by_device_and_dtype)),
            (torch.autograd, "_engine_run_backward", self._backward(torch.autograd._engine_run_backward)),
        ]  # fmt: skip
        replaced.append((device_kernels, "run", self._run_kernel))
        replaced.append((device_kernels, "_tried", lambda _: None if self._kernels else "a pretended GPU runs nothing"))
        for found in (gpu_found, gpu_fault):  # before and after it, something else is found
            found.cache_clear()
            self._stack.callback(found.cache_clear)
        for owner, name, stand_in in replaced:
            self._stack.enter_context(mock.patch.object(owner, name, stand_in))
        self._stack.enter_context(torch.autograd.set_multithreading_enabled(False))
        super().__enter__()
        self._functions.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._functions.__exit__(*error)
        super().__exit__(*error)
        self._stack.close()

    @contextmanager
    def counting(self) -> Iterator[Seen]:
        """Count only what happens inside."""
        before, self.seen = self.seen, Seen()
        try:
            yield self.seen
        finally:
            self.seen = before

    def _backward(self, run_engine: Callable[..., Any]) -> Callable[..., Any]:
        """torch's engine, which switches the mode of functions off, and calls functions of ours."""

        def run(outputs: Any, *args: Any, **kwargs: Any) -> Any:
            with self._functions, self.working(outputs):
                return run_engine(outputs, *args, **kwargs)

        return run

    @contextmanager
    def working(self, arguments: Any) -> Iterator[None]:
        """What torch makes inside is on the GPU, if any of the arguments is."""
        before = self.works_there
        self.works_there = any(isinstance(x, DeviceTensor) for x in arguments)
        try:
            yield
        finally:
            self.works_there = before

    @contextmanager
    def _on_stream(self, stream: "Stream") -> Iterator[None]:
        before, self._stream = self._stream, stream
        try:
            yield
        finally:
            self._stream = before

    def _run_kernel(
        self, kernel: Any, grid: tuple[int, ...], arguments: tuple[Any, ...], constants: dict[str, Any]
    ) -> None:
        tensors = [x for x in arguments if isinstance(x, Tensor)]
        there = [isinstance(x, DeviceTensor) for x in tensors]
        if any(there) and not all(there):
            at = [f"{x.device} {tuple(x.shape)}" for x in tensors]
            raise MixedDevicesError(f"{device_kernels.name_of(kernel)}: {at}")
        work = partial(_interpret, kernel, grid, tuple(on_cpu(x) for x in arguments), constants)
        if not self._dry:
            work()
        if any(there):
            self.seen.launches[f"triton {device_kernels.name_of(kernel)}"] += 1
            for told in [] if self._dry else self.on_kernel:
                told(work)

    def wait(self, why: str) -> None:
        """Note that the host waits for the device."""
        self.seen.waits[f"{why}: {_place()}"] += 1

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Compute with the values on the CPU."""
        kwargs = kwargs or {}
        tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, Tensor)]
        there = sum(isinstance(x, DeviceTensor) for x in tensors)
        if there and self._stream is not self._usual_stream and name_of(func) == "copy_":
            self._check(func, args, tensors)
            self._stream.queued.append(partial(func, *tree_map(on_cpu, args), **kwargs))
            self.seen.launches["copy_"] += 1
            return args[0]
        out = func(*tree_map(on_cpu, args), **tree_map(on_cpu, kwargs))
        if there == 0:
            made = self.works_there and not self.calls_factory and name_of(func) in _FACTORIES
            return tree_map(on_gpu, out) if made else out
        self._check(func, args, tensors)
        if launches(func):
            self.seen.launches[name_of(func)] += 1
        why = wait_of(func, args)
        if why is not None:
            self.wait(why)
        if name_of(func) == "copy_" and not isinstance(args[0], DeviceTensor):
            return args[0]
        return return_and_correct_aliasing(func, args, kwargs, tree_map(on_gpu, out))

    def _check(self, func: Any, args: Any, tensors: list[Tensor]) -> None:
        others = [x for x in tensors if not isinstance(x, DeviceTensor)]
        if not others:
            return
        if name_of(func) == "copy_":
            if not (len(args) > 2 and args[2] and all(getattr(x, "pinned", False) for x in others)):
                self.wait("a copy between host and device")
            return
        if indexes(func) and isinstance(args[0], DeviceTensor):
            mine = {id(x) for x in args[1] if x is not None}
            if any(id(x) in mine for x in others):
                self.wait("indices copied to the device")
            others = [x for x in others if id(x) not in mine]
        if others and not (takes_scalars_of_the_cpu(func) and all(x.dim() == 0 for x in others)):
            raise MixedDevicesError(f"{func}: {[f'{x.device} {tuple(x.shape)}' for x in tensors]}")


def _interpret(*launch: Any) -> None:
    """Run a kernel; what the interpreter does with torch is none of the GPU's business."""
    with _disable_current_modes(), torch._C.DisableTorchFunction():
        _KERNEL_RUN(*launch)


class _Functions(TorchFunctionMode):
    """Torch's functions with a device as an argument: they never reach CUDA."""

    def __init__(self, gpu: PretendedGpu) -> None:
        super().__init__()
        self._gpu = gpu

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Make, move and read tensors as on a GPU."""
        kwargs = dict(kwargs or {})
        if isinstance(func, torch._ops.OpOverload):  # called by another mode, below the functions of torch
            return func(*args, **kwargs)
        name = getattr(func, "__name__", "")
        if name in ("to", "cuda", "cpu") and args and isinstance(args[0], Tensor):
            return self._moved(func, name, args, kwargs)
        if name in ("tolist", "new_tensor") and isinstance(args[0], DeviceTensor):
            return self._read_or_uploaded(name, args, kwargs)
        device = kwargs.get("device")
        if device is None:
            with self._gpu.working(tree_leaves((args, kwargs))):
                return func(*args, **kwargs)
        kwargs["device"] = torch.device("cpu")
        self._gpu.calls_factory = True
        try:
            return self._made(func, name, torch.device(device).type == CUDA.type, args, kwargs)
        finally:
            self._gpu.calls_factory = False

    def _made(self, func: Callable[..., Any], name: str, wanted_there: bool, args: Any, kwargs: Any) -> Any:
        if name in ("tensor", "as_tensor"):
            made = func(*(on_cpu(x) if name == "as_tensor" else x for x in args), **kwargs)
            return self._upload(made) if wanted_there else made
        pinned = kwargs.pop("pin_memory", False)
        made = func(*args, **kwargs)
        made.pinned = pinned
        if not wanted_there:
            return self._read(made) if isinstance(made, DeviceTensor) else made
        if not isinstance(made, DeviceTensor):
            self._gpu.seen.launches[name] += name not in ("empty", "empty_strided")
        return _with_gradient(on_gpu(made), made)

    def _moved(self, func: Callable[..., Any], name: str, args: Any, kwargs: Any) -> Any:
        x, rest = args[0], list(args[1:])
        device, dtype = ({"cuda": CUDA, "cpu": torch.device("cpu")}.get(name)), kwargs.pop("dtype", None)
        kwargs.pop("non_blocking", None)
        copy = kwargs.pop("copy", False)
        device = kwargs.pop("device", device)
        for part in rest if name == "to" else []:
            if isinstance(part, str | torch.device | int) and not isinstance(part, bool):
                device = part
            elif isinstance(part, torch.dtype):
                dtype = part
            elif isinstance(part, Tensor):
                device, dtype = part.device, part.dtype
        there = isinstance(x, DeviceTensor) if device is None else torch.device(device).type == CUDA.type
        if dtype is not None or copy:
            x = func(x, *([dtype] if dtype is not None else []), **({"copy": True} if copy else {}))
        if there == isinstance(x, DeviceTensor):
            return x
        return self._upload(x) if there else self._read(x)

    def _read_or_uploaded(self, name: str, args: Any, kwargs: Any) -> Any:
        if name == "tolist":
            self._gpu.wait("values read by the host")
            return args[0].values.tolist()
        kwargs.pop("device", None)
        return self._upload(args[0].values.new_tensor(*args[1:], **kwargs))

    def _upload(self, x: Tensor) -> Tensor:
        self._gpu.wait("a copy to the device")
        self._gpu.seen.launches["copy to the device"] += 1
        return _Copy.apply(x, True)  # pyright: ignore

    def _read(self, x: Tensor) -> Tensor:
        self._gpu.wait("a copy to the host")
        self._gpu.seen.launches["copy to the host"] += 1
        return _Copy.apply(x, False)  # pyright: ignore


def _grouped(group: Callable[..., Any]) -> Callable[..., Any]:
    """torch's optimisers ask its compiled part on which devices tensors are."""

    def grouped(tensors: Any, with_indices: bool) -> Any:
        there = any(isinstance(x, DeviceTensor) for x in tensors[0])
        found = group(tensors, with_indices)
        return {(CUDA if there else device, dtype): value for (device, dtype), value in found.items()}

    return grouped


class _Generator(torch.Generator):
    """A generator of the CPU, wherever it was asked for."""

    def __new__(cls, *_: Any) -> "_Generator":
        return super().__new__(cls)


class _Copy(torch.autograd.Function):
    """A copy between the devices, differentiable."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, there: bool) -> Tensor:
        ctx.there = there
        return DeviceTensor(x.detach().clone()) if there else x.values.clone()  # pyright: ignore

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> Any:
        g = grad_outputs[0]
        return (g.values if ctx.there else DeviceTensor(g)), None  # pyright: ignore


def _with_gradient(made: Tensor, like: Tensor) -> Tensor:
    return made.requires_grad_() if like.requires_grad and not made.requires_grad else made


def _place() -> str:
    """The innermost lines of this package, of nerfstudio, or of torch, that asked for it."""
    frames = [f for f in traceback.extract_stack() if "/pretended/" not in f.filename]
    own = [f for f in frames if f"/{_OWN}/" in f.filename or "/nerfstudio/" in f.filename]
    at = (own or frames)[-1]
    return f"{'/'.join(at.filename.split('/')[-2:])}:{at.lineno} {at.line}"
