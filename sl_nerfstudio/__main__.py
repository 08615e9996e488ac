"""`python -m sl_nerfstudio`: what is installed, whether it works on this machine, and what is missing."""

import importlib
import os
import platform
import shutil
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import metadata

from packaging.requirements import Requirement

import sl_nerfstudio
from sl_nerfstudio.console import paragraph
from sl_nerfstudio.errors import last_line

_DISTRIBUTION = "sl-nerfstudio"
_LOADED = ("cv2", "numba", "open3d", "scipy", "skimage", "torch", "torchvision", "trimesh", "viser")
"""Packages with compiled parts, which can be installed and still not load."""
_EXTRAS = {
    "show": "patterns on a display (sl-pattern --show, sl-capture)",
    "phone": "photographs of phones (.heic)",
    "video": "captures from a video",
    "las": "point clouds for surveying programs (sl-export --points cloud.las)",
}
_GROUPS = {"nerfstudio.method_configs": "methods", "nerfstudio.dataparser_configs": "dataparsers"}
_AGREE = 1e-4  # scene units; the backends differ by rounding, some 1e-7


class Missing(Exception):
    """Something without which the package does not work; the text says what, and what to do."""


def main() -> None:
    """Print a line for each part as it is looked at; exit status 1 if one does not work."""
    warnings.simplefilter("ignore")  # other packages' own, about versions
    system = f"{platform.system()} {platform.machine()}"
    print(f"sl_nerfstudio {sl_nerfstudio.__version__}, Python {platform.python_version()}, {system}")
    parts: dict[str, Callable[[], str]] = {
        "packages": packages, "libraries": libraries, "nerfstudio": plugin, "devices": devices, "field": backends,
        "extras": extras, "ffmpeg": ffmpeg,
    }  # fmt: skip
    faulty = [name for name, part in parts.items() if not _shown(name, part)]
    print(paragraph("result", f"does not work: {', '.join(faulty)}" if faulty else "everything needed is there"))
    if faulty:
        sys.exit(1)


def _shown(name: str, part: Callable[[], str]) -> bool:
    """Print what a part says; whether it works."""
    try:
        print(paragraph(name, part()), flush=True)
        return True
    except (Missing, ImportError) as fault:  # the latter of a package that was found missing above
        print(paragraph(name, f"error: {fault if isinstance(fault, Missing) else last_line(fault)}"), flush=True)
        return False


def packages() -> str:
    """Versions of the packages that are needed. Raises Missing if one is not there, or has another version."""
    found, faults = [], []
    for requirement, extra in _requirements():
        if extra is not None:
            continue
        version = _version(requirement.name)
        if version is None:
            faults.append(f"{requirement.name} is not installed")
        elif not requirement.specifier.contains(version, prereleases=True):
            faults.append(f"{requirement.name} {version} is not {requirement.specifier}")
        else:
            found.append(f"{requirement.name} {version}")
    if faults:
        raise Missing(f"{'; '.join(faults)}\nremedy: pip install {_DISTRIBUTION}, in an environment of its own")
    return ", ".join(sorted(found))


def libraries() -> str:
    """Whether the packages with compiled parts load. Raises Missing with what the system lacks."""
    faults = [f"{name}: {last_line(error)}" for name in _LOADED if (error := _import_error(name)) is not None]
    if faults:
        remedy = "remedy: for libGL.so.1 or libgomp.so.1: apt-get install libgl1 libgomp1"
        raise Missing("\n".join([*faults, remedy]))
    return f"{', '.join(_LOADED)} load"


def plugin() -> str:
    """What `ns-train` finds of this package, loaded as it does. Raises Missing if it would not be found."""
    lines = []
    for group, what in _GROUPS.items():
        entries = [e for e in metadata.entry_points(group=group) if e.value.startswith("sl_nerfstudio.")]
        if not entries:
            raise Missing(f"ns-train knows no {what} of this package\nremedy: pip install {_DISTRIBUTION}")
        for entry in entries:
            try:
                entry.load()
            except Exception as error:  # whatever another package's import raises: this command is to find it
                raise Missing(f"{entry.name} does not load: {type(error).__name__}: {last_line(error)}") from error
        lines.append(f"{what} {', '.join(sorted(e.name for e in entries))}")
    return "; ".join(lines)


