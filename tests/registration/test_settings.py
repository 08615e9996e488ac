"""Settings of relative pose estimation and of registration: documented, frozen, used, and obeyed."""

import ast
import dataclasses
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sl_nerfstudio import registration
from sl_nerfstudio.registration import settings as registration_settings
from sl_nerfstudio.registration import settings as symmetry_settings
from sl_nerfstudio.registration import settings as tone_settings
from sl_nerfstudio.registration.settings import FrameCloudSettings
from sl_nerfstudio.registration.surfaces import frame_cloud
from sl_nerfstudio.relative_pose.estimation import RelativePoseError
from tests.relative_pose.known_pose import known_pose
from tests.relative_pose.two_views import view

MODULES = {
    registration_settings: registration,
    symmetry_settings: registration,
    tone_settings: registration,
}
CLASSES = [
    (module, cls)
    for module in MODULES
    for cls in vars(module).values()
    if dataclasses.is_dataclass(cls) and isinstance(cls, type) and cls.__module__ == module.__name__
]


@pytest.mark.parametrize(("module", "cls"), CLASSES, ids=lambda x: getattr(x, "__name__", ""))
def test_every_setting_is_frozen_documented_and_used(module, cls):
    source = Path(module.__file__)
    package = Path(MODULES[module].__file__).parent
    code = "\n".join(p.read_text() for p in package.rglob("*.py") if p != source)
    tree = ast.parse(source.read_text())
    body = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == cls.__name__).body
    texts = {
        ast.unparse(field.target): following.value.value
        for field, following in pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(following, ast.Expr)
    }
    assert cls.__dataclass_params__.frozen
    for field in dataclasses.fields(cls):
        assert re.search(r"\w+ \w+", texts[field.name]), field.name
        assert re.search(rf"\.{field.name}\b", code), f"{cls.__name__}.{field.name} is not used"


@pytest.mark.parametrize("package", [registration], ids=["registration"])
def test_no_other_file_has_numbers_of_its_own(package):
    """Numbers that decide something are settings; a private constant elsewhere would hide one."""
    for path in Path(package.__file__).parent.rglob("*.py"):
        if path.name == "settings.py":
            continue
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.Assign):
                held = [n.value for n in ast.walk(node.value) if isinstance(n, ast.Constant)]
                numbers = [v for v in held if isinstance(v, int | float) and not isinstance(v, bool)]
                name = ast.unparse(node.targets[0])
                assert not numbers or name == "_METRES", f"{path.name}: {name}"


def test_the_limit_of_a_cloud_is_obeyed():
    frame = view(count=100)
    coords = np.full((frame.camera.h, frame.camera.w, 2), np.nan, dtype=np.float32)
    column, row = np.floor(frame.uv_camera).astype(int).T
    coords[row, column] = frame.uv_projector
    count = int(np.isfinite(coords).all(-1).sum())
    uv = np.argwhere(np.isfinite(coords).all(-1))[:, ::-1] + 0.5
    pose = known_pose(
        frame.T_camera_projector, uv, coords[np.isfinite(coords).all(-1)].astype(np.float64),
        frame.camera, frame.projector,
    )  # fmt: skip
    pose = replace(pose, inliers=np.full(count, True))
    devices = frame.camera, frame.projector
    assert len(frame_cloud("a", coords, *devices, pose).points) == count
    with pytest.raises(RelativePoseError, match=rf"a: only {count} points agree .* \(at least 1000\)"):
        frame_cloud("a", coords, *devices, pose, FrameCloudSettings(fewest_points=1000))
