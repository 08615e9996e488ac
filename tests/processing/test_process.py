"""The stages of sl-process, one after the other, and the errors between them."""

import inspect
import json
import shutil
from dataclasses import astuple, replace
from types import SimpleNamespace

import numpy as np
import pytest

from sl_nerfstudio.api import write_devices
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing import consistency, inputs
from sl_nerfstudio.processing import process as stages
from sl_nerfstudio.processing.frames import FrameWorker
from sl_nerfstudio.processing.inputs import GivenPoses, frames_by_name
from sl_nerfstudio.processing.process import process, require_given_poses, write_scan
from sl_nerfstudio.processing.result import summarise
from sl_nerfstudio.registration.register import ProjectorChoice
from sl_nerfstudio.registration.result import NoCommonSurface, Registration, UndecidedProjector, parse_known_length
from sl_nerfstudio.scan import check_scan, read_scan
from sl_nerfstudio.scan.images import encode_png, read_image
from sl_nerfstudio.storage import NewFolder, write_atomic
from tests.formulas import pose_errors
from tests.processing.conftest import register_ramps
from tests.processing.ramp_scan import LAYOUT, NAMES, write_poses

pytestmark = pytest.mark.usefixtures("ramps_registered", "calibrated_before")

ALONE = "no other frame shows any of its surface; capture views in between"


def _run(config):
    log = []
    return process(config, lambda result, previews: f"{result.registered} of {len(previews)}", log.append), log


def _poses(tmp_path, poses, units="mm"):
    return write_poses(tmp_path / "r.json", poses, units=units)


def _without(registration, names):
    """The registration as if some frames had not fitted."""
    kept = np.array([name not in names for name in registration.names])
    nowhere = np.where(kept[:, None, None], registration.T_world_camera, np.nan)
    return replace(
        registration,
        registered=registration.registered & kept,
        exclusions=tuple(NoCommonSurface(name) for name in names),
        T_world_camera=nowhere,
    )


@pytest.fixture(scope="module")
def whole(ramp_scan, tmp_path_factory):
    """A run from nothing to the scan: its result, what it logged, and its folders."""
    root = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        register_ramps(patch)
        return *_run(ramp_scan.config(root / "s")), root


@pytest.fixture
def calibrated_before(ramp_scan, whole, tmp_path):
    """Later runs find all frames decoded and calibrated; they register and adjust by themselves."""
    work = [ramp_scan.config(root / "s").work_folder for root in (whole[2], tmp_path)]
    shutil.copytree(*work, ignore=shutil.ignore_patterns("registration-*", "adjustment-*"))


@pytest.fixture
def lose(monkeypatch):
    """Makes registration leave out frames, which are not placed after the adjustment either."""

    def lose(*names):
        real = stages.register
        monkeypatch.setattr(consistency, "include_left_out", lambda clouds, registration, *_: registration)
        monkeypatch.setattr(stages, "register", lambda *args: _without(real(*args), names))

    return lose


def test_every_stage_is_logged_and_the_poses_are_right(ramp_scan, whole):
    result, log, root = whole
    assert log[0] == "4 frames of 130 x 130 pixels, decoder ramps"
    assert log[1].startswith("decoded and calibrated 4 of 4 frames")
    assert "registered 4 of 4 frames" in log and log[-1].startswith("frames agree to 0.0")
    assert check_scan(root / "s") == []
    assert (root / "s" / "processing.html").read_text() == "4 of 4"
    assert json.loads((root / "s" / "processing.json").read_text()) == json.loads(json.dumps(result.document()))
    scan, true = read_scan(root / "s"), ramp_scan.T_world_camera
    assert [frame.name for frame in scan.frames] == list(NAMES) and result.document()["decoder"] == "ramps"
    np.testing.assert_allclose(scan.read_pattern(), LAYOUT.render(), atol=0.6 / 255)
    for frame, exact in zip(scan.frames, ramp_scan.coords, strict=True):
        off = np.abs(frame.read_coords() - exact)
        assert np.nanmax(off) < 800 / 65535 and np.isfinite(off).sum() > 0.99 * np.isfinite(exact).sum()
    found = scan.poses.T_world_camera
    _, degrees, off = pose_errors(found, true)
    assert off.max() < 1e-3 * np.linalg.norm(true[:, :3, 3], axis=1).mean() and degrees.max() < 0.3


