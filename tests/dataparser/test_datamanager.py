import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from sl_nerfstudio.dataparser.datamanager import SLDataManager, SLDataManagerConfig
from sl_nerfstudio.dataparser.dataparser import SLDataParserConfig
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import UNCHANGED, Device, Intrinsics, IntrinsicsChange, project
from sl_nerfstudio.geometry.lie import inverse, transform
from tests.dataparser.tiny_scan import CAMERA, TinyScan

# nerfstudio's Cameras use a way of indexing that torch has deprecated
pytestmark = pytest.mark.filterwarnings("ignore:Using a non-tuple sequence for multidimensional indexing:UserWarning")

SKEWED = Device(w=48, h=40, fl_x=90.0, fl_y=92.0, cx=23.0, cy=21.0, k1=-0.2, k2=0.05, p1=0.003, p2=-0.002)


def manager(root: Path, **settings: Any) -> SLDataManager:
    torch.manual_seed(42)
    return SLDataManagerConfig(data=root, **settings).setup(device="cpu", test_mode="val", world_size=1, local_rank=0)


@pytest.fixture(scope="module")
def datamanager(tiny_root: Path) -> SLDataManager:
    return manager(tiny_root, train_num_rays_per_batch=200)


def test_batch_matches_its_rays(datamanager: SLDataManager) -> None:
    """Independent of the table of pixels: rays hit the sphere where the coordinates in the files say."""
    rays, batch = datamanager.next_train(0)
    loaded = datamanager.dataparser.loaded
    columns = {"indices": 3, "coords": 2, "decoded": 1, "pattern": 1, "image": 3, "mask": 1}
    assert {name: tuple(values.shape) for name, values in batch.items()} == {k: (200, c) for k, c in columns.items()}
    for i in range(0, 200, 7):
        number, row, column = batch["indices"][i].tolist()
        frame = loaded.scan.frames[number]
        np.testing.assert_array_equal(batch["coords"][i].numpy(), frame.read_coords()[row, column])
        assert batch["decoded"][i, 0] == np.isfinite(frame.read_coords()[row, column]).all()
        assert batch["pattern"][i, 0].item() == pytest.approx(frame.read_pattern()[row, column], rel=1e-3)
        assert rays.metadata["sl_view"][i].tolist() == [number]
        assert rays.metadata["sl_uv"][i].tolist() == [column + 0.5, row + 0.5]
        # the ray, transformed back to the world and into the camera, ends at the pixel's centre
        p_world = loaded.S_scene_world.inverse().points((rays.origins[i] + 0.7 * rays.directions[i]).double().numpy())
        p_camera = transform(inverse(torch.from_numpy(frame.T_world_camera)), torch.from_numpy(p_world))
        uv, in_front = project(Intrinsics.of(frame.camera, torch.float64), p_camera)
        assert in_front
        np.testing.assert_allclose(uv.numpy(), [column + 0.5, row + 0.5], atol=1e-3)
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(200))


@pytest.mark.parametrize("camera", [CAMERA, SKEWED])
@pytest.mark.parametrize("own_focal_lengths", [(90.0, 90.0, 90.0), (90.0, 80.0, 90.0)])
def test_rays_are_nerfstudios_rays(tmp_path: Path, camera: Device, own_focal_lengths: tuple[float, ...]) -> None:
    """The training rays equal those of nerfstudio's Cameras, which evaluation, rendering and exports use."""
    root = TinyScan(camera=camera).write(tmp_path / "scan")
    content = json.loads((root / "transforms.json").read_text())
    del content["fl_x"]
    for record, focal in zip(content["frames"], own_focal_lengths, strict=True):
        record["fl_x"] = focal
    (root / "transforms.json").write_text(json.dumps(content))
    m = manager(root)
    rays, batch = m.next_train(0)
    frame, row, column = batch["indices"].unbind(-1)
    assert m.train_dataset.cameras.fx[:, 0].tolist() == list(own_focal_lengths)
    stock = m.train_dataset.cameras.generate_rays(frame[:, None], torch.stack([row, column], -1) + 0.5)
    torch.testing.assert_close(rays.origins, stock.origins, rtol=0, atol=1e-6)
    torch.testing.assert_close(rays.directions, stock.directions, rtol=0, atol=2e-6)
    torch.testing.assert_close(rays.metadata["sl_view"], stock.metadata["sl_view"])
    # the solid angle of a pixel, with a tolerance for lens distortion
    torch.testing.assert_close(rays.pixel_area, stock.pixel_area, rtol=0.3, atol=0)


