"""transforms*.json: Blender, D-NeRF and nerfstudio, read and refused."""

import math

import numpy as np
import PIL.Image
import plyfile
import pytest

from nerfies_jax import capture as room
from nerfies_jax.capture import blender_format, points, world_points
from nerfies_jax.capture.capture import CaptureError
from tests.capture.broken import dump, edited, refused

SIZE = (10, 8)
ANGLE = 0.7


def pose(turn, radius=4.0):
    """An OpenGL camera-to-world matrix that looks at the origin from the side."""
    c, s = math.cos(turn), math.sin(turn)
    right, up, back = [-s, c, 0.0], [0.0, 0.0, 1.0], [c, s, 0.0]
    columns = [right, up, back, [radius * x for x in back]]
    return [[column[row] for column in columns] for row in range(3)] + [[0, 0, 0, 1]]


def image(seed, channels=4):
    return np.random.default_rng(seed).integers(0, 256, (8, 10, channels), np.uint8)


def make(root, splits=None, times=True, radius=4.0, top=None, **extra):
    """A D-NeRF folder, or one transforms.json if `splits` has the name ""."""
    splits = splits or {"train": 4, "val": 2, "test": 3}
    for number, (split, count) in enumerate(splits.items()):
        entries = []
        for row in range(count):
            name = f"./{split or 'images'}/r_{row}"
            pixels = image(100 * number + row)
            target = root / f"{name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            PIL.Image.fromarray(pixels).save(target)
            entry = {"file_path": name, "transform_matrix": pose(row + number, radius)}
            if times:
                entry["time"] = row / max(count - 1, 1)
            entries.append(entry | extra)
        ending = f"_{split}" if split else ""
        lens = {"camera_angle_x": ANGLE} if top is None else top
        dump(root / f"transforms{ending}.json", lens | {"frames": entries})
    return root


