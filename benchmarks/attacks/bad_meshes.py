"""Meshes and reference points of sl-eval that are wrong."""

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.attacks.case import Case
from benchmarks.attacks.commands import call
from benchmarks.attacks.expect import refused

_TRUTH = "scan/ground_truth/mesh.ply"
_HEAD = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
_FACES = "element face {}\nproperty list uchar int vertex_indices\n"
_CORNERS = "0 0 0\n1 0 0\n0 1 0\n"


def _ply(vertices: str, faces: str, counts: tuple[int, int] = (3, 1)) -> bytes:
    return f"{_HEAD.format(counts[0])}{_FACES.format(counts[1])}end_header\n{vertices}{faces}".encode()


_MESHES: dict[str, bytes] = {  # name of the file: content
    "empty.ply": b"",
    "zeros.ply": b"\0" * 500,
    "header only.ply": b"ply\nformat ascii 1.0\n",
    "no elements.ply": b"ply\nformat ascii 1.0\nend_header\n",
    "points only.ply": f"{_HEAD.format(3)}end_header\n{_CORNERS}".encode(),
    "no faces.ply": _ply(_CORNERS, "", (3, 0)),
    "face out of range.ply": _ply(_CORNERS, "3 0 1 7\n"),
    "negative face.ply": _ply(_CORNERS, "3 0 1 -1\n"),
    "NaN.ply": _ply("nan 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n"),
    "infinity.ply": _ply("inf 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n"),
    "huge.ply": _ply("1e30 0 0\n1 0 0\n0 1 0\n", "3 0 1 2\n"),
    "words.ply": _ply("a b c\n1 0 0\n0 1 0\n", "3 0 1 2\n"),
    "too few vertices.ply": _ply(_CORNERS, "3 0 1 2\n", (30, 1)),
    "a billion vertices.ply": _ply(_CORNERS, "3 0 1 2\n", (10**9, 1)),
    "a billion faces.ply": _ply(_CORNERS, "3 0 1 2\n", (3, 10**9)),
    "negative count.ply": _ply(_CORNERS, "3 0 1 2\n", (-3, 1)),
    "a face of two.ply": _ply(_CORNERS, "2 0 1\n"),
    "no area.ply": _ply("0 0 0\n0 0 0\n0 0 0\n", "3 0 1 2\n"),
    "empty.obj": b"",
    "points.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n",
    "face out of range.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n",
    "two numbers.obj": b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n",
    "words.obj": b"v a b c\nf 1 2 3\n",
    "NaN.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "empty.stl": b"",
    "count too large.stl": b"\0" * 80 + struct.pack("<I", 10**9) + b"\0" * 50,
    "no triangles.stl": b"\0" * 80 + struct.pack("<I", 0),
    "text.stl": b"solid x\nfacet normal a b c\n",
    "not glTF.glb": b"hello" * 100,
    "a length too large.glb": struct.pack("<4sII", b"glTF", 2, 2**31) + struct.pack("<I4s", 2**31 - 1, b"JSON"),
    "deep.glb": b"",
    "unknown.xyz": b"0 0 0\n",
    "no suffix": b"0 0 0\n",
}


def _deep_glb() -> bytes:
    text = b"[" * 100_000
    return struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text


def _points(values: np.ndarray, key: str = "xyz") -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **{key: values})
    return buffer.getvalue()


_REFERENCES: dict[str, bytes] = {
    "NaN.npz": _points(np.full((200, 3), np.nan)),
    "few.npz": _points(np.zeros((5, 3))),
    "flat.npz": _points(np.zeros(300)),
    "two columns.npz": _points(np.zeros((200, 2))),
    "text.npz": _points(np.array([["a", "b", "c"]] * 200)),
    "objects.npz": _points(np.array([[None] * 3] * 200)),
    "other key.npz": _points(np.zeros((200, 3)), "points"),
    "no zip.npz": b"hello" * 50,
    "cut.npz": _points(np.zeros((200, 3)))[:500],
    **{f"mesh: {name}": content for name, content in _MESHES.items() if name.startswith(("NaN", "points", "face"))},
}


def cases() -> list[Case]:
    """Every file as --mesh, or as --reference; and a good mesh that was cut off."""
    found = [_case(f"--mesh {name}", name, lambda _, c=content: c) for name, content in _MESHES.items()]
    found += [
        _case(f"--reference {n}", n.removeprefix("mesh: "), lambda _, c=c: c, True) for n, c in _REFERENCES.items()
    ]
    found += [
        _case(f"--mesh cut to {p} %", "cut.ply", lambda whole, p=p: whole[: len(whole) * p // 100]) for p in (1, 30, 99)
    ]
    found.append(Case("Meshes", "--poses of 1e30", ("scan",), _far_poses))
    return found


def _case(title: str, name: str, content: Callable[[bytes], bytes], reference: bool = False) -> Case:
    def attack(folder: Path) -> str:
        whole = (folder / _TRUTH).read_bytes()
        (folder / name).write_bytes(_deep_glb() if name == "deep.glb" else content(whole))
        files = ("--mesh", _TRUTH, "--reference", name) if reference else ("--mesh", name)
        done = call(folder, "sl-eval", *files, "--data", "scan", "--json", "figures.json")
        return refused(done, name) or ("wrote figures.json" if (folder / "figures.json").exists() else "")

    return Case("Meshes", title, ("scan",), attack)


def _far_poses(folder: Path) -> str:
    document = json.loads((folder / "scan/transforms.json").read_text())
    document["frames"][1]["transform_matrix"][0][3] = 1e30
    (folder / "poses.json").write_text(json.dumps(document))
    done = call(folder, "sl-eval", "--mesh", _TRUTH, "--data", "scan", "--poses", "poses.json")
    return refused(done, "frame_00001", "from the origin")