@pytest.mark.slow
def test_without_the_adjustment_the_poses_are_those_of_the_registration_and_sigma_covers_them(
    monkeypatch, whole, ramp_scan, tmp_path
):
    monkeypatch.setattr(stages, "adjust_consistent", lambda *_: pytest.fail("adjusted"))
    registered = []
    real = stages.registered_only
    monkeypatch.setattr(stages, "registered_only", lambda *args: registered.append(args[1]) or real(*args))
    result, log = _run(ramp_scan.config(tmp_path / "s", no_adjust=True))
    assert log[-1] == "registered 4 of 4 frames" and result.joint_px is None
    assert result.verdict.band == "acceptable"
    assert any("registration alone (--no-adjust)" in reason for reason in result.verdict.reasons)
    scan, adjusted = read_scan(tmp_path / "s"), read_scan(whole[2] / "s")
    np.testing.assert_allclose(scan.poses.T_world_camera, registered[0].T_world_camera, atol=1e-9)
    np.testing.assert_allclose(scan.poses.baseline, registered[0].baseline, rtol=1e-9)
    S, _, off = pose_errors(scan.poses.T_world_camera, ramp_scan.T_world_camera)
    for error, rough, fine in zip(off / S.scale, scan.frames, adjusted.frames, strict=True):
        assert rough.pose_sigma is not None and fine.pose_sigma is not None
        assert rough.pose_sigma.camera_rotation_deg >= 1.0 > fine.pose_sigma.camera_rotation_deg
        distance = np.linalg.norm(rough.T_world_camera[:3, 3])
        assert error < 3 * (rough.pose_sigma.camera_translation + np.radians(1.0) * distance)


def test_frames_that_do_not_register_are_left_out_of_the_scan(lose, ramp_scan, tmp_path):
    lose(NAMES[3])
    result, log = _run(ramp_scan.config(tmp_path / "s"))
    assert "registered 3 of 4 frames" in log
    assert [frame.name for frame in read_scan(tmp_path / "s").frames] == list(NAMES[:3])
    assert result.frames[3].reason == ALONE
    assert f"{NAMES[3]}: capture it again; it was left out ({result.frames[3].reason})" in result.recapture
    assert (tmp_path / "s" / "processing.html").read_text() == "3 of 4"


def test_fewer_than_two_registered_frames_are_an_error_with_a_report(lose, ramp_scan, tmp_path):
    lose(*NAMES[1:])
    config = ramp_scan.config(tmp_path / "s")
    with pytest.raises(UserError, match="1 of 4 frames can be used, a scan needs at least 2") as caught:
        _run(config)
    assert all(f"  {name}: {ALONE}" in str(caught.value) for name in NAMES[1:])
    assert f"  {NAMES[0]}: too few other frames could be used" in str(caught.value)
    assert not config.output.exists() and (config.work_folder / "processing.html").read_text() == "0 of 4"


@pytest.mark.parametrize(("given", "usable"), [((0, 1, 2), 1), ((0, 1), 0)])
def test_too_few_registered_frames_with_given_poses_are_an_error_that_names_them(
    monkeypatch, lose, ramp_scan, tmp_path, given, usable
):
    """One pose gave a scale of NaN and none a ValueError, both after the whole adjustment."""
    lose(NAMES[0], NAMES[1])
    monkeypatch.setattr(stages, "adjust_consistent", lambda *_: pytest.fail("adjusted before the poses were checked"))
    rough = _poses(tmp_path, {NAMES[k]: ramp_scan.T_world_camera[k] for k in given})
    config = ramp_scan.config(tmp_path / "s", poses=rough)
    with pytest.raises(UserError) as caught:
        _run(config)
    said = str(caught.value)
    assert said.startswith(f"{rough}: {usable} of the {len(given)} frames with given poses could be registered")
    for name in NAMES[:2]:
        assert f"\n  {name}: left out in registering: {ALONE}\n" in said
    assert (f"\n  {NAMES[2]}: registered\n" in said) == (usable == 1)
    assert NAMES[3] not in said
    assert "\n    cause:  " in said and said.endswith("or leave --poses out") and not config.output.exists()


