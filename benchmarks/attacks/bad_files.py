"""Input files that are wrong, each in a way that once broke something: intrinsics, meshes, reference points.

Random damage of every file that is read, patterns and poses included, is in tests/fuzz.
"""

import io
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.attacks.commands import Case, call, refused

_XML = '<?xml version="1.0"?><opencv_storage>{}</opencv_storage>'
_YAML = "%YAML:1.0\n---\n{}"
_K = "900. 0. 150. 0. 900. 150. 0. 0. 1."


def _xml(matrix: str = _K, width: str = "300", lens: str = "0. 0. 0. 0.") -> str:
    return _XML.format(
        f"<image_width>{width}</image_width><image_height>300</image_height>"
        f"<camera_matrix><rows>3</rows><cols>3</cols><dt>d</dt><data>{matrix}</data></camera_matrix>"
        f"<distortion_coefficients><rows>1</rows><cols>4</cols><dt>d</dt><data>{lens}</data></distortion_coefficients>"
    )


def _json(**changes: Any) -> str:
    camera = {"w": 300, "h": 300, "fl_x": 900.0, "fl_y": 900.0, "cx": 150.0, "cy": 150.0, **changes}
    return json.dumps({"camera": camera, "projector": {**camera, "w": 800, "h": 800, "cx": 400.0, "cy": 400.0}})


_DEEP = "[" * 100_000
_INTRINSICS: dict[str, tuple[str, str]] = {  # name: file, content
    "XML nested 50,000 deep": ("i.xml", _XML.format("<a>" * 50_000)),
    "XML nested 50,000 deep and closed": ("i.xml", _XML.format("<a>" * 50_000 + "</a>" * 50_000)),
    "XML entities": ("i.xml", '<!DOCTYPE a [<!ENTITY b "c">]>' + _XML.format("<a>&b;</a>")),
    "XML cut off": ("i.xml", _xml()[:200]),
    "XML of another program": ("i.xml", "<html></html>"),
    "YAML of 100,000 brackets": ("i.yml", _YAML.format("a: " + _DEEP)),
    "YAML of 100,000 braces": ("i.yml", _YAML.format("a: " + "{a: " * 100_000)),
    "YAML of 100,000 dashes": ("i.yml", _YAML.format("- " * 100_000)),
    "YAML nested by indentation": ("i.yml", _YAML.format("".join(" " * k + "a:\n" for k in range(600)))),
    "YAML with a reference to itself": ("i.yml", _YAML.format("a: &x [*x]")),
    "YAML with an object of Python": ("i.yml", _YAML.format("a: !!python/object/apply:os.system [touch hacked]")),
    "YAML with 20,000 equal names": ("i.yml", _YAML.format("a: 1\n" * 20_000)),
    "YAML in UTF-16": ("i.yml", _YAML.format("a: 1").encode("utf-16").decode("latin-1")),
    "JSON nested 100,000 deep": ("i.json", _DEEP),
    "JSON nested 900 deep in a key": ("i.json", '{"camera": ' + "[" * 900 + "]" * 900 + "}"),
    "JSON with a number of 5,000 digits": ("i.json", '{"camera": {"w": 1' + "0" * 5000 + "}}"),
    "text where a matrix belongs": ("i.xml", _XML.format("<camera_matrix>none</camera_matrix>")),
    "an object where a matrix belongs": ("i.xml", _XML.format("<camera_matrix><a>1</a></camera_matrix>")),
    "a word in the matrix": ("i.xml", _xml("900. 0. wide 0. 900. 150. 0. 0. 1.")),
    "a matrix of eight numbers": ("i.xml", _xml("900. 0. 150. 0. 900. 150. 0. 0.")),
    "a matrix with NaN": ("i.xml", _xml(".Nan 0. 150. 0. 900. 150. 0. 0. 1.")),
    "a matrix that is transposed": ("i.xml", _xml("900. 0. 0. 0. 900. 0. 150. 150. 1.")),
    "a matrix with skew": ("i.xml", _xml("900. 25. 150. 0. 900. 150. 0. 0. 1.")),
    "a matrix with the last row 0 0 2": ("i.xml", _xml("900. 0. 150. 0. 900. 150. 0. 0. 2.")),
    "a matrix with the last row 0 0 0": ("i.xml", _xml("900. 0. 150. 0. 900. 150. 0. 0. 0.")),
    "a negative focal length": ("i.xml", _xml("-900. 0. 150. 0. 900. 150. 0. 0. 1.")),
    "a lens of NaN": ("i.xml", _xml(lens="0. .Nan 0. 0.")),
    "a lens of text": ("i.xml", _xml(lens="a b c d")),
    **{f"width {w!r} in XML": ("i.xml", _xml(width=w)) for w in ("wide", "", "0", "-300", "300.5", "1e400", "3 0")},
    **{f"k1 = {k:g}": ("i.json", _json(k1=k)) for k in (50.0, -50.0, 1e30, -1e308, 1e308)},
    **{f"p1 = {p:g}": ("i.json", _json(p1=p)) for p in (5.0, -1e10, 1e308)},
    **{
        f"{key} = {value!r}": ("i.json", _json(**{key: value}))
        for key in ("w", "fl_x", "cx")
        for value in (-1e30, 1e308, float("nan"), "300", None, True, [], {}, 10**400)
    },
    "COLMAP with words": ("i.txt", "1 OPENCV 300 300 a b c d 0 0 0 0\n"),
    "COLMAP with NaN": ("i.txt", "1 PINHOLE 300 300 nan 900 150 150\n"),
    "COLMAP with infinity": ("i.txt", "1 PINHOLE 300 300 900 inf 150 150\n"),
    "COLMAP with a negative size": ("i.txt", "1 PINHOLE -300 -300 900 900 150 150\n"),
    "COLMAP of zeros": ("i.txt", "\0" * 1000),
    "another kind of file": ("i.toml", "x = 1"),
    "an empty file": ("i.json", ""),
}