def test_training_and_evaluation_pixels_are_disjoint(datamanager: SLDataManager) -> None:
    trained = {tuple(p) for step in range(60) for p in datamanager.next_train(step)[1]["indices"].tolist()}
    held = {tuple(p) for step in range(5) for p in datamanager.next_eval(step)[1]["indices"].tolist()}
    of_frames = {tuple(p) for f in range(3) for p in datamanager.held_out_batch(f, 10**6)[1]["indices"].tolist()}
    assert held and held <= of_frames and not (trained & of_frames)
    items = [datamanager.eval_dataset[i]["held_out"] for i in range(3)]
    assert of_frames == {(i, *p) for i, item in enumerate(items) for p in item[..., 0].nonzero().tolist()}


def test_a_step_has_the_same_batch_in_another_run(tiny_root: Path) -> None:
    one, other = manager(tiny_root), manager(tiny_root)
    for step in range(3):
        one.next_train(step)
    assert torch.equal(one.next_train(7)[1]["indices"], other.next_train(7)[1]["indices"])
    # a second call for the same step, as by ns-export pointcloud, draws new pixels
    assert not torch.equal(other.next_train(7)[1]["indices"], one.next_train(8)[1]["indices"])
    first = one.next_train(9)[1]["indices"]
    assert not torch.equal(first, one.next_train(9)[1]["indices"])


def test_whole_frames(datamanager: SLDataManager) -> None:
    frame = datamanager.dataparser.loaded.scan.frames[1]
    item = datamanager.eval_dataset[1]
    shapes = {k: tuple(v.shape) for k, v in item.items() if k != "image_idx"}
    channels = {"image": 3, "coords": 2, "pattern": 1, "mask": 1, "decoded": 1, "held_out": 1}
    assert shapes == {k: (40, 48, c) for k, c in channels.items()}
    np.testing.assert_array_equal(item["coords"].numpy(), frame.read_coords())
    np.testing.assert_array_equal(item["mask"][..., 0].numpy(), frame.read_mask())
    np.testing.assert_array_equal(item["pattern"][..., 0].numpy(), frame.read_pattern())
    np.testing.assert_allclose(item["image"][..., 1].numpy() * 255, frame.read_image(), atol=1e-4)


@pytest.mark.parametrize("bits, channels", [(8, 1), (8, 3), (16, 1)])
def test_images_of_any_depth_and_colour(tmp_path: Path, bits: int, channels: int) -> None:
    root = TinyScan().write(tmp_path / "scan")
    rng = np.random.default_rng(0)
    top = 2**bits - 1
    stored = rng.integers(0, top + 1, (40, 48, channels) if channels == 3 else (40, 48)).astype(f"uint{bits}")
    stored.flat[:2] = 0, top
    Image.fromarray(stored).save(root / "images/frame_00002.png")
    item = manager(root).train_dataset.get_data(2)["image"]
    expected = np.broadcast_to(stored.reshape(40, 48, -1) / top, (40, 48, 3))
    np.testing.assert_allclose(item.numpy(), expected, atol=1e-6)
    as_bytes = manager(root).train_dataset.get_numpy_image(2)
    np.testing.assert_array_equal(as_bytes, np.round(expected * 255).astype(np.uint8))


def test_downscaled_frames_keep_the_coordinates_of_their_pixels(tiny_root: Path) -> None:
    config = SLDataManagerConfig(data=tiny_root)
    assert isinstance(config.dataparser, SLDataParserConfig)
    config.dataparser.downscale_factor = 2.0
    m = config.setup(device="cpu", test_mode="test", world_size=1, local_rank=0)
    item, cameras = m.eval_dataset[0], m.eval_dataset.cameras
    assert item["image"].shape == (20, 24, 3) and item["coords"].shape == (20, 24, 2)
    assert (int(cameras.height[0]), int(cameras.width[0]), float(cameras.fx[0])) == (20, 24, 45.0)
    # nearest pixel: at most half a pixel of the full image away
    full = m.dataparser.loaded.scan.frames[0].read_coords()
    np.testing.assert_array_equal(item["coords"].numpy(), full[1::2, 1::2])
    # training still uses the full resolution
    assert int(m.next_train(0)[1]["indices"][:, 2].max()) > 24


