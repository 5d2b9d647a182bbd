"""EXR round trips, other people's files, and broken ones."""

import json

import numpy as np
import OpenEXR
import pytest

from nerfies_jax.capture import (
    exr,
    exr_camera,
    formats,
    frames,
    images,
    world_points,
)
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.geometry import camera

RNG = np.random.default_rng(0)
COLOR = RNG.uniform(0, 50, (5, 7, 3)).astype(np.float32)
DEPTH = RNG.uniform(1, 1000, (5, 7)).astype(np.float32)


pytestmark = pytest.mark.usefixtures("one_child")


def test_float_channels_come_back_bit_for_bit(tmp_path):
    flow = RNG.normal(size=(5, 7)).astype(np.float32)
    counts = RNG.integers(0, 2**32, (5, 7), np.uint32)
    color = COLOR.copy()
    exr.write_exr(
        tmp_path / "a.exr", color, DEPTH / 1000, DEPTH, {"flow.x": flow, "id": counts}
    )
    np.testing.assert_array_equal(color, COLOR)  # OpenEXR keeps hands off our arrays
    image = exr.read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(image.color, COLOR)
    np.testing.assert_array_equal(image.alpha, DEPTH / 1000)
    np.testing.assert_array_equal(image.depth, DEPTH)
    np.testing.assert_array_equal(image.extra["flow.x"], flow)
    np.testing.assert_array_equal(image.extra["id"], counts)
    assert image.finite.all()
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_a_header_takes_points_of_the_world_to_the_image(tmp_path):
    size = (7, 5)
    one = camera.look_at((0.3, 0.2, -2), (0, 0.1, 0), (0, 1, 0), 9.0, size)
    one = one._replace(
        principal_point_px=np.float32([3.1, 2.7]),
        pixel_aspect=np.float32(1.2),
        skew_px=np.float32(0.5),
    )
    header = exr_camera.attributes(one, size, 0.25)
    exr.write_exr(tmp_path / "a.exr", COLOR, header=header)
    with OpenEXR.File(str(tmp_path / "a.exr"), header_only=True) as file:
        read = dict(file.header())
    points = RNG.uniform(-0.5, 0.5, (20, 3))
    rows = np.append(points, np.ones((20, 1)), axis=1)
    inside = rows @ read["worldToCamera"]
    exact = (points - one.position) @ one.camera_from_world.T
    np.testing.assert_allclose(inside[:, :3], exact, atol=1e-6)
    flat = rows @ read["worldToNDC"]
    pixel, depth, _ = world_points.pixels_of(
        camera.stack([one]), 0, points.astype(np.float32), size
    )
    places = flat[:, :2] / flat[:, 3:] * size
    np.testing.assert_allclose(places, pixel, atol=1e-5)
    np.testing.assert_allclose(flat[:, 3], depth, rtol=1e-6)
    assert read["sceneTime"] == 0.25
    assert read["compression"] == OpenEXR.ZIP_COMPRESSION


@pytest.mark.hard_cases
def test_half_rounds_color_but_not_depth(tmp_path):
    exr.write_exr(tmp_path / "a.exr", COLOR, depth=DEPTH, half=True)
    image = exr.read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(image.color, COLOR.astype(np.float16))
    np.testing.assert_array_equal(image.depth, DEPTH)


@pytest.mark.hard_cases
def test_nan_and_infinity_are_zeroed_and_marked(tmp_path):
    depth = DEPTH.copy()
    depth[1, 2], depth[3, 4] = np.nan, np.inf
    exr.write_exr(tmp_path / "a.exr", COLOR, depth=depth)
    image = exr.read_exr(tmp_path / "a.exr")
    bad = ~np.isfinite(depth)
    np.testing.assert_array_equal(image.finite, ~bad)
    np.testing.assert_array_equal(image.depth, np.where(bad, 0, DEPTH))


def test_a_strided_view_is_written_as_it_looks(tmp_path):
    exr.write_exr(tmp_path / "a.exr", COLOR[::2, ::-1])
    image = exr.read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(image.color, COLOR[::2, ::-1])


def test_a_file_without_our_channels(tmp_path):
    with OpenEXR.File({}, {"Y": DEPTH.copy(), "mask": DEPTH.copy()}) as file:
        file.write(str(tmp_path / "a.exr"))
    image = exr.read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(image.color[..., 2], DEPTH)
    assert (image.alpha, image.depth) == (None, None)
    assert list(image.extra) == ["mask"]


@pytest.mark.parametrize("share", [0, 4, 300, 0.9])
def test_a_file_cut_short_is_refused(tmp_path, share):
    exr.write_exr(tmp_path / "a.exr", RNG.random((64, 64, 3), np.float32))
    data = (tmp_path / "a.exr").read_bytes()
    cut = int(share * len(data)) if share < 1 else int(share)
    (tmp_path / "a.exr").write_bytes(data[:cut])
    with pytest.raises(CaptureError, match=r"a\.exr: not a readable EXR") as caught:
        exr.read_exr(tmp_path / "a.exr")
    assert "\n" not in str(caught.value)