def test_given_poses_of_frames_that_cannot_be_decoded_do_not_count(copy, tmp_path):
    (copy.root / "images" / NAMES[0] / "0.png").write_bytes(b"broken")
    rough = _poses(tmp_path, dict(zip(NAMES[:2], copy.T_world_camera[:2], strict=True)))
    with pytest.raises(UserError, match="1 of the 2 frames with given poses could be registered") as caught:
        _run(copy.config(tmp_path / "s", poses=rough))
    said = str(caught.value)
    assert f"{NAMES[0]}: left out in reading: " in said and "0.png: is not an image that can be read" in said
    assert f"{NAMES[1]}: registered" in said


def test_other_places_of_frames_that_are_left_out_give_no_unit(ramp_scan, tmp_path, monkeypatch):
    T = ramp_scan.T_world_camera.copy()
    T[:3, :3, 3] = (1, 2, 3)
    lost = "registering", "alone"
    monkeypatch.setattr(stages, "left_out", lambda result, _: lost if result.name == NAMES[3] else None)
    results = [SimpleNamespace(name=name) for name in NAMES]
    config = ramp_scan.config(tmp_path / "s", poses=tmp_path / "r.json")
    with pytest.raises(UserError, match=r"registered frames are all at the same place\n.*frames with other positions"):
        inspect.unwrap(require_given_poses)(config, GivenPoses(T, "mm"), results, None)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("units", "length", "unit", "source"),
    [
        ("mm", None, "mm", "given camera poses"),
        ("arbitrary", None, "arbitrary", ""),
        ("mm", "baseline of frame 2 = 5 cm", "cm", f"baseline of frame {NAMES[2]}"),
    ],
)
def test_given_poses_give_axes_and_unit_unless_a_length_is_known(ramp_scan, tmp_path, units, length, unit, source):
    rough = _poses(tmp_path, dict(zip(NAMES[:3], ramp_scan.T_world_camera[:3], strict=True)), units)
    result, _ = _run(ramp_scan.config(tmp_path / "s", poses=rough, known_length=length))
    scan = read_scan(tmp_path / "s")
    assert scan.units == result.units == unit
    assert scan.scale.known == bool(source) and result.scale_source == source
    if length is None:
        np.testing.assert_allclose(scan.poses.T_world_camera, ramp_scan.T_world_camera, atol=1.0)  # mm, at 960 mm
    else:
        assert scan.scale.source == source and scan.poses.baseline[2] == pytest.approx(5, rel=1e-5)


def test_a_known_length_in_a_frame_that_failed_is_an_error_before_registration(monkeypatch, copy, tmp_path):
    (copy.root / "images" / NAMES[1] / "0.png").write_bytes(b"broken")
    monkeypatch.setattr(stages, "register", lambda *_: pytest.fail("registered"))
    with pytest.raises(UserError, match=f"--known-length: {NAMES[1]} could not be used.*\n.*cause:.*\n.*remedy:"):
        _run(copy.config(tmp_path / "s", known_length="baseline of frame 1 = 5 cm"))


def test_frames_of_a_known_length_are_found_by_number_or_name():
    bar = parse_known_length("distance between frame 1 (1, 2) and frame b (3, 4) = 5 mm")
    assert frames_by_name(bar, ["a", "1", "b"]).frames == ("1", "b")  # a name counts before a number
    assert frames_by_name(bar, ["a", "c", "b"]).frames == ("c", "b")
    for frame in ("3", "x", "²", "-1", "9" * 5000):  # Python refuses to read a number of 5000 digits
        text = f"baseline of frame {frame} = 1 m"
        with pytest.raises(UserError, match=r"there is no frame.*\n.*counted from 1\n.*a number from 0 to 2"):
            frames_by_name(parse_known_length(text), ["a", "b", "c"])


