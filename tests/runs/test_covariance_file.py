"""The covariance beside refined poses: written, read, and refused if it is that of something else."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.runs.export import COVARIANCE, read_covariance, write_covariance
from sl_nerfstudio.scan import FileError, Scan

from .ball_run import ball_scan


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return ball_scan(tmp_path_factory.mktemp("covariance") / "scan")


def test_what_was_written_is_read_and_a_run_without_it_removes_it(scan: Scan, tmp_path):
    factor = np.random.default_rng(0).normal(size=(78, 50))
    write_covariance(tmp_path, scan, JointCovariance(factor))
    found = read_covariance(tmp_path, scan)
    assert found is not None and np.array_equal(found.factor, factor) and found.frames == 6
    write_covariance(tmp_path, scan, None)
    assert read_covariance(tmp_path, scan) is None and list(tmp_path.iterdir()) == []
    write_covariance(tmp_path, scan, None)


def test_files_of_other_scans_and_damaged_ones_are_refused(scan: Scan, tmp_path):
    joint = JointCovariance(np.eye(78))
    write_covariance(tmp_path, scan, joint)
    for other in (replace(scan, units="cm"), replace(scan, frames=scan.frames[:5])):
        with pytest.raises(FileError, match=r"is that of other frames or another unit\n    cause:"):
            read_covariance(tmp_path, other)
    content = (tmp_path / COVARIANCE).read_bytes()
    (tmp_path / COVARIANCE).write_bytes(content[: len(content) // 2])
    with pytest.raises(FileError, match="cannot be read"):
        read_covariance(tmp_path, scan)
    write_covariance(tmp_path, scan, JointCovariance(np.eye(66)))
    with pytest.raises(FileError, match=r"factor: is float64 \(66, 66\)"):
        read_covariance(tmp_path, scan)
    np.savez(tmp_path / COVARIANCE, something=np.eye(3))
    with pytest.raises(FileError, match="cannot be read"):
        read_covariance(tmp_path, scan)
