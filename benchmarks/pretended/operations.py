"""What torch's operations do on a GPU: which launch nothing, and which make the host wait."""

from typing import Any

import torch

_NO_LAUNCH = set(
    [
        "alias",
        "as_strided",
        "detach",
        "diagonal",
        "empty",
        "empty_like",
        "empty_strided",
        "expand",
        "is_same_size",
        "lift_fresh",
        "narrow",
        "new_empty",
        "new_empty_strided",
        "permute",
        "result_type",
        "select",
        "set_",
        "slice",
        "split",
        "split_with_sizes",
        "squeeze",
        "squeeze_",
        "t_",
        "transpose_",
        "unsqueeze_",
        "sym_numel",
        "sym_size",
        "sym_stride",
        "t",
        "transpose",
        "unbind",
        "unfold",
        "unsqueeze",
        "view",
        "_reshape_alias",
        "_unsafe_view",
    ]
)

_READ, _COUNTED = "a value read by the host", "a result as long as its values say"
_WAITS = {
    **dict.fromkeys(("_local_scalar_dense", "item", "is_nonzero", "equal", "nanmedian"), _READ),
    **dict.fromkeys(("nonzero", "masked_select", "bincount", "repeat_interleave"), _COUNTED),
    **dict.fromkeys(("_unique", "_unique2", "unique_dim", "unique_consecutive"), _COUNTED),
}

_TAKE_SCALARS = set(
    [
        "copy_",
        "fill_",
        "index_put_",
        "index_put",
        "_index_put_impl_",
        "masked_fill_",
        "masked_fill",
        "where",
        "lerp",
        "lerp_",
        "_foreach_add_",
    ]
)
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
