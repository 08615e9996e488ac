"""`python -m sl_nerfstudio`: what works is named, and what does not has a remedy and exit status 1."""

import importlib
import warnings
from collections.abc import Callable
from importlib import metadata

import pytest
import torch

from sl_nerfstudio import __main__ as environment
from sl_nerfstudio.field.numba_backend import NumbaField


@pytest.fixture(autouse=True)
def _warnings_stay_errors():
    """The command silences other packages' warnings for its process, which is this one here."""
    with warnings.catch_warnings():
        yield


def said(capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """What was printed beside each name."""
    lines, name = {}, ""
    for line in capsys.readouterr().out.splitlines()[1:]:
        name = line[:12].strip() or name
        lines[name] = f"{lines.get(name, '')} {line[12:].strip()}".strip()
    return lines


def test_everything_is_named_and_works(capsys):
    environment.main()
    out = said(capsys)
    assert list(out) == ["packages", "libraries", "nerfstudio", "devices", "field", "extras", "ffmpeg", "result"]
    assert f"torch {torch.__version__.split('+')[0]}" in out["packages"] and "nerfstudio 1.1" in out["packages"]
    assert out["nerfstudio"] == "methods sl-neus, sl-neus-paper; dataparsers sl-data"
    assert out["field"].startswith("torch on cpu, numba on cpu") and out["devices"].startswith("cpu (")
    assert all(f"{extra}: " in out["extras"] for extra in ("show", "phone", "video", "las"))
    assert out["result"] == "everything needed is there"


def versions(changed: dict[str, str | None]) -> Callable[[str], str]:
    real = metadata.version

    def version(name: str) -> str:
        found = changed.get(name, real(name))
        if found is None:
            raise metadata.PackageNotFoundError(name)
        return found

    return version


def test_packages_that_are_missing_or_too_old_end_with_a_remedy(capsys, monkeypatch):
    monkeypatch.setattr(metadata, "version", versions({"trimesh": None, "torch": "2.1.0"}))
    for part in ("plugin", "libraries", "backends"):
        monkeypatch.setattr(environment, part, lambda: "fine")
    with pytest.raises(SystemExit) as end:
        environment.main()
    out = said(capsys)
    assert end.value.code == 1 and out["result"] == "does not work: packages"
    assert "trimesh is not installed" in out["packages"] and "torch 2.1.0 is not >=2.6" in out["packages"]
    assert "remedy: pip install sl-nerfstudio" in out["packages"]


def test_an_extra_that_is_missing_is_no_fault(monkeypatch):
    monkeypatch.setattr(metadata, "version", versions({"pillow-heif": None}))
    assert "phone: missing (pip install 'sl-nerfstudio[phone]')" in environment.extras()


def test_a_library_that_does_not_load_names_the_system_package(monkeypatch):
    real = importlib.import_module

    def load(name: str) -> object:
        if name == "cv2":
            raise ImportError("libGL.so.1: cannot open shared object file: No such file or directory")
        return real(name)

    monkeypatch.setattr(importlib, "import_module", load)
    with pytest.raises(environment.Missing, match=r"cv2: libGL.so.1(.|\n)*apt-get install libgl1"):
        environment.libraries()


def test_a_backend_with_other_values_is_found(monkeypatch):
    evaluate = NumbaField.evaluate
    monkeypatch.setattr(NumbaField, "evaluate", lambda self, *a: (evaluate(self, *a)[0] + 0.01, None))
    with pytest.raises(environment.Missing, match="numba on cpu: other values than torch"):
        environment.backends()


def test_without_installation_the_remedy_is_to_install(monkeypatch):
    def requires(name: str) -> list[str]:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "requires", requires)
    with pytest.raises(environment.Missing, match="sl-nerfstudio is not installed"):
        environment.packages()


@pytest.mark.parametrize("program", ["", "ffmpeg"])
def test_ffmpeg_is_looked_for(tmp_path, monkeypatch, program):
    if program:
        (tmp_path / program).touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    found = environment.ffmpeg()
    assert found == str(tmp_path / program) if program else found.startswith("missing; only ns-render interpolate")