def test_everything_in_the_files_arrives(tmp_path):
    capture = room.load(make(tmp_path / "lego"))
    assert (capture.name, capture.source) == ("lego", "blender")
    assert capture.ids[:4] == ("train_r_0", "train_r_1", "train_r_2", "train_r_3")
    assert capture.ids[4:] == ("test_r_0", "test_r_1", "test_r_2")
    assert capture.train.tolist() == [0, 1, 2, 3]
    assert capture.heldout.tolist() == [4, 5, 6]
    np.testing.assert_allclose(
        capture.times, [0, 1 / 3, 2 / 3, 1, 0, 0.5, 1], atol=1e-7
    )
    assert capture.warp_ids.tolist() == [0, 1, 3, 4, 0, 2, 4]  # equal times, one id
    pixels = image(2).astype(float)
    cover = pixels[..., 3:] / 255
    white = pixels[..., :3] * cover + 255 * (1 - cover)
    assert (np.abs(capture.images[2] - white) <= 0.501).all()
    assert capture.background == (1.0, 1.0, 1.0)
    assert (capture.near, capture.far) == (2.0, 6.0)
    assert (capture.scale, capture.center) == (1.0, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(
        capture.cameras.focal_px, 0.5 * 10 / math.tan(0.5 * ANGLE), rtol=1e-6
    )
    np.testing.assert_array_equal(capture.cameras.principal_point_px, [[5, 4]] * 7)


def test_the_image_is_upright_and_unmirrored(tmp_path):
    capture = room.load(make(tmp_path))
    # Camera 0 stands at (4, 0, 0) and looks along -x: z is up, y is to its right.
    points = np.float32([[0, 0, 0], [0, 0, 0.5], [0, 0.5, 0]])
    pixel, depth, seen = world_points.pixels_of(capture.cameras, 0, points, (10, 8))
    assert seen.all()
    np.testing.assert_allclose(depth, 4, rtol=1e-6)
    np.testing.assert_allclose(pixel[0], [5, 4], atol=1e-5)
    assert pixel[1, 1] < 4 - 0.5
    assert pixel[2, 0] > 5 + 0.5


@pytest.mark.parametrize(
    ("splits", "heldout", "expected"),
    [
        ({"train": 4, "val": 2, "test": 3}, None, "test_r_0"),
        ({"train": 4, "val": 2, "test": 3}, "val", "val_r_0"),
        ({"train": 4, "val": 2}, None, "val_r_0"),
        ({"train": 16}, None, "train_r_4"),
        ({"train": 4, "test": 3}, 2, "train_r_1"),
        ({"": 16}, None, "images_r_4"),
    ],
)
def test_which_split_is_held_out(tmp_path, splits, heldout, expected):
    capture = blender_format.read(make(tmp_path, splits), heldout=heldout)
    assert capture.ids[capture.heldout[0]] == expected


def test_a_single_file_can_be_named(tmp_path):
    make(tmp_path, {"train": 16, "test": 2})
    capture = room.load(tmp_path / "transforms_train.json", heldout=8)
    assert len(capture.ids) == 16


def test_background_and_smaller_images(tmp_path):
    capture = blender_format.read(make(tmp_path), background=(0.0, 0.0, 0.0), factor=2)
    pixels = image(0).astype(float)
    black = np.round(pixels[..., :3] * pixels[..., 3:] / 255)
    assert capture.size == (5, 4)
    assert abs(capture.images[0, 0, 0, 0] - black[:2, :2, 0].mean()) <= 0.5
    np.testing.assert_array_equal(capture.cameras.principal_point_px[0], [2.5, 2])


def test_times_that_are_missing(tmp_path):
    still = blender_format.read(make(tmp_path / "still", times=False))
    assert not still.times.any()
    assert any("static scene" in note for note in still.notes)
    video = blender_format.read(make(tmp_path / "video", {"": 12}, times=False))
    order = np.argsort([int(name.split("_")[-1]) for name in video.ids])
    np.testing.assert_allclose(video.times[order], np.linspace(0, 1, 12), atol=1e-7)
    make(tmp_path / "some")
    with edited(tmp_path / "some/transforms_train.json") as table:
        del table["frames"][1]["time"]
    some = blender_format.read(tmp_path / "some")
    assert some.times[1] == pytest.approx(1 / 3)
    assert any("1 frames have no time" in note for note in some.notes)


@pytest.mark.parametrize(
    ("split", "folders", "times", "expected"),
    [
        ("", ("left", "right"), "0011", [0, 1]),
        ("", ("left", "right"), "0123", [0]),  # one camera after the other
        ("", ("left", "right"), "0000", [0]),  # nothing moves
        ("_train", ("left", "left"), "0011", [0]),  # meet those of ./test
        ("_train", ("left", "right"), "0011", [0, 1, 2]),
    ],
)
def test_folders_of_one_time_are_cameras(tmp_path, split, folders, times, expected):
    file = make(tmp_path, {split[1:]: 4, "test": 4}) / f"transforms{split}.json"
    for folder in {*folders}:
        (tmp_path / folder).symlink_to(tmp_path / (split[1:] or "images"))
    with edited(file) as table:
        for row, entry in enumerate(table["frames"]):
            name = f"{folders[row % 2]}/r_{row}"
            entry |= {"file_path": name, "time": int(times[row]) / 4}
        table["is_fisheye"] = False
    capture = blender_format.read(tmp_path)
    assert np.unique(capture.camera_ids).tolist() == expected
    right = capture.camera_ids[[name.startswith("right") for name in capture.ids]]
    assert (right == (len(expected) > 1)).all()


def test_cameras_further_away_see_further(tmp_path):
    capture = blender_format.read(make(tmp_path, radius=10.0))
    assert (capture.near, capture.far) == pytest.approx((5, 15))
    own = blender_format.read(tmp_path, near=1.0, far=20.0)
    assert (own.near, own.far) == (1.0, 20.0)


LENS = {
    "fl_x": 40.0, "fl_y": 44.0, "cx": 11.0, "cy": 7.0, "w": 20, "h": 16,
    "k1": 0.1, "k2": 0.02, "p1": 0.003, "p2": 0.004, "camera_model": "OPENCV",
}  # fmt: skip


def test_nerfstudio_lens_scales_with_the_images(tmp_path):
    capture = blender_format.read(make(tmp_path, {"": 9}, top=LENS))
    cameras = capture.cameras
    # Images are half size.
    np.testing.assert_allclose(cameras.focal_px, 20, rtol=1e-6)
    np.testing.assert_allclose(cameras.pixel_aspect, 1.1, rtol=1e-6)
    np.testing.assert_allclose(cameras.principal_point_px, [[5.5, 3.5]] * 9)
    np.testing.assert_allclose(cameras.radial[0], [0.1, 0.02, 0], rtol=1e-6)
    np.testing.assert_allclose(cameras.tangential[0], [0.003, 0.004], rtol=1e-6)
    assert any("scaled to images" in note for note in capture.notes)
    # All cameras look at the origin from 4 away; that becomes the unit.
    np.testing.assert_allclose(np.linalg.norm(cameras.position, axis=1), 1, rtol=1e-5)
    assert capture.scale == pytest.approx(0.25)


def test_a_frame_may_have_its_own_lens(tmp_path):
    make(tmp_path, {"": 9}, top=LENS)
    with edited(tmp_path / "transforms.json") as table:
        table["frames"][3]["fl_x"] = 80.0
    capture = blender_format.read(tmp_path)
    focal = dict(zip(capture.ids, capture.cameras.focal_px, strict=True))
    assert focal["images_r_3"] == pytest.approx(40)
    assert focal["images_r_2"] == pytest.approx(20)


def test_the_held_out_file_has_its_own_lens(tmp_path):
    make(tmp_path)
    with edited(tmp_path / "transforms_test.json") as table:
        table["camera_angle_x"] = 1.4
    focal = blender_format.read(tmp_path).cameras.focal_px
    np.testing.assert_allclose(focal[-1], 5 / math.tan(0.7), rtol=1e-6)
    np.testing.assert_allclose(focal[0], 5 / math.tan(0.35), rtol=1e-6)


def test_nerfstudio_points_masks_and_lists(tmp_path):
    make(tmp_path, {"": 9}, top=LENS)
    mask = np.ones((8, 10), np.uint8)  # of 0 and 1: black to the eye
    mask[1, 2] = 0
    (tmp_path / "masks").mkdir()
    PIL.Image.fromarray(mask).save(tmp_path / "masks/m.png")
    with edited(tmp_path / "transforms.json") as table:
        table["frames"][0]["mask_path"] = "masks/m.png"
        names = [entry["file_path"] for entry in table["frames"]]
        table |= {
            "ply_file_path": "sparse.ply",
            "train_filenames": names[:7],
            "val_filenames": names[7:8],
            "test_filenames": names[8:],
        }
    rng = np.random.default_rng(0)
    rows = np.zeros(50, "f4, f4, f4, u1, u1, u1")
    rows.dtype.names = ("x", "y", "z", "red", "green", "blue")
    for axis in "xyz":
        rows[axis] = rng.uniform(-0.5, 0.5, 50)
    rows["green"] = 200
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(
        tmp_path / "sparse.ply"
    )
    capture = blender_format.read(tmp_path)
    assert capture.ids[capture.heldout[0]] == "images_r_8"
    again = blender_format.read(tmp_path, heldout=3)  # of all
    assert [again.ids[row][-1] for row in again.heldout] == ["1", "4", "7"]
    assert (~capture.valid).sum() == 1
    assert not capture.valid[0, 1, 2]
    assert capture.points.color[7].tolist() == [0, 200, 0]
    world = capture.points.position / capture.scale + capture.center
    np.testing.assert_allclose(world[:, 0], rows["x"], atol=1e-5)
    # Depths seen lie within 4 +- 0.9 of the world; near and far lie around them.
    assert 1.2 < capture.near / capture.scale < 2.4
    assert 4.3 < capture.far / capture.scale < 6.5
    corners = np.concatenate([capture.points.position, capture.cameras.position])
    assert np.linalg.norm(np.ptp(corners, axis=0)) < 1.2  # unit diagonal but outliers


def points_file(path, color, kind):
    rows = np.zeros(len(color), f"f4, f4, f4, {kind}, {kind}, {kind}")
    rows.dtype.names = ("x", "y", "z", "red", "green", "blue")
    rows["red"] = color
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(path)
    return path


def test_colors_of_points_are_bytes_or_shares(tmp_path):
    shares = points_file(tmp_path / "a.ply", [0, 0.5, 1], "f4")
    assert points.read_ply(shares).color[:, 0].tolist() == [0, 128, 255]
    other = points_file(tmp_path / "b.ply", [0, 128, 255], "f4")
    with pytest.raises(CaptureError, match=r"b\.ply: .*float32 from 0 to 255; .*uchar"):
        points.read_ply(other)


def test_of_frames_listed_to_learn_from_alone_some_are_held_out(tmp_path):
    make(tmp_path, {"": 9}, top=LENS)
    with edited(tmp_path / "transforms.json") as table:
        names = [entry["file_path"] for entry in table["frames"]]
        table["train_filenames"] = names[1:]
    capture = blender_format.read(tmp_path)
    assert sorted(name[-1] for name in capture.ids) == list("12345678")
    assert [capture.ids[row][-1] for row in capture.heldout] == ["5"]
    with pytest.raises(CaptureError, match="heldout=0 leaves no"):
        blender_format.read(tmp_path, heldout=0)


def test_missing_images_are_listed_or_left_out(tmp_path):
    make(tmp_path)
    (tmp_path / "train/r_1.png").unlink()
    (tmp_path / "test/r_0.png").unlink()
    with pytest.raises(CaptureError, match=r"2 of 7 .* \(train_r_1, test_r_0\)"):
        blender_format.read(tmp_path)
    capture = room.load(tmp_path, missing="skip")
    assert capture.train.tolist() == [0, 1, 2]
    assert capture.heldout.tolist() == [3, 4]


def first_frame(**changes):
    def spoil(root):
        with edited(root / "transforms_train.json") as table:
            table["frames"][0] |= changes

    return spoil


def top_level(**changes):
    def spoil(root):
        with edited(root / "transforms_train.json") as table:
            table |= changes

    return spoil


def words(old, new):
    def spoil(root):
        file = root / "transforms_train.json"
        file.write_text(file.read_text().replace(old, new))

    return spoil


SHEARED = [[1, 0.5, 0, 0], [0, 0.8660254, 0, 0], [0, 0, 1, 4]]
MIRRORED = [[-x for x in row[:1]] + row[1:] for row in pose(0)]
BAD = {
    "no frames": (top_level(frames=[]), "no frames"),
    "climbs": (first_frame(file_path="../../etc/passwd"), "leads outside"),
    "absolute": (first_frame(file_path="/etc/passwd"), "leads outside"),
    "time above 1": (first_frame(time=1.5), "time 1.5"),
    "time negative": (first_frame(time=-0.1), "time -0.1"),
    "NaN": (words("4.0", "NaN"), "NaN on line 1"),
    "word in matrix": (words("4.0", '"four"'), "transform_matrix"),
    "short matrix": (first_frame(transform_matrix=[[1.0, 0.0]] * 2), "rows [2, 2]"),
    "zero matrix": (first_frame(transform_matrix=[[0.0] * 4] * 4), "lengths [0.0"),
    "sheared": (first_frame(transform_matrix=SHEARED), "orthonormal"),
    "mirrored": (first_frame(transform_matrix=MIRRORED), "reflection"),
    "no focal length": (top_level(camera_angle_x=None), "no fl_x"),
    "wide angle": (top_level(camera_angle_x=3.5), "camera_angle_x = 3.5"),
    "focal negative": (first_frame(fl_x=-5.0), "fl_x = -5"),
    "size not the camera's": (first_frame(w=8, h=10), "8x10"),
    "panorama": (top_level(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR"),
    "fisheye of a frame": (first_frame(is_fisheye=True), "frames are fisheyes"),
    "fourth radial": (first_frame(k4=0.1), "k4"),
    "frame twice": (first_frame(file_path="train/r_1"), "'train_r_1' appears 2 times"),
    "leak": (first_frame(file_path="test/r_1"), "'test_r_1' appears 2 times"),
    "image cut short": (
        lambda root: (root / "train/r_0.png").write_bytes(
            (root / "train/r_0.png").read_bytes()[:200]
        ),
        "r_0.png",
    ),
    "image of another size": (
        lambda root: PIL.Image.fromarray(image(0)[:4]).save(root / "train/r_2.png"),
        "r_2.png: 10x4",
    ),
    "no points file": (top_level(ply_file_path="x.ply"), "x.ply"),
    "mask missing": (first_frame(mask_path="m.png"), "m.png"),
    "list with a stranger": (
        top_level(train_filenames=["x"], test_filenames=["./train/r_0"]),
        "'x' is in a split",
    ),
    "deep": (words('{"camera', "[" * 100_000 + '{"camera'), "transforms_train.json"),
}


@pytest.mark.parametrize("case", BAD)
def test_broken_files_are_refused_in_one_line(tmp_path, case):
    make(tmp_path)
    spoil, refusal = BAD[case]
    spoil(tmp_path)
    refused(blender_format.read, tmp_path, refusal)


def test_an_unknown_split_is_refused(tmp_path):
    make(tmp_path, {"train": 4})
    for name in ("val", "other"):
        with pytest.raises(CaptureError, match=name):
            blender_format.read(tmp_path, heldout=name)


@pytest.mark.full
def test_a_real_scene_has_the_cameras_its_card_lists(data_dir):
    capture = room.load(data_dir / "blender_lego_static")
    known = np.load(data_dir / "blender_lego_static/cameras.npz")
    ids = [str(name).replace("/", "_").removesuffix(".png") for name in known["names"]]
    rows = [capture.ids.index(name) for name in ids]
    assert (len(rows), capture.train.size, capture.heldout.size) == (125, 100, 25)
    pose_known = known["c2w_opencv"]
    rotation = capture.cameras.camera_from_world[rows].swapaxes(1, 2)
    np.testing.assert_allclose(rotation, pose_known[:, :, :3], atol=3e-7)
    np.testing.assert_allclose(
        capture.cameras.position[rows], pose_known[:, :, 3], atol=1e-6
    )
    np.testing.assert_allclose(
        capture.cameras.focal_px[rows], known["K"][:, 0, 0], rtol=1e-6
    )
    center = capture.cameras.principal_point_px[rows]
    np.testing.assert_allclose(center, known["K"][:, :2, 2], rtol=1e-6)