def test_all_cameras_are_at_refined_poses(tiny_root: Path) -> None:
    m = manager(tiny_root)
    before, _ = m.next_train(0)
    assert "sl_refined" not in before.metadata
    T = torch.eye(4).repeat(3, 1, 1)
    T[:, :3] = m.train_dataset.cameras.camera_to_worlds
    T[:, 0, 3] += 0.125
    m.stand_at(T.double().requires_grad_())
    rays, batch = m.next_train(0)
    frame = batch["indices"][:, 0]
    assert rays.metadata["sl_refined"].all()
    torch.testing.assert_close(rays.origins, T[frame, :3, 3])
    outputs, loaders = m.train_dataparser_outputs, (m.fixed_indices_eval_dataloader, m.eval_dataloader)
    for holder in (m.train_dataset, m.eval_dataset, outputs, m.eval_dataset._dataparser_outputs, *loaders):
        torch.testing.assert_close(holder.cameras.camera_to_worlds, T[:, :3])
        assert not holder.cameras.camera_to_worlds.requires_grad  # exporters call .numpy()
        assert holder.cameras.generate_rays(0).metadata["sl_refined"].all()
    camera, _ = next(iter(m.fixed_indices_eval_dataloader))
    assert camera.metadata is not None and camera.metadata["sl_refined"].tolist() == [[True]]


def test_scan_is_read_once_and_again_when_it_changes(tmp_path: Path) -> None:
    root = TinyScan().write(tmp_path / "scan")
    first = manager(root).samples
    assert manager(root).samples is first
    content = json.loads((root / "transforms.json").read_text())
    content["frames"].pop()
    (root / "transforms.json").write_text(json.dumps(content))
    assert len(manager(root).train_dataset) == 2


WRONG = (0.02, -0.01, 0.004, -0.015, 0.002, 0.006)


def correction() -> IntrinsicsChange:
    """The change that cancels WRONG, in shares of a focal length that is itself wrong."""
    a, b, c, d, e, f = WRONG
    return IntrinsicsChange.of((-a / (1 + a), -b / (1 + a), -c / (1 + a), -d / (1 + d), -e / (1 + d), -f / (1 + d)))


def test_a_scan_with_wrong_intrinsics_and_their_correction_equals_the_correct_scan(tmp_path: Path) -> None:
    right = manager(TinyScan().write(tmp_path / "right"))
    root = TinyScan().write(tmp_path / "wrong")
    content = json.loads((root / "transforms.json").read_text())
    for fields, (f, x, y) in ((content, WRONG[:3]), (content["projector"], WRONG[3:])):
        fields.update(cx=fields["cx"] + x * fields["fl_x"], cy=fields["cy"] + y * fields["fl_x"])
        fields.update(fl_x=fields["fl_x"] * (1 + f), fl_y=fields["fl_y"] * (1 + f))
    (root / "transforms.json").write_text(json.dumps(content))
    found = manager(root, dataparser=SLDataParserConfig(intrinsics_change=correction()))
    (rays, batch), (other_rays, other_batch) = found.next_train(3), right.next_train(3)
    torch.testing.assert_close(rays.directions, other_rays.directions, rtol=0, atol=1e-6)
    torch.testing.assert_close(batch, other_batch, rtol=0, atol=0, equal_nan=True)
    loaded, other = found.dataparser.loaded, right.dataparser.loaded
    assert loaded.scan.intrinsics_change == correction() and other.scan.intrinsics_change == UNCHANGED
    assert loaded.scan.projector.fl_x == pytest.approx(other.scan.projector.fl_x, rel=1e-14)
    np.testing.assert_allclose(loaded.S_scene_world.matrix(), other.S_scene_world.matrix(), atol=1e-9)
    cameras = [m.train_dataset.cameras for m in (found, right)]
    torch.testing.assert_close(cameras[0].fx, cameras[1].fx)
    torch.testing.assert_close(cameras[0].cy, cameras[1].cy)
    wrong = manager(root)  # the same folder without the change: the cached scan with the change is not used
    assert (wrong.next_train(3)[0].directions - other_rays.directions).abs().max() > 1e-3


@pytest.mark.parametrize("which, value", [(3, -1.0), (1, 40.0), (4, float("nan"))])
def test_a_change_in_percent_or_pixels_is_rejected(tiny_root: Path, which: int, value: float) -> None:
    a, b, c, d, e, f = (value if which == k else 0.0 for k in range(6))
    with pytest.raises(UserError, match=r"(?s)intrinsics_change \(.*give shares of the focal length"):
        manager(tiny_root, dataparser=SLDataParserConfig(intrinsics_change=IntrinsicsChange.of((a, b, c, d, e, f))))