def devices() -> str:
    """What torch can compute on."""
    import torch

    from sl_nerfstudio.parallel import cores

    used = f"{torch.get_num_threads()} threads; {cores()} of {os.cpu_count()} cores may be used"
    if not torch.cuda.is_available():
        built = torch.version.cuda
        why = "torch is built without CUDA" if built is None else f"torch, built for CUDA {built}, finds no GPU"
        return f"cpu ({used}); no cuda: {why}"
    names = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
    return f"cpu ({used}); " + ", ".join(f"cuda: {gpu.name}, {gpu.total_memory / 2**30:.0f} GiB" for gpu in names)


def backends() -> str:
    """Evaluates a small field with every backend on every device. Raises Missing if their values differ."""
    import torch

    from sl_nerfstudio.field.field import FieldConfig, SDFField

    small = FieldConfig(levels=2, max_resolution=32, log2_table_size=10, hidden=32, backend="torch")
    torch.manual_seed(0)
    field = SDFField(small)
    points, obstacle = torch.rand(1000, 3) * 2 - 1, None
    with torch.no_grad():
        values = {"torch on cpu": field.sdf(points)}
        small.backend = "numba"
        values["numba on cpu"] = field.sdf(points)
        small.backend = "torch"
        if torch.cuda.is_available():
            values["torch on cuda"] = field.to("cuda").sdf(points.to("cuda")).cpu()
            obstacle = field.obstacle("triton")
            if obstacle is None:
                small.backend = "triton"
                values["triton on cuda"] = field.sdf(points.to("cuda")).cpu()
    worst = {name: float((value - values["torch on cpu"]).abs().max()) for name, value in values.items()}
    wrong = [name for name, difference in worst.items() if not difference < _AGREE]
    if wrong:
        raise Missing(f"{', '.join(wrong)}: other values than torch on the CPU ({max(worst.values()):.2g})")
    without = "" if obstacle is None else f"; the GPU's kernels are not used: {obstacle}"
    return f"{', '.join(values)} agree to {max(worst.values()):.1g}{without}"


def extras() -> str:
    """Optional packages: which are there, and what the others would be for."""
    lines = []
    for requirement, extra in _requirements():
        if extra in _EXTRAS:
            version = _version(requirement.name)
            there = f"{requirement.name} {version}" if version else f"missing (pip install '{_DISTRIBUTION}[{extra}]')"
            lines.append(f"{extra}: {there}, for {_EXTRAS[extra]}")
    return "\n".join(lines)


def ffmpeg() -> str:
    """The program that nerfstudio's trajectories need."""
    path = shutil.which("ffmpeg")
    uses = "ns-render interpolate, camera-path and spiral need it"
    return f"{path}" if path else f"missing; only {uses}. Remedy: apt-get install ffmpeg"


def _requirements() -> Iterator[tuple[Requirement, str | None]]:
    """What the installed package asks for, each with the extra that asks for it. Raises Missing."""
    try:
        texts = metadata.requires(_DISTRIBUTION) or []
    except metadata.PackageNotFoundError as error:
        raise Missing(f"{_DISTRIBUTION} is not installed\nremedy: pip install {_DISTRIBUTION}") from error
    for requirement in map(Requirement, texts):
        names = [name for name in _EXTRAS if requirement.marker and requirement.marker.evaluate({"extra": name})]
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield requirement, None
        else:
            yield from ((requirement, name) for name in names)


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _import_error(name: str) -> Exception | None:
    try:
        importlib.import_module(name)
    except Exception as error:  # a compiled part made for another NumPy raises anything
        return error
    return None


if __name__ == "__main__":
    main()