ORDER = "the frames do not follow each other in the order of capture: --unordered says so"


@pytest.mark.parametrize(
    ("unordered", "in_order", "by_all", "calls"),
    [
        (False, False, (0, 1, 0), [((0, 1, 0), True)]),  # neighbours and all frames choose the same poses
        (False, False, (0, 0, 0), [((0, 1, 0), True), ((0, 0, 0), False)]),
        (False, True, (0, 0, 0), [((0, 1, 0), True)]),
        (True, True, (0, 0, 0), [((0, 0, 0), False)]),
    ],
)
def test_frames_are_registered_again_only_if_they_have_no_order_and_all_of_them_choose_other_poses(
    monkeypatch, unordered, in_order, by_all, calls
):
    made, log, doubt = [], [], UndecidedProjector("b", 20.0)

    def register(chosen, sequence, *_):
        made.append((chosen, sequence))
        poses = np.tile(np.eye(4) * len(made), (3, 1, 1))
        return Registration(("a", "b", "c"), poses, np.ones(3), np.ones(3, dtype=bool), np.zeros(3, dtype=np.int64),
                            np.ones(3), (), (), (), ordered=sequence and in_order)  # fmt: skip

    choices = {True: ProjectorChoice((0, 1, 0), ()), False: ProjectorChoice(by_all, (doubt,))}
    monkeypatch.setattr(stages, "choose_projectors", lambda clouds, sequence, _: choices[sequence])
    monkeypatch.setattr(stages, "chosen_clouds", lambda clouds, chosen: chosen)
    monkeypatch.setattr(stages, "register", register)
    chosen, found = stages.register_clouds([], (), unordered, 0, None, log.append)
    assert made == calls and chosen == calls[-1][0] and found.T_world_camera[0, 0, 0] == len(calls)
    compared_with_all = not in_order  # what all frames say of the projectors counts
    assert log == [ORDER] * compared_with_all
    assert found.exclusions == ((doubt,) if unordered or compared_with_all else ())


