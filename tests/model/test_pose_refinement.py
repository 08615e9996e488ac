"""From a scan on disk to refined poses: disturbed ones are corrected; results that do not improve are rejected."""

import copy
from dataclasses import replace
from math import radians
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch

from sl_nerfstudio.bundle_adjustment.covariance import with_known_length
from sl_nerfstudio.bundle_adjustment.parameters import gauge_directions
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.dataparser.dataparser import LoadedScan, PixelSamples, build_samples, scan_fingerprint
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import UNCHANGED, Device, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.methods import sl_neus
from sl_nerfstudio.model import messages
from sl_nerfstudio.model.messages import RefinedIntrinsics, poses_message, refine_intrinsics, refined_intrinsics_message
from sl_nerfstudio.model.pose_refinement import (
    PriorConfig,
    ScanAdjustment,
    adjust_scan,
    adjusted,
    known_length,
    maps_and_held_out,
    pose_prior,
    scene_rig,
)
from sl_nerfstudio.model.run_files import as_tensor
from sl_nerfstudio.model.trainer import SLTrainerConfig
from sl_nerfstudio.scan import PickedPixel, PoseSigma, Scale, ScaleBar, Scan, ScanWriter, measured_length, read_scan

from ..bundle_adjustment.analytic import PROJECTORS, camera_of, disturbed, images_of, rig_of

pytestmark = pytest.mark.slow

FRAMES, SIZE, MM = 6, 80, 50.0
NOISE_PX = 0.05
S_SCENE_WORLD = Similarity(1 / MM, np.eye(3), np.zeros(3))
BAR = ScaleBar((PickedPixel("frame_00001", (41.0, 38.5)), PickedPixel("frame_00004", (36.0, 44.0))), 1.0)
QUICK = AdjustmentSettings(
    anchors_per_frame=80, frames_per_anchor=3, max_iterations=40, further_searches=False, other_minima=False
)


