"""Intrinsics of every format: the same lens gives the same pixels in all of them."""

import json

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from sl_nerfstudio.calibration.formats import read_device_file, reduce_distortion
from sl_nerfstudio.calibration.stated import CERTAIN, read_stated_sigma
from sl_nerfstudio.calibration.stored_values import read_stored_values
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project

K = np.array([[900.0, 0, 322.3], [0, 905.0, 236.8], [0, 0, 1]])
LENS = np.array([0.08, -0.12, 0.001, -0.0007])
SIZE = (640, 480)
CAMERA = {"w": 640, "h": 480, "fl_x": 900, "fl_y": 905, "cx": 322.3, "cy": 236.8}


def xml(content):
    return f'<?xml version="1.0"?>\n<opencv_storage>{content}</opencv_storage>'


def camera(matrix="900. 0. 320. 0. 900. 240. 0. 0. 1.", width="640"):
    return xml(
        f"<image_width>{width}</image_width><image_height>480</image_height><camera_matrix>"
        f"<rows>3</rows><cols>3</cols><dt>d</dt><data>{matrix}</data></camera_matrix>"
    )


def _storage(path, **values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return path


def _same_pixels(device: Device, lens, shift):
    """Largest distance of projected points (OpenCV axes) from OpenCV's projection, shifted by `shift` pixels."""
    p = np.random.default_rng(0).uniform([-0.3, -0.2, 1], [0.3, 0.2, 1.2], (50, 3))
    expected = cv2.projectPoints(p, np.zeros(3), np.zeros(3), K, lens)[0][:, 0] + shift
    uv, _ = project(Intrinsics.of(device, torch.float64), torch.from_numpy(p * [1, -1, -1]))
    return np.abs(uv.numpy() - expected).max()


@pytest.mark.parametrize("ending", ["yml", "yaml", "xml"])
def test_opencv_counts_from_the_middle_of_the_first_pixel(tmp_path, ending):
    path = _storage(
        tmp_path / f"kämera.{ending}", image_width=640, image_height=480, camera_matrix=K, avg_error=0.2,
        calibration_time="today", distortion_coefficients=np.append(LENS, 0.0)[None],
    )  # fmt: skip
    device = read_device_file(path, "camera", SIZE)
    assert (device.w, device.h) == SIZE
    assert _same_pixels(device, LENS, 0.5) < 1e-9


def test_opencv_stereo_files_hold_camera_and_projector(tmp_path):
    other = K * [[2], [2], [1]]
    path = _storage(tmp_path / "intrinsics.yml", M1=K, D1=LENS[None], M2=other, D2=np.zeros((1, 8)))
    assert _same_pixels(read_device_file(path, "camera", SIZE), LENS, 0.5) < 1e-9
    projector = read_device_file(path, "projector", (1280, 960), model="DOE")
    assert (projector.w, projector.cx, projector.model) == (1280, 2 * 322.3 + 0.5, "DOE")


def test_procam_calibration_stores_rows_first_and_measures_the_first_pixel_of_a_cell(tmp_path):
    path = _storage(
        tmp_path / "calibration_result.xml", img_shape=(480, 640), rms=0.3, cam_int=K, cam_dist=LENS[None],
        proj_int=K, proj_dist=np.zeros((1, 5)), roration=np.eye(3), translation=np.ones((3, 1)),
    )  # fmt: skip
    camera = read_device_file(path, "camera", SIZE)
    assert (camera.w, camera.h) == SIZE and _same_pixels(camera, LENS, 0.5) < 1e-9
    # cell number 7 of 4 pixels was measured at 28; it reaches from 28 to 32 and its middle is 30
    for step in (1, 2, 4):
        projector = read_device_file(path, "projector", (800, 600), procam_step=step)
        assert projector.cx == pytest.approx(322.3 + step / 2) and projector.cy == pytest.approx(236.8 + step / 2)
        assert (projector.w, projector.h) == (800, 600)
    with pytest.raises(UserError, match=r"calibrated at 640 x 480, but the images are 480 x 640 \(rows and columns"):
        read_device_file(path, "camera", (480, 640))


def test_colmap_counts_from_the_corner_of_the_first_pixel(tmp_path):
    path = tmp_path / "cameras.txt"
    lens = " ".join(map(str, LENS))
    path.write_text(f"# Camera list\n1 OPENCV 640 480 900 905 322.3 236.8 {lens}\n")
    assert _same_pixels(read_device_file(path, "camera", SIZE), LENS, 0.0) < 1e-9
    path.write_text("3 SIMPLE_RADIAL 640 480 900 320 240 0.05\n7 PINHOLE 800 600 700 710 400 300\n")
    assert read_device_file(path, "camera", SIZE) == Device(640, 480, 900.0, 900.0, 320.0, 240.0, 0.05)
    assert read_device_file(path, "projector", (800, 600)) == Device(800, 600, 700.0, 710.0, 400.0, 300.0)


def test_plain_json_says_where_the_first_pixel_is(tmp_path):
    path = tmp_path / "intrinsics.json"
    lens = dict(zip(("k1", "k2", "p1", "p2"), LENS.tolist(), strict=True))
    for extra, shift in (({}, 0.0), ({"pixel_centre": 0.5}, 0.0), ({"pixel_centre": 0}, 0.5)):
        path.write_text(json.dumps({"camera": {**CAMERA, **lens}, "projector": {**CAMERA, "model": "DOE"}, **extra}))
        assert _same_pixels(read_device_file(path, "camera", SIZE), LENS, shift) < 1e-9
        assert read_device_file(path, "projector", SIZE).model == "DOE"
    path.write_text(json.dumps({"units": "mm", "camera_model": "OPENCV", **CAMERA, "projector": CAMERA}))
    assert read_device_file(path, "camera", SIZE) == read_device_file(path, "projector", SIZE)


def test_the_uncertainty_that_a_file_states_is_read_in_shares_of_the_focal_length(tmp_path):
    path = tmp_path / "intrinsics.json"
    camera = {**CAMERA, "fl_x": 800}
    sigma = {"fl_x": 4, "fl_y": 5, "cy": 1.6, "k1": 0.1}
    path.write_text(json.dumps({"camera": {**camera, "sigma": sigma}, "projector": camera}))
    assert read_stated_sigma(path, "camera", SIZE) == (0.005, 0.0, 0.002)
    assert read_stated_sigma(path, "projector", SIZE) == read_stated_sigma(None, "camera", SIZE) == CERTAIN


@given(
    focal=st.tuples(st.floats(900, 3000), st.floats(900, 3000)),
    centre=st.tuples(st.floats(200, 440), st.floats(150, 330)),
    lens=st.tuples(*[st.floats(-0.1, 0.1)] * 2, *[st.floats(-1e-3, 1e-3)] * 2),
)
def test_the_same_device_in_three_formats_is_the_same(tmp_path_factory, focal, centre, lens):
    folder = tmp_path_factory.mktemp("d")
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    numbers = dict(zip(keys, (*focal, *centre, *lens), strict=True))
    (folder / "a.json").write_text(json.dumps({"camera": {"w": 640, "h": 480, **numbers}}))
    (folder / "a.txt").write_text(f"1 OPENCV 640 480 {' '.join(map(repr, numbers.values()))}\n")
    matrix = np.array([[focal[0], 0, centre[0] - 0.5], [0, focal[1], centre[1] - 0.5], [0, 0, 1]])
    _storage(folder / "a.yml", image_width=640, image_height=480, camera_matrix=matrix,
             distortion_coefficients=np.array([lens]))  # fmt: skip
    expected = Device(640, 480, **numbers)
    assert read_device_file(folder / "a.json", "camera", SIZE) == expected
    assert read_device_file(folder / "a.txt", "camera", SIZE) == expected
    found = read_device_file(folder / "a.yml", "camera", SIZE)
    assert [getattr(found, key) for key in keys] == pytest.approx([getattr(expected, key) for key in keys], abs=1e-9)


def test_small_higher_terms_are_absorbed_and_large_ones_refused(tmp_path):
    small = [*LENS, 0.02]
    path = _storage(tmp_path / "c.yml", camera_matrix=K, distortion_coefficients=np.array([small]))
    device = read_device_file(path, "camera", SIZE)
    assert _same_pixels(device, np.array(small), 0.5) < 0.1
    assert device.k2 != LENS[1]
    reduced, miss = reduce_distortion([*LENS.tolist(), 0.0, 0.0, 0.0, 0.0], K, SIZE)
    assert np.allclose(reduced, LENS) and miss == 0
    fish = _storage(tmp_path / "d.yml", camera_matrix=K * [[0.4], [0.4], [1]],
                    distortion_coefficients=np.array([[-0.3, 0.1, 0, 0, 0.8]]))  # fmt: skip
    with pytest.raises(UserError, match=r"beyond k1, k2, p1, p2 \(k3 = 0.8\), without which it is .* px off") as caught:
        read_device_file(fish, "camera", (256, 192))
    assert "CALIB_FIX_K3" in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", '{"camera": {"w": 640}}', r"camera\.h: is missing|h: is missing"),
        ("a.json", json.dumps({"camera": {**CAMERA, "sigma": {"cx": -1}}}), r"camera\.sigma\.cx: is -1"),
        ("a.json", '{"frames": []}', "describes neither a camera nor a projector"),
        ("a.txt", "1 OPENCV 640 480 900\n", "camera 1 has model OPENCV with 1 parameters"),
        ("a.txt", "1 FOV 640 480 900 900 320 240 0.1\n", "has model FOV with 5 parameters"),
        ("a.txt", "1 PINHOLE 640 480 nan 900 320 240\n", "fl_x is nan pixels, which is impossible"),
        ("a.txt", "hello\n", "line 1 describes no camera"),
        ("a.txt", "# nothing\n", "contains no camera"),
        ("a.yml", "camera_matrix: 3", "cannot be read as an OpenCV file"),
        ("a.yml", "%YAML:1.0\n---\nfocus: 3\n", r"contains no camera matrix \(it has: focus\)"),
        ("a.xml", "<html></html>", "cannot be read as an OpenCV file"),
        ("a.toml", "x = 1", r"is of no known kind \(\.toml\)"),
        ("a.txt", "1 PINHOLE 320 240 900 900 160 120\n", "was calibrated at 320 x 240, but the images are 640 x 480"),
        ("a.txt", "1 PINHOLE 640 480 9 9 3 2\n2 PINHOLE 640 480 9 9 3 2\n", "does not say which device is the camera"),
        ("a.xml", xml("<a>" * 50_000 + "</a>" * 50_000), "nested too deeply"),
        ("a.xml", '<!DOCTYPE a [<!ENTITY b "c">]>' + xml("<a>&b;</a>"), "document type"),
        ("a.xml", camera()[:-40], "no element found|mismatched|unclosed"),
        ("a.xml", xml("<a>1</a><a>2</a>"), "more than once"),
        ("a.xml", xml("<a>" + "1 " * 400_000 + "</a>"), "far more than a calibration"),
        ("a.yml", "%YAML:1.0\n---\na: " + "[" * 100_000, "nested too deeply"),
        ("a.yml", "%YAML:1.0\n---\n" + "".join(" " * k + "a:\n" for k in range(600)), "nested too deeply"),
        ("a.yml", "%YAML:1.0\n---\na: !!python/object/apply:os.abort []", "contains no camera matrix"),
        ("a.yml", "%YAML:1.0\n---\na: &x [ *x ]", "an earlier part of itself"),
        ("a.yml", "%YAML:1.0\n---\na: 1\na: 2", "more than once"),
        ("a.yml", "%YAML:1.0\n---\n- 1", "no names with values"),
        ("a.yml", "a: 1", "does not start with %YAML"),
        ("a.xml", camera("1. 2. wide 4. 5. 6. 7. 8. 9."), "something that is not a number"),
        ("a.xml", camera("1. 2. 3."), "a matrix of 3 x 3 has 3 numbers"),
        ("a.xml", xml("<camera_matrix>none</camera_matrix>"), "is no 3 x 3 matrix of numbers"),
        ("a.xml", camera(".Nan 0. 320. 0. 900. 240. 0. 0. 1."), "is no 3 x 3 matrix of numbers"),
        ("a.xml", camera("-900. 0. 320. 0. 900. 240. 0. 0. 1."), "fl_x is -900"),
        ("a.xml", camera("900. 9. 320. 0. 900. 240. 0. 0. 1."), "has a skew of 9"),
        ("a.xml", camera("900. 0. 0. 0. 900. 0. 320. 240. 1."), "the last row 320, 240, 1"),
        ("a.xml", camera(width="wide"), "the size of the image is not two whole numbers"),
        ("a.json", json.dumps({"camera": {**CAMERA, "k1": 50}}), "multiply distances from the principal point by"),
        ("c.m", "fc = [ 900 x ];", "cannot be read as a MATLAB script"),
        ("c.slcalib", "Kc\n1 2 3\n4 5\n", "cannot be read as SLStudio's calibration"),
    ],
)
def test_faults_name_file_cause_and_remedy(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(UserError, match=message) as caught:
        read_device_file(path, "camera", SIZE)
    assert name in str(caught.value) and "cause:" in str(caught.value) and "remedy:" in str(caught.value)


@pytest.mark.parametrize("suffix", ["xml", "yml", "yaml"])
@settings(max_examples=20)
@given(
    matrix=arrays.arrays(np.float64, st.tuples(st.integers(1, 4), st.integers(1, 5)), elements=st.floats(-1e30, 1e30)),
    number=st.floats(allow_nan=False, allow_infinity=False),
    text=st.text("abc xyz", min_size=1),
)
def test_what_opencv_writes_is_read(tmp_path_factory, suffix, matrix, number, text):
    path = tmp_path_factory.getbasetemp() / f"ä.{suffix}"
    _storage(path, matrix=matrix, small=matrix.astype(np.float32), number=number, text="t" + text)
    found = read_stored_values(path)
    np.testing.assert_array_equal(found["matrix"], matrix)
    np.testing.assert_allclose(found["small"], matrix.astype(np.float32), rtol=1e-6, atol=1e-37)
    assert found["number"] == number and found["text"].split() == ("t" + text).split()


def _rows(matrix):
    return ";\n ".join(", ".join(f"{x:.9g}" for x in row) for row in np.atleast_2d(matrix))


def _as_scan3d(path, lens):
    """Write what Moreno and Taubin's scan3d-capture does: a MATLAB script with %lf, or OpenCV's YAML."""
    if path.suffix == ".yml":
        return _storage(path, cam_K=K, cam_kc=lens[None], proj_K=OTHER, proj_kc=np.zeros((1, 5)), R=np.eye(3),
                        T=np.ones((3, 1)), cam_error=0.2, proj_error=0.3, stereo_error=0.4)  # fmt: skip
    lines = ["% Projector-Camera Stereo calibration parameters:", "", "% Intrinsic parameters of camera:"]
    for side, matrix, terms in (("left", K, lens), ("right", OTHER, np.zeros(5))):
        lines += [f"fc_{side} = [ {matrix[0, 0]:f} {matrix[1, 1]:f} ]; % Focal Length",
                  f"cc_{side} = [ {matrix[0, 2]:f} {matrix[1, 2]:f} ]; % Principal point",
                  f"alpha_c_{side} = [ 0.000000 ]; % Skew",
                  f"kc_{side} = [ {' '.join(f'{k:f}' for k in terms)} ]; % Distortion"]  # fmt: skip
    path.write_text("\n".join([*lines, "om = [ 0.1 0.2 0.3 ]; % Rotation vector", "T = [ 1.0 2.0 3.0 ];"]))
    return path


def _as_slstudio(path, lens):
    """Write what SLStudio does: OpenCV's XML with sizes, a MATLAB script, or names above their rows."""
    named = {"Kc": K, "kc": lens[:, None], "Kp": OTHER, "kp": np.zeros((5, 1)), "Rp": np.eye(3), "Tp": np.ones((3, 1))}
    if path.suffix == ".xml":
        return _storage(path, **named, cam_error=0.2, frameWidth=640, frameHeight=480, screenResX=912, screenResY=1140)
    if path.suffix == ".m":
        path.write_text("%%SLStudio calibration\n" + "".join(f"{n} = [{_rows(v)}];\n" for n, v in named.items()))
        return path
    blocks = []
    for name, value in named.items():
        rows = (" ".join(f"{x:f}" for x in row) for row in (value.T if value.shape[1] == 1 else value))
        blocks.append("\n".join([name, *rows, "", ""]))
    path.write_text("#V1.0 SLStudio calibration\n#Calibration time: today\n\n" + "".join(blocks) + "cam_error: 0.2\n")
    return path


OTHER = np.array([[1100.0, 0, 455.6], [0, 2200.0, 900.4], [0, 0, 1]])  # a projector with diamond pixels


@pytest.mark.parametrize(
    ("write", "name"),
    [(_as_scan3d, "calibration.yml"), (_as_scan3d, "calibration.m")]
    + [(_as_slstudio, f"calibration.{ending}") for ending in ("xml", "m", "slcalib")],
)
def test_files_of_other_structured_light_programs(tmp_path, write, name):
    path = write(tmp_path / name, np.append(LENS, 0.0))
    camera, projector = read_device_file(path, "camera", SIZE), read_device_file(path, "projector", (912, 1140))
    assert _same_pixels(camera, LENS, 0.5) < 2e-3  # %f keeps six digits after the point
    np.testing.assert_allclose(projector.parameters[:4], [1100, 2200, 456.1, 900.9], atol=1e-6)


def test_matlabs_toolbox_describes_one_camera_with_its_size(tmp_path):
    path = tmp_path / "Calib_Results.m"
    path.write_text(
        "% Intrinsic parameters\nfc = [ 900 ; 905 ];\ncc = [ 322.3 ; 236.8 ];\nalpha_c = 0.0;\n"
        "kc = [ 0.08 ; -0.12 ; 0.001 ; -0.0007 ; 0 ];\nnx = 640;\nny = 480;\nomc_1 = [ 1e-3 ; 2 ; 3 ];\n"
    )
    assert _same_pixels(read_device_file(path, "camera", SIZE), LENS, 0.5) < 1e-9
    path.write_text(path.read_text().replace("alpha_c = 0.0", "alpha_c = 1e-5"))  # a skew of a rounding
    assert _same_pixels(read_device_file(path, "camera", SIZE), LENS, 0.5) < 1e-9


def test_a_file_without_the_wanted_device_is_refused(tmp_path):
    (tmp_path / "i.json").write_text(json.dumps({"camera": CAMERA}))
    with pytest.raises(UserError, match=r"describes no projector, only camera(.|\n)*--projector-intrinsics"):
        read_device_file(tmp_path / "i.json", "projector", SIZE)


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ([*LENS, 0, 0, 0, 0, 0.02, 0, 0, 0], r"\(s1 = 0.02\), without which it is .*\n.*thin-prism"),
        ([*LENS, 0, 0, 0, 0, 0, 0, 0, 0, 0.01, 0], r"tilted \(coefficients 13 and 14, tau x = 0.01"),
        ([*LENS, 0, 0], "has 6 distortion coefficients, and OpenCV's models have 4, 5, 8, 12 or 14"),
    ],
)
def test_terms_that_a_scan_cannot_express_are_named(tmp_path, terms, message):
    path = _storage(tmp_path / "c.yml", camera_matrix=K, distortion_coefficients=np.array([terms], dtype=float))
    with pytest.raises(UserError, match=message) as caught:
        read_device_file(path, "camera", SIZE)
    assert "remedy: calibrate" in str(caught.value)


def test_terms_beyond_eight_are_those_of_opencv(tmp_path):
    """A thin prism so weak that its place in the list does not show is absorbed like any other term."""
    lens = np.array([*LENS, 0, 0, 0, 0, 2e-4, 0, -1e-4, 0, 0, 0])
    path = _storage(tmp_path / "c.yml", camera_matrix=K, distortion_coefficients=lens[None])
    assert _same_pixels(read_device_file(path, "camera", SIZE), lens, 0.5) < 0.1
