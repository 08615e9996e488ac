"""Decoded frames that are kept between runs: only changed images, patterns or decoders need decoding again."""

import hashlib
import json
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float16, Float32, UInt16
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.files.atomic import write_atomic
from sl_nerfstudio.files.checked import read_checked, write_checked
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.scan.file_error import read_bytes
from sl_nerfstudio.scan.writing import encode_json

_KEY_LENGTH = 24
MANIFEST = "manifest.json"
DECODED = "decoded"


class DecodedStore:
    """A folder of decoded frames; the name of each file contains a digest of what it was decoded from."""

    def __init__(self, root: Path, decoder_key: str) -> None:
        self.root = root
        self._decoder_key = decoder_key

    def key(self, frame: CapturedFrame) -> str:
        """Digest of the images' contents and of the decoder. Raises FileError if an image cannot be read."""
        digest = hashlib.sha256(self._decoder_key.encode())
        for path in frame.images:
            digest.update(hashlib.sha256(read_bytes(path)).digest())
        return digest.hexdigest()[:_KEY_LENGTH]

    def load(self, frame: CapturedFrame, key: str) -> Decoded | None:
        """A frame that was decoded before; None if there is none, or if its file is damaged."""
        content = read_checked(self._path(frame, key))
        if content is None:
            return None
        try:
            with np.load(BytesIO(content), allow_pickle=False) as stored:
                coords, mask, pattern = stored["coords"], stored["mask"], stored["pattern"]
                light = stored.get("light")
        except (ValueError, KeyError, EOFError, BadZipFile):
            return None
        if coords.dtype != np.float32 or coords.shape != (*mask.shape, 2) or pattern.shape != mask.shape:
            return None
        if light is not None and light.shape != mask.shape:
            return None
        return _restored(coords, mask, pattern, light)

    def save(self, frame: CapturedFrame, key: str, decoded: Decoded) -> Decoded:
        """Store a frame, and return it as `load` will, so that a resumed run gives the same result."""
        buffer = BytesIO()
        pattern = np.rint(65535 * decoded.pattern).astype(np.uint16)
        light = None if decoded.light is None else decoded.light.astype(np.float16)
        more = {} if light is None else {"light": light}
        np.savez_compressed(buffer, coords=decoded.coords, mask=decoded.mask, pattern=pattern, **more)
        write_checked(self._path(frame, key), buffer.getvalue())
        return _restored(decoded.coords, decoded.mask, pattern, light)

    def _path(self, frame: CapturedFrame, key: str) -> Path:
        return self.root / DECODED / f"{frame.name}-{key}.npz"


def _restored(
    coords: Float32[ndarray, "h w 2"],
    mask: Bool[ndarray, "h w"],
    pattern: UInt16[ndarray, "h w"],
    light: Float16[ndarray, "h w"] | None,
) -> Decoded:
    """What was decoded, with intensities as exact as they are stored."""
    values = pattern.astype(np.float32) / np.float32(65535)
    return Decoded(coords, mask, values, None if light is None else light.astype(np.float32))


class Manifest:
    """What happened to each frame, in words, in the folder of the decoded frames; written after every frame."""

    def __init__(self, root: Path, settings: dict[str, Any]) -> None:
        self._path = root / MANIFEST
        self._settings = settings
        self._frames = self._known()

    def note(self, frame: str, key: str, status: str, reason: str = "") -> None:
        """Note what happened to a frame."""
        self._frames[frame] = {"key": key, "status": status, **({"reason": reason} if reason else {})}
        write_atomic(self._path, encode_json({"settings": self._settings, "frames": self._frames}))

    def _known(self) -> dict[str, Any]:
        """The notes of an earlier run; none if there are none that can be read."""
        try:
            frames = json.loads(self._path.read_text(encoding="utf-8"))["frames"]
        except (OSError, ValueError, KeyError, TypeError):
            return {}
        return dict(frames) if isinstance(frames, dict) else {}
