"""Meshes as bytes of GLB files: binary glTF 2.0."""

import json
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.meshing.formats.encode import MATERIAL
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.texture.texture import Texture
from sl_nerfstudio.meshing.vertex_properties import GREY
from sl_nerfstudio.scan.images import encode_png

_FLOAT, _UINT, _USHORT = 5126, 5125, 5123  # component types of glTF
_VERTICES, _INDICES = 34962, 34963  # targets of glTF's buffer views
_LINEAR, _LINEAR_MIPMAPS, _CLAMPED = 9729, 9987, 33071  # how textures are filtered, and continued beyond their sides


def encode_glb(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, texture: Texture | None = None) -> bytes:
    """A mesh in glTF's own unit and axes: positions, normals, colours or else a texture, one matt material."""
    arrays = _attributes(mesh, colour, texture)
    faces = mesh.faces if texture is None else texture.charts.corners
    parts = [array.tobytes() for array in [*arrays.values(), faces.astype("<u4").reshape(-1)]]
    accessors = [_accessor(k, array) for k, array in enumerate(arrays.values())]
    accessors.append({"bufferView": len(arrays), "componentType": _UINT, "count": faces.size, "type": "SCALAR"})
    targets: list[int | None] = [*[_VERTICES] * len(arrays), _INDICES]
    primitive = {
        "attributes": {name: k for k, name in enumerate(arrays)},
        "indices": len(arrays),
        "material": 0,
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "sl_nerfstudio"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": MATERIAL}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [_material(grey=colour is None and texture is None, textured=texture is not None)],
        "accessors": accessors,
    }
    if texture is not None:
        parts.append(encode_png(texture.image))
        targets.append(None)
        document["images"] = [{"bufferView": len(parts) - 1, "mimeType": "image/png"}]
        document["samplers"] = [
            {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAPS, "wrapS": _CLAMPED, "wrapT": _CLAMPED}
        ]
        document["textures"] = [{"sampler": 0, "source": 0}]
    document["bufferViews"] = _views(parts, targets)
    document["buffers"] = [{"byteLength": sum(map(len, parts))}]
    return _container(document, b"".join(parts))


def _attributes(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, texture: Texture | None) -> dict[str, ndarray]:
    """Of the vertices; those of charts where there is a texture, because each has one texture coordinate."""
    found = {"POSITION": mesh.vertices.astype("<f4"), "NORMAL": mesh.vertex_normals().astype("<f4")}
    if texture is not None:
        found = {name: values[texture.charts.vertex] for name, values in found.items()}
        return found | {"TEXCOORD_0": texture.charts.uv.astype("<f4")}
    if colour is not None:
        opaque = np.full((len(colour), 1), 65535, dtype="<u2")
        found["COLOR_0"] = np.concatenate([_linear(colour), opaque], 1)
    return found


def _material(grey: bool, textured: bool) -> dict[str, Any]:
    shade = float(_linear(np.array([GREY], np.uint8))[0]) / 65535 if grey else 1.0
    surface: dict[str, Any] = {
        "baseColorFactor": [shade, shade, shade, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 1.0,
    }
    if textured:
        surface["baseColorTexture"] = {"index": 0}
    return {"name": MATERIAL, "doubleSided": True, "pbrMetallicRoughness": surface}


def _accessor(view: int, array: ndarray) -> dict[str, Any]:
    found: dict[str, Any] = {
        "bufferView": view,
        "componentType": {"f4": _FLOAT, "u2": _USHORT}[array.dtype.str[1:]],
        "count": len(array),
        "type": f"VEC{array.shape[1]}",
    }
    if array.dtype == np.uint16:
        found["normalized"] = True
    if view == 0:  # positions must state their box
        found |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
    return found


def _views(parts: list[bytes], targets: list[int | None]) -> list[dict[str, int]]:
    """Where in the buffer each part is, and what for."""
    views, at = [], 0
    for part, target in zip(parts, targets, strict=True):
        view = {"buffer": 0, "byteOffset": at, "byteLength": len(part)}
        views.append(view if target is None else {**view, "target": target})
        at += len(part)
    return views


def _linear(colour: UInt8[ndarray, "*n"]) -> UInt16[ndarray, "*n"]:
    """sRGB as linear light with 16 bits: colours of vertices are linear in glTF."""
    value: Float[ndarray, "*n"] = colour / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.round(light * 65535).astype("<u2")


def _container(document: dict[str, Any], binary: bytes) -> bytes:
    """The container: a header, then JSON and data, each padded to four bytes."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    head = b"glTF" + np.array([2, size], "<u4").tobytes()
    chunks = np.uint32(len(text)).tobytes() + b"JSON" + text + np.uint32(len(binary)).tobytes() + b"BIN\0" + binary
    return head + chunks