def in_mm(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    world = S_SCENE_WORLD.inverse()
    return world.poses(rig.T_world_camera.numpy()), world.poses(rig.T_world_projector.numpy())


def with_poses(scan: Scan, rig: Rig) -> Scan:
    """The same files with other starting poses."""
    poses = zip(scan.frames, *in_mm(rig), strict=True)
    return replace(scan, frames=tuple(replace(f, T_world_camera=c, T_world_projector=p) for f, c, p in poses))


@pytest.fixture(scope="module")
def true() -> Rig:
    return rig_of(FRAMES, SIZE)


@pytest.fixture(scope="module")
def scan(true, tmp_path_factory) -> Scan:
    root: Path = tmp_path_factory.mktemp("adjust_scan") / "scan"
    blank = np.zeros((SIZE, SIZE), dtype=np.uint8)
    blank[::2] = 200
    generator = torch.Generator().manual_seed(0)
    with ScanWriter(
        root,
        units="mm",
        scale=Scale(True, "baseline of frame 1", baseline_of="frame_00001"),
        projector=PROJECTORS["pinhole"],
        pattern=np.tile(np.arange(0, 200, dtype=np.uint8), (400, 2)),
        camera=camera_of(SIZE),
    ) as writer:
        for k, (coords, c, p) in enumerate(zip(images_of(true, SIZE), *in_mm(true), strict=True)):
            coords = coords + NOISE_PX * torch.randn(coords.shape, generator=generator)
            mask = coords.isfinite().all(-1).numpy()
            name = f"frame_{k:05d}"
            writer.add_frame(name, image=blank, coords=coords.numpy(), mask=mask, T_world_camera=c, T_world_projector=p)
    return read_scan(root)


def test_disturbed_poses_are_refined_and_the_known_baseline_is_kept(scan, true):
    start = disturbed(true, 1)
    found = adjust_scan(with_poses(scan, start), S_SCENE_WORLD, build_samples(scan), "known-rig", PriorConfig(), QUICK)
    assert found.adjusted and found.cross_validation.after_px < 0.82 * found.cross_validation.before_px
    assert poses_message(found).startswith("Poses adjusted: held-out pixels agree to ")
    relative = found.rig.T_camera_projector
    assert torch.allclose(relative, true.T_camera_projector, atol=1e-9)
    assert (found.sigma[:, :6] > 0).all() and found.sigma.isfinite().all()
    centres = (found.rig.T_world_camera[:, :3, 3], true.T_world_camera[:, :3, 3], start.T_world_camera[:, :3, 3])
    apart = [torch.cdist(c, c) for c in centres]
    assert (apart[0] - apart[1]).abs().max() < 0.5 * (apart[2] - apart[1]).abs().max()


def adjusted_poses(scan: Scan, samples: PixelSamples) -> ScanAdjustment:
    """The result of the adjustment without cross-validation."""
    maps, _ = maps_and_held_out(scan, samples)
    return adjusted(scan, S_SCENE_WORLD, maps, "free", PriorConfig(), QUICK)


@pytest.mark.parametrize(
    "scale, size", [(Scale(True, "given camera poses"), 1.0), (Scale(True, "a ruler", baseline_of="frame_00001"), 1.02)]
)
def test_the_scan_says_which_lengths_are_trusted(scan, true, scale, size):
    """Camera positions are stated correctly; all baselines are stated 2 % longer than they are."""
    start = rig_of(FRAMES, SIZE)
    start.T_camera_projector[:, :3, 3] *= 1.02
    sigma = PoseSigma(0.05, 0.05, 1.0, 0.3)
    said = with_poses(scan, start)
    said = replace(said, scale=scale, frames=tuple(replace(f, pose_sigma=sigma) for f in said.frames))
    found = adjusted_poses(said, build_samples(scan))
    apart = [torch.cdist(T[:, :3, 3], T[:, :3, 3]).sum() for T in (found.rig.T_world_camera, true.T_world_camera)]
    assert float(apart[0] / apart[1]) == pytest.approx(size, abs=5e-3)


def in_world(found: ScanAdjustment) -> DevicePoses:
    """The adjusted poses in the scan's world and unit."""
    return found.rig.poses(S_SCENE_WORLD.inverse())


def test_a_scale_bar_has_its_length_after_the_adjustment(scan, true):
    """The lengths of the starting poses are 10 % too small, as the bar shows; its ends are single pixels of 80."""
    length = measured_length(scan, BAR, scan.poses)
    bar = ScaleBar(BAR.ends, length)
    small = disturbed(true, 1)
    small.T_world_camera[:, :3, 3] *= 0.9
    small.T_camera_projector[:, :3, 3] *= 0.9
    start = replace(with_poses(scan, small), scale=Scale(True, "a ruler", bar=bar))
    found = adjusted_poses(start, build_samples(scan))
    assert measured_length(start, bar, in_world(found)) == pytest.approx(length, rel=1e-9)
    assert abs(measured_length(start, bar, start.poses) / length - 1) > 0.05
    apart = [torch.cdist(T[:, :3, 3], T[:, :3, 3]).sum() for T in (found.rig.T_world_camera, true.T_world_camera)]
    assert float(apart[0] / apart[1]) == pytest.approx(1, abs=4e-2)


def test_poses_that_do_not_improve_are_kept_bit_for_bit(scan, true):
    """`off` changes nothing, so the result is no better."""
    found = adjust_scan(
        scan, S_SCENE_WORLD, build_samples(scan), "off", PriorConfig(), replace(QUICK, max_iterations=1)
    )
    rig = scene_rig(scan, S_SCENE_WORLD)
    assert not found.adjusted and torch.equal(found.rig.T_world_camera, rig.T_world_camera)
    assert torch.equal(found.rig.T_world_projector, rig.T_world_projector)
    prior = pose_prior(scan, S_SCENE_WORLD, PriorConfig())
    assert torch.equal(found.sigma[:, 0], prior.frame_translation)  # no information was added
    assert torch.equal(found.sigma[:, 11], prior.relative_rotation)
    assert poses_message(found).startswith("Poses NOT changed")


def test_poses_that_are_right_are_kept_and_known_as_well_as_the_captures_tell(scan):
    found = adjust_scan(scan, S_SCENE_WORLD, build_samples(scan), "free", PriorConfig(), QUICK)
    rig, prior = scene_rig(scan, S_SCENE_WORLD), pose_prior(scan, S_SCENE_WORLD, PriorConfig())
    assert not found.adjusted and torch.equal(found.rig.T_world_camera, rig.T_world_camera)
    assert (found.sigma < 0.5 * prior.sigma).all()
    frames = found.factor[: 6 * FRAMES].norm(dim=1).reshape(FRAMES, 6)
    assert (frames < 0.5 * prior.sigma[:, :6]).all()


def test_the_prior_is_the_stated_one_else_the_default(scan, true):
    stated = PoseSigma(
        camera_translation=2.0, camera_rotation_deg=1.5, relative_translation=0.0, relative_rotation_deg=0.1
    )
    frames = (replace(scan.frames[0], pose_sigma=stated), *scan.frames[1:])
    prior = pose_prior(replace(scan, frames=frames), S_SCENE_WORLD, PriorConfig())
    first = [float(s[0]) for s in (prior.frame_translation, prior.frame_rotation)]
    assert first == pytest.approx([2.0 / MM, radians(1.5)])
    assert float(prior.relative_rotation[0]) == pytest.approx(radians(0.1))
    assert 0 < float(prior.relative_translation[0]) < 1e-6  # known exactly, but the sigma is not zero
    assert float(prior.frame_translation[1]) == 0.1 and float(prior.frame_rotation[1]) == pytest.approx(radians(2))
    baseline = float(true.T_camera_projector[1, :3, 3].norm())
    assert float(prior.relative_translation[1]) == pytest.approx(0.05 * baseline)


CORRECTABLE = IntrinsicsChange.of((-0.018, 0.006, 0.0, 0.014, 0.0, -0.008))


def stated_with(scan: Scan, change: IntrinsicsChange) -> LoadedScan:
    """The scan as it would be loaded from a folder with other intrinsics."""
    wrong = replace(scan.with_intrinsics_change(change), intrinsics_change=UNCHANGED)
    return LoadedScan(wrong, build_samples(scan), S_SCENE_WORLD)


def relative_error(found: ScanAdjustment, true: Rig) -> float:
    return float((found.rig.T_camera_projector - true.T_camera_projector).abs().max())


@pytest.fixture(scope="module")
def corrected(scan) -> RefinedIntrinsics:
    """Held-out pixels decide once: of repeated decisions on the same pixels one would be positive by chance."""
    with mock.patch.object(messages, "cross_validate", wraps=messages.cross_validate) as decisions:
        found = refine_intrinsics(stated_with(scan, CORRECTABLE), UNCHANGED, "free", PriorConfig(), QUICK)
    assert decisions.call_count == 1
    return found


def cameras_of(scan: Scan) -> list[Device]:
    return [frame.camera for frame in scan.frames]


def test_wrong_intrinsics_are_corrected_and_poses_with_them(scan, true, corrected):
    """In images of 80 pixels only the ratio of the focal lengths is observable, not whether both are too long."""
    loaded = stated_with(scan, CORRECTABLE)
    assert corrected.before.intrinsics is not None and corrected.before.intrinsics.contradicts()
    assert corrected.changed and corrected.cross_validation.better
    changed = loaded.scan.with_intrinsics_change(corrected.change)
    ratio = changed.frames[0].camera.fl_x / scan.frames[0].camera.fl_x / (changed.projector.fl_x / scan.projector.fl_x)
    assert abs(ratio - 1) < 0.35 * abs((1 + CORRECTABLE.camera.focal) / (1 + CORRECTABLE.projector.focal) - 1)
    assert relative_error(corrected.after, true) < 0.5 * relative_error(corrected.before, true)
    text = refined_intrinsics_message(corrected, cameras_of(loaded.scan), loaded.scan.projector)
    assert text.startswith("Intrinsics changed (chi square ") and "camera: focal length " in text
    assert "projector: focal length -" in text


def test_correct_intrinsics_do_not_change_at_all(scan):
    found = refine_intrinsics(stated_with(scan, UNCHANGED), UNCHANGED, "free", PriorConfig(), QUICK)
    assert found.change == UNCHANGED and found.after is found.before and not found.changed
    text = refined_intrinsics_message(found, cameras_of(scan), scan.projector)
    assert text.startswith("Intrinsics NOT changed: the captures agree with them (chi square ")


def test_refinement_starts_from_a_stated_change(scan, corrected):
    """Intrinsics that were refined once are not contradicted again, and do not change."""
    found = refine_intrinsics(stated_with(scan, CORRECTABLE), corrected.change, "free", PriorConfig(), QUICK)
    assert found.change == corrected.change and not found.changed


def settings_for(scan: Scan, **model: object) -> SLTrainerConfig:
    config = copy.deepcopy(sl_neus.config)
    assert isinstance(config, SLTrainerConfig)
    config.data = config.pipeline.datamanager.data = scan.root
    for name, value in model.items():
        setattr(config.pipeline.model, name, value)
    return config


def test_a_run_stores_the_change_in_its_settings(scan, corrected, monkeypatch, capsys):
    """Everything that opens the run later reads these settings, and so uses the same devices."""
    calls = []

    def found(*arguments) -> RefinedIntrinsics:
        calls.append(arguments)
        return corrected

    monkeypatch.setattr("sl_nerfstudio.model.trainer.refine_intrinsics", found)
    config = settings_for(scan, refine_intrinsics=True, refine_poses="rigid-rig")
    config.prepare()
    assert config.pipeline.datamanager.dataparser.intrinsics_change == corrected.change != UNCHANGED
    ((loaded, *arguments),) = calls
    model = config.pipeline.model
    assert loaded.scan.root == scan.root and arguments == [UNCHANGED, "rigid-rig", model.prior, model.adjustment]
    assert model.refine_intrinsics  # the user's own setting does not change
    assert "Intrinsics changed" in capsys.readouterr().out


def checkpoint_of(folder: Path, scan: Scan, change: IntrinsicsChange) -> Path:
    folder.mkdir()
    weights = {
        "_model.intrinsics_change": torch.tensor(change.values, dtype=torch.float64),
        "scan_fingerprint": as_tensor(scan_fingerprint(scan)),
    }
    state = {"step": 9, "pipeline": weights, "optimizers": {}, "schedulers": {}, "scalers": {}}
    state["schedule_iterations"] = 700
    torch.save(state, folder / "step-000000009.ckpt")
    return folder


def test_a_resumed_run_has_the_intrinsics_of_its_checkpoint(scan, corrected, tmp_path, monkeypatch):
    """Nothing is refined a second time, and the flag may remain set."""
    monkeypatch.setattr("sl_nerfstudio.model.trainer.refine_intrinsics", lambda *_: pytest.fail("refined again"))
    config = settings_for(scan, refine_intrinsics=True)
    config.load_dir = checkpoint_of(tmp_path / "models", scan, corrected.change)
    config.prepare()
    assert config.pipeline.datamanager.dataparser.intrinsics_change == corrected.change
    assert config.schedule_iterations == 700
    config.pipeline.datamanager.dataparser.intrinsics_change = CORRECTABLE
    remedy = "remedy: leave the option out; the run then continues with the same intrinsics"
    with pytest.raises(UserError, match=rf"the checkpoint was trained with(.|\n)*{remedy}"):
        config.prepare()


@pytest.mark.parametrize("settings", [{"refine_poses": "off"}, {"pose_method": "render"}])
def test_intrinsics_are_not_refined_without_poses(scan, settings):
    config = settings_for(scan, refine_intrinsics=True, **settings)
    with pytest.raises(UserError, match=r"--pipeline\.model\.refine-intrinsics: .*but the poses are not adjusted"):
        config.prepare()


@pytest.mark.parametrize("scale", [
    Scale(True, "a ruler", baseline_of="frame_00002"), Scale(False), Scale(True, "a bar", bar=BAR), Scale(True, "all"),
])  # fmt: skip
def test_the_length_that_fixes_the_scale_has_no_uncertainty(scan, true, scale):
    """Its logarithm, by differences; the covariance of everything else is that of errors less a growth."""
    said = replace(scan, scale=scale)
    prior = pose_prior(said, S_SCENE_WORLD, PriorConfig())
    known = known_length(said, S_SCENE_WORLD, "free", true, prior)
    growth = gauge_directions(true)
    assert known @ growth[:, 6] == pytest.approx(1, abs=1e-6)
    assert (known @ growth[:, :6]).abs().max() < 1e-6  # a motion of the whole scene changes no length
    generator = torch.Generator().manual_seed(0)
    errors = torch.randn(200, 12 * FRAMES + 6, generator=generator, dtype=torch.float64)
    factor = with_known_length(errors.T, true, known)
    found = factor @ factor.T
    assert known @ found[:-6, :-6] @ known == pytest.approx(0, abs=1e-6)
    grown = torch.cat([growth[:, 6], torch.zeros(6)])
    kept = errors - (errors[:, :-6] @ known)[:, None] * grown
    assert torch.allclose(found, kept.T @ kept, atol=1e-6)
    if scale.baseline_of is not None or not scale.known:
        step = 1e-6 * torch.randn(2, FRAMES, 6, generator=generator, dtype=torch.float64)
        lengths = [torch.log(rig.baseline) for rig in (true.moved(*step), true.moved(*-step))]
        change = (lengths[0] - lengths[1]) / 2
        expected = change[2] if scale.known else change.mean()
        assert known @ step.reshape(-1) == pytest.approx(float(expected), rel=1e-5)
