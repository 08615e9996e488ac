"""Dataclasses with arrays as bytes, exactly, and without pickle: reading them runs no code."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from io import BytesIO
from typing import Any, TypeVar

import numpy as np
import torch
from numpy import ndarray

T = TypeVar("T")
_TREE = "tree"  # name of the archive's member that is no array


def encode(value: object) -> bytes:
    """Dataclasses, tuples, lists, arrays, tensors, numbers and texts as an archive. Raises TypeError for others."""
    arrays: list[ndarray] = []
    tree = json.dumps(_flat(value, arrays))
    buffer = BytesIO()
    members = {f"array{k}": array for k, array in enumerate(arrays)}
    np.savez_compressed(buffer, **{_TREE: np.frombuffer(tree.encode(), np.uint8)}, **members)
    return buffer.getvalue()


def decode(content: bytes, classes: Sequence[type]) -> Any:
    """The value that was encoded; its dataclasses must be among `classes`. Raises KeyError for another one."""
    with np.load(BytesIO(content), allow_pickle=False) as archive:
        tree = json.loads(archive[_TREE].tobytes())
        arrays = [archive[f"array{k}"] for k in range(len(archive.files) - 1)]
    return _built(tree, arrays, {kind.__name__: kind for kind in classes})


def with_arrays(value: T, classes: Sequence[type], change: Callable[[Sequence[ndarray]], Sequence[ndarray]]) -> T:
    """The same value with other arrays in place of its own; `classes` as for `decode`."""
    arrays: list[ndarray] = []
    tree = _flat(value, arrays)
    return _built(tree, change(arrays), {kind.__name__: kind for kind in classes})


def digest(value: object) -> str:
    """A text that is equal for equal values only."""
    arrays: list[ndarray] = []
    found = hashlib.sha256(json.dumps(_flat(value, arrays)).encode())
    for array in arrays:
        found.update(f"{array.dtype.str} {array.shape} ".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.hexdigest()


def _flat(value: Any, arrays: list[ndarray]) -> Any:
    """JSON for a value; its arrays are added to `arrays`, and their numbers stand for them."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, ndarray | torch.Tensor):
        arrays.append(value if isinstance(value, ndarray) else value.detach().cpu().numpy())
        return {"array" if isinstance(value, ndarray) else "tensor": len(arrays) - 1}
    if isinstance(value, tuple | list):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [_flat(item, arrays) for item in value]}
    if is_dataclass(value) and not isinstance(value, type):
        content = {field.name: _flat(getattr(value, field.name), arrays) for field in fields(value)}
        return {"class": type(value).__name__, "fields": content}
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _built(tree: Any, arrays: Sequence[ndarray], classes: dict[str, type]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "class" in tree:
        kind = classes[tree["class"]]
        return kind(**{name: _built(item, arrays, classes) for name, item in tree["fields"].items()})
    ((kind, content),) = tree.items()
    if kind in ("tuple", "list"):
        items = [_built(item, arrays, classes) for item in content]
        return tuple(items) if kind == "tuple" else items
    return torch.from_numpy(arrays[content]) if kind == "tensor" else arrays[content]
