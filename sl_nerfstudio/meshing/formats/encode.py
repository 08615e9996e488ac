"""Meshes as bytes of OBJ, STL and GLB files."""

import json
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_properties import GREY

_MATERIAL = "surface"
_FLOAT, _UINT, _USHORT = 5126, 5125, 5123  # component types of glTF
_VERTICES, _INDICES = 34962, 34963  # targets of glTF's buffer views


def encode_obj(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, library: str) -> bytes:
    """OBJ text with normals; colours follow the positions, where most programs look for them.

    `library` is the name of the material file. Positions have 8 decimals.
    """
    columns = [mesh.vertices] if colour is None else [mesh.vertices, colour / 255.0]
    line = "v {:.8f} {:.8f} {:.8f}" + ("" if colour is None else " {:.4f} {:.4f} {:.4f}")
    rows = np.concatenate(columns, 1)
    text = [f"mtllib {library}", *map(line.format, *rows.T.tolist())]
    text += map("vn {:.6f} {:.6f} {:.6f}".format, *mesh.vertex_normals().T.tolist())
    text.append(f"usemtl {_MATERIAL}")
    text += map("f {0}//{0} {1}//{1} {2}//{2}".format, *(mesh.faces + 1).T.tolist())
    return ("\n".join(text) + "\n").encode()


def encode_mtl(coloured: bool) -> bytes:
    """The material of an OBJ: matt and grey, or white under the colours of the vertices."""
    diffuse = "1 1 1" if coloured else " ".join(3 * [f"{GREY / 255:.4f}"])
    return f"newmtl {_MATERIAL}\nKa 0 0 0\nKd {diffuse}\nKs 0 0 0\nd 1\nillum 1\n".encode()


def encode_stl(mesh: Mesh, unit: str) -> bytes:
    """Binary STL; its header names the unit."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    rows = np.zeros(len(mesh.faces), dtype=[("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["normal"] = normal / np.where(length > 0, length, 1.0)
    rows["corner"] = np.stack([a, b, c], 1)
    header = f"binary STL, lengths in {unit}".encode().ljust(80)
    return header + np.uint32(len(rows)).tobytes() + rows.tobytes()


def encode_glb(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None) -> bytes:
    """Binary glTF 2.0 of a mesh in glTF's own unit and axes: positions, normals, colours, one matt material."""
    shade = 1.0 if colour is not None else float(_linear(np.array([GREY], np.uint8))[0]) / 65535
    attributes = {"POSITION": mesh.vertices.astype("<f4"), "NORMAL": mesh.vertex_normals().astype("<f4")}
    if colour is not None:
        opaque = np.full((len(colour), 1), 65535, dtype="<u2")
        attributes["COLOR_0"] = np.concatenate([_linear(colour), opaque], 1)
    arrays = [*attributes.values(), mesh.faces.astype("<u4").reshape(-1)]
    views, accessors, at = [], [], 0
    for array in arrays:
        indices = array.ndim == 1
        views.append(
            {
                "buffer": 0,
                "byteOffset": at,
                "byteLength": array.nbytes,
                "target": _INDICES if indices else _VERTICES,
            }
        )
        accessors.append(_accessor(len(accessors), array))
        at += array.nbytes
    primitive = {
        "attributes": {name: k for k, name in enumerate(attributes)},
        "indices": len(attributes),
        "material": 0,
    }
    document = {
        "asset": {"version": "2.0", "generator": "sl_nerfstudio"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": _MATERIAL}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [
            {
                "name": _MATERIAL,
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [shade, shade, shade, 1.0],
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
            }
        ],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return _glb(document, b"".join(array.tobytes() for array in arrays))


def _accessor(view: int, array: ndarray) -> dict[str, Any]:
    kinds = {"f4": _FLOAT, "u4": _UINT, "u2": _USHORT}
    found: dict[str, Any] = {
        "bufferView": view,
        "componentType": kinds[array.dtype.str[1:]],
        "count": len(array),
        "type": "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
    }
    if array.dtype == np.uint16:
        found["normalized"] = True
    if view == 0:  # positions must state their box
        found |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
    return found


def _linear(colour: UInt8[ndarray, "*n"]) -> UInt16[ndarray, "*n"]:
    """sRGB as linear light with 16 bits: colours of vertices are linear in glTF."""
    value: Float[ndarray, "*n"] = colour / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.round(light * 65535).astype("<u2")


def _glb(document: dict[str, Any], binary: bytes) -> bytes:
    """The container: a header, then JSON and data, each padded to four bytes."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    head = b"glTF" + np.array([2, size], "<u4").tobytes()
    chunks = np.uint32(len(text)).tobytes() + b"JSON" + text + np.uint32(len(binary)).tobytes() + b"BIN\0" + binary
    return head + chunks