def _process(folder: Path, **flags: str) -> str:
    given = {"images": "captures/images", "pattern": "captures/pattern.json", "intrinsics": "captures/intrinsics.json"}
    arguments = [part for key, value in {**given, **flags, "output": "new"}.items() for part in (f"--{key}", value)]
    fault = refused(call(folder, "sl-process", *arguments, "--jobs", "1"), "error:")
    left = [name for name in ("new", "hacked") if (folder / name).exists()]
    return fault or (f"left {left[0]} behind" if left else "")


def _intrinsics(name: str, file: str, content: str) -> Case:
    def attack(folder: Path) -> str:
        (folder / file).write_text(content, encoding="latin-1" if "UTF-16" in name else "utf-8")
        return _process(folder, intrinsics=file)

    return Case("Intrinsics files", name, ("captures",), attack)


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
    "a length too large.glb": struct.pack("<4sIII4s", b"glTF", 2, 2**31, 2**31 - 1, b"JSON"),
    "deep.glb": struct.pack("<4sIII4s", b"glTF", 2, 100_020, 100_000, b"JSON") + b"[" * 100_000,
    "unknown.xyz": b"0 0 0\n",
    "no suffix": b"0 0 0\n",
}


def _points(values: np.ndarray, key: str = "xyz") -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **{key: values})
    return buffer.getvalue()


_REFERENCES: dict[str, bytes] = {
    "NaN.npz": _points(np.full((200, 3), np.nan)), "few.npz": _points(np.zeros((5, 3))),
    "flat.npz": _points(np.zeros(300)), "two columns.npz": _points(np.zeros((200, 2))),
    "text.npz": _points(np.array([["a", "b", "c"]] * 200)), "objects.npz": _points(np.array([[None] * 3] * 200)),
    "other key.npz": _points(np.zeros((200, 3)), "points"), "no zip.npz": b"hello" * 50,
    "cut.npz": _points(np.zeros((200, 3)))[:500],
    **{f"mesh: {name}": content for name, content in _MESHES.items() if name.startswith(("NaN", "points", "face"))},
}  # fmt: skip


def cases() -> list[Case]:
    """Every file that a command reads, with every fault."""
    found = [_intrinsics(name, *what) for name, what in _INTRINSICS.items()]
    found += [_mesh(f"--mesh {name}", name, lambda _, c=content: c) for name, content in _MESHES.items()]
    found += [
        _mesh(f"--reference {n}", n.removeprefix("mesh: "), lambda _, c=c: c, True) for n, c in _REFERENCES.items()
    ]
    found += [
        _mesh(f"--mesh cut to {p} %", "cut.ply", lambda whole, p=p: whole[: len(whole) * p // 100]) for p in (1, 30, 99)
    ]
    return [*found, Case("Meshes", "--poses of 1e30", ("scan",), _far_poses)]


def _mesh(title: str, name: str, content: Callable[[bytes], bytes], reference: bool = False) -> Case:
    def attack(folder: Path) -> str:
        whole = (folder / _TRUTH).read_bytes()
        (folder / name).write_bytes(content(whole))
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