@pytest.mark.slow
def test_photographs_that_are_shrunk_give_the_same_scan_at_another_size(ramp_scan, whole, tmp_path, monkeypatch):
    """Captures three times as large, with what belongs to their pixels: a mask, colours, and two picked places.

    Cameras, maps and images of the scan are those of the captures that they were enlarged from.
    """
    factor, large = 3, tmp_path / "large"
    large.mkdir()
    for path in (ramp_scan.root / "images").rglob("*.png"):
        fine = np.pad(read_image(path).repeat(factor, 0).repeat(factor, 1), ((0, 1), (0, 2)))  # fill no whole square
        write_atomic(large / "images" / path.relative_to(ramp_scan.root / "images"), encode_png(fine))
    h, w = (factor * ramp_scan.camera.h + 1, factor * ramp_scan.camera.w + 2)
    mask = np.full((h, w), 255, np.uint8)
    mask[: 3 * factor] = 0
    for name in NAMES:
        write_atomic(large / "masks" / f"{name}.png", encode_png(mask))
        write_atomic(large / "colours" / f"{name}.png", encode_png(np.dstack([mask // 2] * 3)))
    camera = replace(ramp_scan.camera.scaled(float(factor)), w=w, h=h)
    write_devices(large / "intrinsics.json", camera, ramp_scan.projector)
    (large / "pattern.json").write_bytes(LAYOUT.encode())
    scan = read_scan(whole[2] / "s")
    at = [np.argwhere(np.isfinite(scan.frames[k].read_coords()[..., 0]))[400] for k in (0, 1)]
    x, y = ([(c + 0.5) * factor for c in rc[::-1]] for rc in at)
    length = f"distance between frame a 1 ({x[0]}, {x[1]}) and frame a 2 ({y[0]}, {y[1]}) = 50 mm"
    monkeypatch.setattr(inputs, "shrink_factor", lambda *_: factor)
    config = replace(ramp_scan, root=large).config(
        tmp_path / "shrunk", masks=large / "masks", color=large / "colours", known_length=length
    )
    result, log = _run(config)
    small = read_scan(config.output)
    assert "392 x 391 pixels are read as 130 x 130" in log[1] and "--full-size" in log[1]
    assert result.captured.shrink == factor
    assert check_scan(config.output) == [] and small.shrunk_by == factor
    assert astuple(small.frames[0].camera)[:-1] == pytest.approx(astuple(ramp_scan.camera)[:-1])
    for one, other in zip(small.frames, scan.frames, strict=True):
        np.testing.assert_array_equal(one.read_image(), other.read_image())
        np.testing.assert_array_equal(one.read_coords()[3:], other.read_coords()[3:])
        assert not one.read_mask()[:3].any() and one.read_color().shape == (130, 130, 3)
    np.testing.assert_allclose([end.pixel for end in small.scale.bar.ends], [rc[::-1] + 0.5 for rc in at])


@pytest.fixture
def made(ramp_scan, ramp_job, results, registration, poses, tmp_path):
    """Job, results, poses and the result of a run that has not been written."""
    return ramp_job, results, poses, summarise(ramp_scan.config(tmp_path), "ramps", results, registration, poses)


def test_what_is_written_is_what_was_found(made, tmp_path):
    job, results, poses, _ = made
    previews = []
    with NewFolder(tmp_path / "s") as folder:
        write_scan(folder, *made, {}, lambda _, shown: previews.extend(shown) or "page")
    assert check_scan(tmp_path / "s") == []
    scan = read_scan(tmp_path / "s")
    assert (scan.projector, scan.units, scan.scale) == (job.projector, "arbitrary", poses.scale)
    np.testing.assert_allclose(scan.poses.T_world_camera, poses.adjusted.poses.T_world_camera, atol=1e-12)
    np.testing.assert_allclose(scan.poses.T_world_projector, poses.adjusted.poses.T_world_projector, atol=1e-12)
    worker = FrameWorker(job)
    for frame, stage, sigma in zip(scan.frames, results, poses.adjusted.sigma, strict=True):
        decoded = worker.load(stage)
        assert frame.name == stage.name and frame.camera == job.camera and frame.pose_sigma == sigma
        np.testing.assert_array_equal(frame.read_image(), read_image(stage.frame.images[0]))
        np.testing.assert_array_equal(frame.read_coords(), stage.cloud.coords)
        np.testing.assert_array_equal(frame.read_mask(), decoded.mask)
        np.testing.assert_allclose(frame.read_pattern(), decoded.pattern, atol=0.51 / 255)
    assert (tmp_path / "s" / "pattern.json").read_bytes() == LAYOUT.encode()
    assert (tmp_path / "s" / "processing.html").read_text() == "page"
    assert len(previews) == 4 and all(p.image is not None and p.coords is not None for p in previews)


def test_frames_that_are_not_in_the_scan_are_only_shown(made, tmp_path):
    job, results, poses, result = made
    lost = replace(result.frames[1], in_scan=False, stage="registering", reason="alone")
    failed = replace(results[3], cloud=None, stage="calibrating", reason="flat")
    some = replace(result, frames=(result.frames[0], lost, result.frames[2], replace(lost, name=NAMES[3])))
    previews = []
    with NewFolder(tmp_path / "s") as folder:
        write_scan(folder, job, [*results[:3], failed], poses, some, {}, lambda _, p: previews.extend(p) or "")
    scan = read_scan(tmp_path / "s")
    assert [frame.name for frame in scan.frames] == [NAMES[0], NAMES[2]]
    np.testing.assert_allclose(scan.poses.T_world_camera, poses.adjusted.poses.T_world_camera[[0, 2]], atol=1e-12)
    assert [preview.coords is None for preview in previews] == [False, False, False, True]
    assert all(preview.image is not None for preview in previews)


def test_nothing_is_left_if_writing_fails(made, tmp_path):
    job, results, poses, result = made
    away = replace(job, work=tmp_path / "other")
    with (
        pytest.raises(UserError, match=f"the decoded frame {NAMES[0]} is missing"),
        NewFolder(tmp_path / "s") as folder,
    ):
        write_scan(folder, away, results, poses, result, {}, lambda *_: "")
    assert not (tmp_path / "s").exists()
