"""Values kept between runs and on disk: decoded frames, dataclasses as bytes without pickle, clouds of many frames."""

import hashlib
import json
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, TypeVar
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Bool, Float16, Float32, UInt16
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Decoded, Decoder
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.registration.surfaces import FrameCloud
from sl_nerfstudio.relative_pose.estimation import Degeneracy, RelativePose
from sl_nerfstudio.scan.coordinates import ARRAY_DAMAGE
from sl_nerfstudio.scan.document import read_bytes
from sl_nerfstudio.scan.images import Pixels
from sl_nerfstudio.scan.write import encode_json
from sl_nerfstudio.storage import encode_npz, in_file, largest_in_memory, read_checked, write_atomic, write_checked

# Decoded frames that are kept between runs: only changed images, patterns or decoders need decoding again.

KEY_LENGTH = 24  # of a digest in a file name
MANIFEST = "manifest.json"
DECODED = "decoded"


class DecodedStore:
    """A folder of decoded frames; the name of each file contains a digest of what it was decoded from."""

    def __init__(self, root: Path, decoder_key: str) -> None:
        self.root = root
        self._decoder_key = decoder_key

    def key(self, frame: CapturedFrame) -> str:
        """Digest of the images' contents and of the decoder. Raises FileError if an image cannot be read."""
        digest = hashlib.sha256(f"{self._decoder_key} {frame.shrink}".encode())
        for path in frame.images:
            digest.update(hashlib.sha256(read_bytes(path)).digest())
        return digest.hexdigest()[:KEY_LENGTH]

    def load(self, frame: CapturedFrame, key: str) -> Decoded | None:
        """A frame that was decoded before; None if there is none, or if its file is damaged."""
        content = read_checked(self._path(frame, key))
        if content is None:
            return None
        with suppress(OSError):
            self._path(frame, key).touch()  # used: not among the oldest
        try:
            with np.load(BytesIO(content), allow_pickle=False) as stored:
                coords, mask, pattern = stored["coords"], stored["mask"], stored["pattern"]
                light, notes = stored.get("light"), tuple(map(str, stored.get("notes", ())))
        except (ValueError, KeyError, EOFError, BadZipFile):
            return None
        same = all(one.shape == mask.shape for one in (pattern, light) if one is not None)
        if coords.dtype != np.float32 or coords.shape != (*mask.shape, 2) or not same:
            return None
        return _restored(coords, mask, pattern, light, notes)

    def load_one(self, frame: CapturedFrame, key: str, name: Literal["mask", "image"]) -> ndarray | None:
        """One array of a frame that was decoded before, by its own check sum; None if it is missing or damaged."""
        try:
            with np.load(self._path(frame, key), allow_pickle=False) as stored:
                return stored[name]
        except ARRAY_DAMAGE:
            return None

    def save(self, frame: CapturedFrame, key: str, decoded: Decoded, image: Pixels | None = None) -> Decoded:
        """Store a frame, and return it as `load` will, so that a resumed run gives the same result.

        `image` is its photograph at the size that was decoded.
        """
        pattern = np.rint(65535 * decoded.pattern).astype(np.uint16)
        light = None if decoded.light is None else decoded.light.astype(np.float16)
        arrays = {"coords": decoded.coords, "mask": decoded.mask, "pattern": pattern, "light": light, "image": image}
        arrays["notes"] = np.array(decoded.notes, dtype=np.str_)
        content = encode_npz({name: array for name, array in arrays.items() if array is not None})
        write_checked(self._path(frame, key), content)
        return _restored(decoded.coords, decoded.mask, pattern, light, decoded.notes)

    def _path(self, frame: CapturedFrame, key: str) -> Path:
        return self.root / DECODED / f"{frame.name}-{key}.npz"


def _restored(
    coords: Float32[ndarray, "h w 2"],
    mask: Bool[ndarray, "h w"],
    pattern: UInt16[ndarray, "h w"],
    light: Float16[ndarray, "h w"] | None,
    notes: tuple[str, ...],
) -> Decoded:
    """What was decoded, with intensities as exact as they are stored."""
    values = pattern.astype(np.float32) / np.float32(65535)
    return Decoded(coords, mask, values, None if light is None else light.astype(np.float32), notes)


def of_earlier_version(root: Path, decoder: Decoder[Any]) -> bool:
    """Whether a work folder holds frames, and another version of this decoder has decoded them."""
    settings = _manifest(root / MANIFEST).get("settings", {})
    return settings.get("decoder") == decoder.name and settings.get("decoder_version") != decoder.version


class Manifest:
    """What happened to each frame, in words, in the folder of the decoded frames; written after every frame."""

    def __init__(self, root: Path, settings: dict[str, Any]) -> None:
        self._path = root / MANIFEST
        self._settings = settings
        self._frames = dict(_manifest(self._path).get("frames", {}))

    def note(self, frame: str, key: str, status: str, reason: str = "") -> None:
        """Note what happened to a frame."""
        self._frames[frame] = {"key": key, "status": status, **({"reason": reason} if reason else {})}
        write_atomic(self._path, encode_json({"settings": self._settings, "frames": self._frames}))


def _manifest(path: Path) -> dict[str, dict[str, Any]]:
    """The objects in the notes of an earlier run."""
    return {key: value for key, value in read_note(path).items() if isinstance(value, dict)}


def read_note(path: Path) -> dict[str, Any]:
    """What an earlier run noted as JSON; empty if there is nothing that can be read."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


# Dataclasses with arrays as bytes, exactly, and without pickle: reading them runs no code.

T = TypeVar("T")
_TREE = "tree"  # name of the archive's member that is no array


def encode(value: object) -> bytes:
    """Dataclasses, tuples, lists, arrays, tensors, numbers and texts as an archive. Raises TypeError for others."""
    arrays: list[ndarray] = []
    tree = json.dumps(_flat(value, arrays))
    members = {f"array{k}": array for k, array in enumerate(arrays)}
    return encode_npz({_TREE: np.frombuffer(tree.encode(), np.uint8), **members})


def decode(content: bytes, classes: Sequence[type]) -> Any:
    """The value that was encoded; its dataclasses must be among `classes`. Raises KeyError for another one."""
    with np.load(BytesIO(content), allow_pickle=False) as archive:
        tree = json.loads(archive[_TREE].tobytes())
        arrays = [archive[f"array{k}"] for k in range(len(archive.files) - 1)]
    return _built(tree, arrays, {kind.__name__: kind for kind in classes})


def with_arrays(value: T, classes: Sequence[type], change: Callable[[Sequence[ndarray]], Sequence[ndarray]]) -> T:
    """Copy a value with other arrays in place of its own; `classes` as for `decode`."""
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


# Clouds of many frames: beyond a share of the memory their arrays are in temporary files, mapped into memory.

_CLASSES = (FrameCloud, RelativePose, Degeneracy, Device)


class LargeClouds:
    """Takes clouds, also from several threads. Files are gone with the process, whatever ends it."""

    def __init__(self, most_bytes: int | None = None) -> None:
        """`most_bytes` of clouds stay in memory; default: a share of it."""
        self._left = largest_in_memory() if most_bytes is None else most_bytes
        self._counting = threading.Lock()

    def kept(self, cloud: FrameCloud) -> FrameCloud:
        """An equal cloud. Raises UserError if there is no space for the file."""
        return with_arrays(cloud, _CLASSES, self._arrays)

    def _arrays(self, arrays: Sequence[ndarray]) -> Sequence[ndarray]:
        with self._counting:
            self._left -= sum(array.nbytes for array in arrays)
            fits = self._left >= 0
        return arrays if fits else in_file(arrays)