def test_a_bomb_is_refused_before_it_is_decoded(tmp_path):
    with pytest.raises(CaptureError, match="no such image"):
        exr.read_exr(tmp_path / "a.exr")
    exr.write_exr(tmp_path / "a.exr", COLOR)
    data = (tmp_path / "a.exr").read_bytes()
    window = np.array([0, 0, 6, 4], "<i4").tobytes()
    wide = np.array([0, 0, 49_999, 49_999], "<i4").tobytes()
    assert data.count(window) == 2  # data and display window
    (tmp_path / "a.exr").write_bytes(data.replace(window, wide))
    with pytest.raises(CaptureError, match=r"a\.exr: "):
        exr.read_exr(tmp_path / "a.exr")


def write_window(path, color, left, top, width, height, **more):
    """An EXR of `color` at a place in a display window, as renderers store crops."""
    tall, wide = color.shape[:2]
    corner = np.int32([left, top])
    header = {
        "type": OpenEXR.scanlineimage,
        "dataWindow": (corner, corner + np.int32([wide - 1, tall - 1])),
        "displayWindow": (np.int32([0, 0]), np.int32([width - 1, height - 1])),
    }
    channels = dict(zip("RGB", np.moveaxis(color, -1, 0), strict=True)) | more
    contiguous = {name: np.ascontiguousarray(x) for name, x in channels.items()}
    with OpenEXR.File(header, contiguous) as file:
        file.write(str(path))
    return path


def test_a_crop_is_placed_in_its_display_window(tmp_path):
    path = write_window(tmp_path / "a.exr", COLOR / 50, 3, 2, 12, 10)
    assert images.read_header(path).size == (12, 10)
    color, known = images.read_light(path)
    inside = np.zeros((10, 12), bool)
    inside[2:7, 3:10] = True
    np.testing.assert_array_equal(known, inside)
    whole = images.srgb_from_linear(COLOR / 50) * 255
    np.testing.assert_allclose(color[2:7, 3:10], whole, atol=0.51)
    assert not color[~inside].any()
    alone = write_window(tmp_path / "b.exr", COLOR, 0, 0, 7, 5)
    assert images.read_light(alone)[1] is None


def test_overscan_is_dropped_and_a_window_elsewhere_refused(tmp_path):
    path = write_window(tmp_path / "a.exr", COLOR / 50, -2, -1, 4, 4)
    color, known = images.read_light(path)
    whole = images.srgb_from_linear(COLOR / 50) * 255
    np.testing.assert_allclose(color, whole[1:5, 2:6], atol=0.51)
    assert known is None
    path = write_window(tmp_path / "a.exr", COLOR, 9, 0, 8, 8)
    with pytest.raises(CaptureError, match=r"at \(9, 0\) lies outside its display"):
        images.read_light(path)


def test_pixels_without_color_are_not_observed(tmp_path):
    color = COLOR[:4, :6] / 50
    color[1, 2, 0], color[2, 4, 1] = np.nan, np.inf
    depth = np.full((4, 6), np.inf, np.float32)  # of a sky, which has a color
    for name in "ab":
        write_window(tmp_path / f"{name}.exr", color, 0, 0, 6, 4, Z=depth)
    paths = [tmp_path / "a.exr", tmp_path / "b.exr"]
    read = frames.read_frames(paths)
    np.testing.assert_array_equal(read.observed[0], np.isfinite(color).all(-1))
    assert read.notes == (
        "2 EXR images have pixels outside their data window or not finite, 8.3% of "
        "all: taken as not observed",
    )
    halves = frames.read_frames(paths, 2)
    blocks = [[True, False, True], [True, True, False]]
    np.testing.assert_array_equal(halves.observed[1], blocks)


def test_transforms_of_a_crop_keep_their_principal_point(tmp_path):
    pose = np.eye(4)
    for row in range(3):
        pose[0, 3] = row
        write_window(tmp_path / f"{row}.exr", COLOR / 50, 3, 2, 14, 10)
    lens = {"fl_x": 9.0, "cx": 6.5, "cy": 5.0, "w": 14, "h": 10}
    entries = [
        {"file_path": f"{row}.exr", "transform_matrix": pose.tolist()}
        for row in range(3)
    ]
    text = json.dumps(lens | {"frames": entries})
    (tmp_path / "transforms.json").write_text(text)
    capture = formats.load(tmp_path)
    assert capture.size == (14, 10)
    np.testing.assert_allclose(capture.cameras.principal_point_px[0], [6.5, 5.0])
    assert capture.valid.mean() == 35 / 140
    assert "outside their data window" in " ".join(capture.notes)


@pytest.mark.full
def test_other_peoples_files(data_dir):
    folder = data_dir / "openexr_samples"
    files = sorted(folder.glob("*/*.exr"))
    assert len(files) >= 16
    for file in files:
        image = exr.read_exr(file)
        assert image.color is not None or image.extra, file
        assert image.finite.any()
    ball = exr.read_exr(folder / "Beachball/singlepart.0001.exr")
    assert ball.origin == (654, 245)
    assert ball.color.shape == (876, 911, 3)
    assert ball.depth is not None
    assert "left.R" in ball.extra
    rings = exr.read_exr(folder / "TestImages/BrightRingsNanInf.exr")
    assert 0 < (~rings.finite).sum() < 100
    # Of all 65536 half values, 2048 are NaN or infinite.
    halves = exr.read_exr(folder / "TestImages/AllHalfValues.exr")
    assert (~halves.finite).sum() == 2048
