"""Meshes as bytes of OBJ and STL files."""

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.texture.texture import Charts
from sl_nerfstudio.meshing.vertex_properties import GREY

MATERIAL = "surface"


def encode_obj(mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None, charts: Charts | None, library: str) -> bytes:
    """OBJ text with normals; colours follow the positions, where most programs look for them, if there are no `charts`.

    `library` is the name of the material file. Positions have 8 decimals. Texture coordinates are counted upwards.
    """
    colour = colour if charts is None else None
    columns = [mesh.vertices] if colour is None else [mesh.vertices, colour / 255.0]
    line = "v {:.8f} {:.8f} {:.8f}" + ("" if colour is None else " {:.4f} {:.4f} {:.4f}")
    rows = np.concatenate(columns, 1)
    text = [f"mtllib {library}", *map(line.format, *rows.T.tolist())]
    text += map("vn {:.6f} {:.6f} {:.6f}".format, *mesh.vertex_normals().T.tolist())
    if charts is not None:
        text += map("vt {:.7f} {:.7f}".format, charts.uv[:, 0].tolist(), (1.0 - charts.uv[:, 1]).tolist())
    text.append(f"usemtl {MATERIAL}")
    if charts is None:
        text += map("f {0}//{0} {1}//{1} {2}//{2}".format, *(mesh.faces + 1).T.tolist())
    else:
        columns = np.concatenate([mesh.faces, charts.corners], 1) + 1
        text += map("f {0}/{3}/{0} {1}/{4}/{1} {2}/{5}/{2}".format, *columns.T.tolist())
    return ("\n".join(text) + "\n").encode()


def encode_mtl(coloured: bool, image: str | None) -> bytes:
    """The material of an OBJ: matt and grey, or white under the colours of the vertices or of the file `image`."""
    diffuse = "1 1 1" if coloured or image is not None else " ".join(3 * [f"{GREY / 255:.4f}"])
    texture = "" if image is None else f"map_Kd {image}\n"
    return f"newmtl {MATERIAL}\nKa 0 0 0\nKd {diffuse}\nKs 0 0 0\nd 1\nillum 1\n{texture}".encode()


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
