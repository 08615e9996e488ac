"""What people ran into, as they ran it: each case is a command on their files, and what it has to say.

The files are in the folder `cases` beside that of the real captures, or where SL_CASES says; cases whose files are
not there are skipped. The same kinds of input, made here, are tested beside what they are about.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from sl_nerfstudio.calibration.formats import read_device_file
from sl_nerfstudio.cli import check, process
from sl_nerfstudio.errors import UserError
from tests.cli.snapshots import Ended, call

REAL_DATA = Path(os.environ.get("SL_REAL_DATA", Path(__file__).parents[3] / "shared" / "data"))
FOLDER = Path(os.environ.get("SL_CASES", REAL_DATA.parent / "cases"))


@dataclass(frozen=True)
class Case:
    """A command on the files of a case."""

    name: str  # folder of the case
    main: Callable[[], None]
    words: tuple[str, ...]  # {case} and {out} stand for the case's folder and an empty one
    ends: Callable[[Ended], None]  # asserts what must be so


def folder_of(name: str) -> Path:
    folder = FOLDER / name
    if not folder.exists():
        pytest.skip(f"the files of this case were not found: {folder} (set SL_CASES to their folder)")
    return folder


def refused(*words: str) -> Callable[[Ended], None]:
    """The command ends with an error that has these words."""

    def check_error(ended: Ended) -> None:
        assert ended.status == 1, ended.out
        assert all(word in ended.err for word in words), ended.err

    return check_error


def turntable(ended: Ended) -> None:
    """What turns was registered, or the verdict says what the scan holds."""
    said = ended.out + ended.err
    assert ended.status == 0, said
    assert "turntable with a static background" in said and "verdict: good" not in said, said


ORDER = ("does not fit the coordinates", "interpreted that way", "one frame early", "put the")
CASES = (
    Case("poses_off_by_one", check.main, ("sl-check", "{case}/both_off_by_one"), refused(*ORDER, "both devices")),
    Case("poses_off_by_one", check.main, ("sl-check", "{case}/proj_off_by_one"), refused(*ORDER, "projector poses")),
    Case("poses_off_by_one", check.main, ("sl-check", "{case}/cam_off_by_one"), refused(*ORDER, "camera poses")),
    Case("poses_off_by_one", check.main, ("sl-check", "{case}/ns_world_cam_only"),
         refused("two different worlds", "x, -z, y", "nerfstudio")),
    Case("same_projector_pose", check.main, ("sl-check", "{case}/proj_all_same"),
         refused("1 fault", "is the same in 8 of 8 frames", "was copied", "sl-process")),
    Case("turntable_static_wall", process.main,
         ("sl-process", "--images", "{case}/images", "--pattern", "{case}/pattern.json",
          "--intrinsics", "{case}/intrinsics.json", "--output", "{out}/p"), turntable),
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.name}-{case.words[1].split('/')[-1]}")
def test_a_case(case: Case, tmp_path: Path) -> None:
    folder = folder_of(case.name)
    words = [word.format(case=folder, out=tmp_path) for word in case.words]
    case.ends(call(case.main, *words))


@pytest.mark.parametrize(("role", "term"), [("camera", "k6 = -50.8"), ("projector", "k6 = -29.1")])
def test_of_fourteen_lens_terms_those_that_are_zero_are_passed_over_and_others_named(role: str, term: str) -> None:
    folder, size = folder_of("opencv_14_terms"), (1136, 1046)
    camera, projector = (read_device_file(folder / "stereo14_zero.yml", one, size) for one in ("camera", "projector"))
    assert (camera.fl_x, camera.cx) == (3173.5470908336333, 568.0544331842342 + 0.5)
    assert (camera.k1, camera.k2, camera.p1) == (-0.18827534553754133, 2.7711625543207616, 0)
    assert (projector.cx, projector.k1) == pytest.approx((567.17323067777738 + 0.5, -0.24851802551104779), abs=1e-6)
    said = rf"stereo\.yml: {role}: the lens model has terms beyond .*\({term}\)(.|\n)*CALIB_RATIONAL_MODEL"
    with pytest.raises(UserError, match=said):
        read_device_file(folder / "stereo.yml", role, size)
