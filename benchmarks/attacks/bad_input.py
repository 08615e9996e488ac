"""Input files that are wrong: intrinsics, patterns, poses, meshes, and every key and file of a scan."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.attacks.case import Case, Fixture
from benchmarks.attacks.commands import call
from benchmarks.attacks.expect import refused

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

_PATTERN: dict[str, Any] = {
    f"{key} = {str(value)[:20]}": (key, value)
    for key, values in {
        "w": (0, -800, 800.5, 10**9, 1e308, "800", None, True),
        "period": (0, -20, 1e-300, 1e308, "20", float("nan"), 1e400),
        "gap": (-1, 20, 1e308, None),
        "line_width": (0, 20, -4),
        "dark": (-1, 1, 2, 1e308),
        "seed": (-1, 0.5, 7, 10**400),
        "rows": (39, 0, "40"),
        "x0": (0, 1e308),
        "kind": ("dots", None, ["grid"], {}),
        "sl_pattern": (0, 2, "1", None),
        "hamming_margin": (None, "3", 1e308),
        "codes": (None, [], {}, "0", [[]], [[0] * 40] * 39, [[2] * 40] * 40, [[9] * 40] * 40, [[0.5] * 40] * 40),
    }.items()
    for value in values
}


def cases() -> list[Case]:
    """Every file that a command reads, with every fault."""
    found = [_intrinsics(name, *what) for name, what in _INTRINSICS.items()]
    found += [_pattern(name, lambda d, k=key, v=value: d.update({k: v})) for name, (key, value) in _PATTERN.items()]
    found += [
        _pattern(f"a code of {code!r:.12}", lambda d, c=code: _set_code(d, c)) for code in (1e308, 10**30, 0.5, -1)
    ]
    found += [_pattern(f"symbol {k} edited", lambda d, k=k: _edit_symbol(d, k)) for k in range(0, 1600, 160)]
    found += [_pattern(f"without {key}", lambda d, k=key: d.pop(k)) for key in ("codes", "w", "period", "seed", "kind")]
    found += [_poses(name, change) for name, change in _poses_changes().items()]
    found += [
        _process_flag(f"--pattern {what}", "--pattern", what) for what in ("captures", "captures/pattern.png", "no")
    ]
    return found


def _process(folder: Path, **flags: str) -> str:
    given = {"images": "captures/images", "pattern": "captures/pattern.json", "intrinsics": "captures/intrinsics.json"}
    arguments = [part for key, value in {**given, **flags, "output": "new"}.items() for part in (f"--{key}", value)]
    fault = refused(call(folder, "sl-process", *arguments, "--jobs", "1"), "error:")
    left = [name for name in ("new", "hacked") if (folder / name).exists()]
    return fault or (f"left {left[0]} behind" if left else "")


def _case(group: str, name: str, attack: Callable[[Path], str], fixture: Fixture = "captures") -> Case:
    return Case(group, name, (fixture,), attack)


def _intrinsics(name: str, file: str, content: str) -> Case:
    def attack(folder: Path) -> str:
        (folder / file).write_text(content, encoding="latin-1" if "UTF-16" in name else "utf-8")
        return _process(folder, intrinsics=file)

    return _case("Intrinsics files", name, attack)


def _pattern(name: str, change: Callable[[dict[str, Any]], Any]) -> Case:
    def attack(folder: Path) -> str:
        path = folder / "captures" / "pattern.json"
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))
        return _process(folder)

    return _case("Pattern files", name, attack)


def _set_code(document: dict[str, Any], code: Any) -> None:
    document["codes"][3][4] = code


def _edit_symbol(document: dict[str, Any], number: int) -> None:
    row = document["codes"][number // 40]
    row[number % 40] = (row[number % 40] + 1) % 5


def _poses_changes() -> dict[str, Callable[[dict[str, Any]], Any]]:
    identity = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]

    def with_pose(T: Any) -> Callable[[dict[str, Any]], Any]:
        return lambda d: d["frames"][0].update(transform_matrix=T)

    def moved(x: float) -> Any:
        return [[1.0, 0, 0, x], *identity[1:]]

    found: dict[str, Callable[[dict[str, Any]], Any]] = {
        f"units {value!r}": lambda d, v=value: d.update(units=v) for value in (["mm"], {}, 1, None, "inch", True)
    }
    found |= {f"a position of {x:g}": with_pose(moved(x)) for x in (1e30, -1e308, float("nan"))}
    found |= {f"a pose {str(T)[:20]}": with_pose(T) for T in ("T", None, [], 1, [[0] * 4] * 4, identity[:3], [[]])}
    found |= {f"frames {value!r}": lambda d, v=value: d.update(frames=v) for value in (None, [], [1], "all", {}, [[]])}
    found["a key deep in lists"] = lambda d: d.update(extra=json.loads("[" * 500 + "]" * 500))
    return found


def _poses(name: str, change: Callable[[dict[str, Any]], Any]) -> Case:
    def attack(folder: Path) -> str:
        names = sorted(path.stem for path in (folder / "captures" / "images").iterdir())
        pose = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
        document = {"units": "mm", "frames": [{"file_path": f"{n}.png", "transform_matrix": pose} for n in names]}
        change(document)
        (folder / "poses.json").write_text(json.dumps(document))
        return _process(folder, poses="poses.json")

    return _case("Poses files", name, attack)


def _process_flag(name: str, flag: str, value: str) -> Case:
    return _case("Pattern files", name, lambda folder: _process(folder, **{flag.removeprefix("--"): value}))
