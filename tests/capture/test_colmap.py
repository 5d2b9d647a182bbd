"""COLMAP models written by hand as text, read through pycolmap."""

import re
import subprocess
import sys

import numpy as np
import PIL.Image
import pytest
import scipy.spatial.transform

from nerfies_jax import capture as room
from nerfies_jax.capture import colmap, frames, world_points
from nerfies_jax.capture.borders import without_black_borders
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.capture.colmap_library import library
from tests.capture.broken import refused

SIZE = (24, 16)
PINHOLE = "PINHOLE 24 16 30 33 12.5 7.75"
WORLD = np.random.default_rng(1).uniform((-1, -1, 5), (1, 1, 7), (40, 3))


pytestmark = pytest.mark.usefixtures("one_child")


def rotation(row):
    return scipy.spatial.transform.Rotation.from_rotvec(
        [0.01 * row, -0.02 * row, 0.005]
    )


def position(row):
    return np.array([0.3 * row - 1, 0.1 * row, -0.05 * row])


def image(row, size=SIZE):
    rng = np.random.default_rng(row)
    return rng.integers(40, 256, (size[1], size[0], 3), np.uint8)


def make(
    root, count=9, lens=PINHOLE, folder="images", size=SIZE, points=WORLD, ending="png"
):
    model = root / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 {lens}\n")
    lines = []
    for row in range(count):
        x, y, z, w = rotation(row).as_quat()
        shift = -rotation(row).apply(position(row))
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *shift))
        lines += [f"{row + 1} {numbers} 1 f_{row:03d}.{ending}"]
        lines += [" ".join(f"1 1 {number + 1}" for number in range(len(points)))]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    seen = " ".join(f"{row + 1} {{0}}" for row in range(count))
    (model / "points3D.txt").write_text(
        "".join(
            f"{n + 1} {p[0]!r} {p[1]!r} {p[2]!r} {n} 20 30 0.5 {seen.format(n)}\n"
            for n, p in enumerate(points.tolist())
        )
    )
    (root / folder).mkdir(exist_ok=True)
    for row in range(count):
        file = root / folder / f"f_{row:03d}.png"
        PIL.Image.fromarray(image(row, size)).save(file)
    return root


def test_everything_in_the_files_arrives(tmp_path):
    capture = room.load(make(tmp_path))
    assert capture.source == "colmap"
    assert capture.ids == tuple(f"f_{row:03d}" for row in range(9))
    assert capture.heldout.tolist() == [4]
    np.testing.assert_allclose(capture.times, np.linspace(0, 1, 9), atol=1e-7)
    for row in range(9):
        np.testing.assert_array_equal(capture.images[row], image(row))
        np.testing.assert_allclose(
            capture.cameras.camera_from_world[row], rotation(row).as_matrix(), atol=1e-6
        )
        world = capture.cameras.position[row] / capture.scale + capture.center
        np.testing.assert_allclose(world, position(row), atol=3e-6)
    np.testing.assert_allclose(capture.cameras.focal_px, 30)
    np.testing.assert_allclose(capture.cameras.pixel_aspect, 1.1, rtol=1e-6)
    np.testing.assert_allclose(capture.cameras.principal_point_px[0], [12.5, 7.75])
    order = np.argsort(capture.points.color[:, 0])
    world = capture.points.position[order] / capture.scale + capture.center
    np.testing.assert_allclose(world, WORLD, atol=1e-5)
    assert capture.points.color[order][7].tolist() == [7, 20, 30]


def test_the_scene_has_unit_size_and_its_depths_lie_between_near_and_far(tmp_path):
    capture = room.load(make(tmp_path))
    corners = np.concatenate([capture.points.position, capture.cameras.position])
    assert 0.95 < np.linalg.norm(np.ptp(corners, axis=0)) < 1.2
    for row in range(9):
        _, depth, _ = world_points.pixels_of(
            capture.cameras, row, capture.points.position, SIZE
        )
        assert capture.near < depth.min() < depth.max() < capture.far
    assert capture.up[1] < -0.99  # the cameras' down axis is y


LENSES = [
    "SIMPLE_PINHOLE 24 16 30 12 8",
    PINHOLE,
    "SIMPLE_RADIAL 24 16 30 12 8 0.05",
    "RADIAL 24 16 30 12 8 0.05 -0.02",
    "OPENCV 24 16 30 33 12.5 7.75 0.05 -0.02 0.003 0.004",
    "FULL_OPENCV 24 16 30 33 12.5 7.75 0.05 -0.02 0.003 0.004 0.01 0 0 0",
    "OPENCV_FISHEYE 24 16 30 33 12.5 7.75 0.05 -0.02 0.003 0.004",
]


@pytest.mark.parametrize("lens", LENSES)
def test_our_cameras_project_as_colmap_does(tmp_path, lens):
    capture = room.load(make(tmp_path, lens=lens))
    name, width, height, *numbers = lens.split()
    theirs = library().Camera(
        model=name,
        width=int(width),
        height=int(height),
        params=[float(number) for number in numbers],
    )
    for row in (0, 8):
        pixel, *_ = world_points.pixels_of(
            capture.cameras, row, capture.points.position, SIZE
        )
        world = capture.points.position.astype(float) / capture.scale + capture.center
        inner = rotation(row).apply(world - position(row))
        np.testing.assert_allclose(pixel, theirs.img_from_cam(inner), atol=2e-4)


@pytest.mark.parametrize(
    "lens",
    [
        "RADIAL_FISHEYE 96 64 60 48 32 0.05 0.01",
        "FOV 96 64 60 60 48 32 0.7",
        "FULL_OPENCV 96 64 60 60 48 32 0.1 0.01 0 0 0 0.02 0 0",
    ],
)
def test_other_lenses_are_undistorted_to_where_their_rays_point(tmp_path, lens):
    make(tmp_path, count=3, lens=lens, size=(96, 64))
    name, _, _, *numbers = lens.split()
    params = [float(number) for number in numbers]
    theirs = library().Camera(model=name, width=96, height=64, params=params)
    y, x = np.mgrid[:64, :96] + 0.5
    rays = theirs.cam_from_img(np.stack([x.ravel(), y.ravel()], 1)).reshape(64, 96, 2)

    def color(grad):  # a slow function of the viewing direction
        return 128 + 90 * np.sin(np.stack([3 * grad[..., 0], 4 * grad[..., 1]], -1))

    pixels = np.zeros((64, 96, 3))
    pixels[..., :2], pixels[..., 2] = color(rays), 128
    for row in range(3):
        PIL.Image.fromarray(np.round(pixels).astype(np.uint8)).save(
            tmp_path / f"images/f_{row:03d}.png"
        )
    capture = room.load(tmp_path)
    assert any("undistorted" in note for note in capture.notes)
    one = capture.cameras
    assert not one.radial.any()
    assert not one.tangential.any()
    width, height = capture.size
    y, x = np.mgrid[:height, :width] + 0.5
    grad = np.stack(
        [
            (x - one.principal_point_px[0, 0]) / one.focal_px[0],
            (y - one.principal_point_px[0, 1])
            / (one.focal_px[0] * one.pixel_aspect[0]),
        ],
        axis=-1,
    )
    valid = (
        np.ones((height, width), bool) if capture.valid is None else capture.valid[1]
    )
    assert valid.mean() > 0.7
    error = capture.images[1][..., :2].astype(float) - color(grad)
    # Rounding twice gives 1; the rest is interpolation of a slow function.
    assert np.abs(error[valid]).max() < 1.6


@pytest.mark.parametrize("in_alpha", [False, True])
def test_masks_follow_their_images_through_undistortion(tmp_path, in_alpha):
    lens = "RADIAL_FISHEYE 96 64 60 48 32 0.05 0.01"
    make(tmp_path, count=3, lens=lens, size=(96, 64))
    (tmp_path / "masks").mkdir()
    mask = np.full((64, 96), 255, np.uint8)
    mask[:, :48] = 0  # black moves: the left half, and the middle stays the middle
    if in_alpha:  # white, and transparent where it moves
        white = np.full_like(mask, 255)
        mask = np.stack([white, white, white, mask], -1)
    for row in range(3):
        PIL.Image.fromarray(mask).save(tmp_path / f"masks/f_{row:03d}.png.png")
    capture = room.load(tmp_path)
    width = capture.size[0]
    middle = capture.size[1] // 2
    assert "3 masks of" in " ".join(capture.notes)
    assert capture.moving[0, middle, width // 4]
    assert not capture.moving[0, middle, 3 * width // 4]
    edge = np.flatnonzero(np.diff(capture.moving[0, middle].astype(int)) == -1)
    assert abs(edge[0] + 1 - capture.cameras.principal_point_px[0, 0]) <= 1


@pytest.mark.parametrize(
    ("folder", "size", "options", "expected"),
    [
        ("images_2", (12, 8), {}, (12, 8)),
        ("images", SIZE, {"factor": 4}, (6, 4)),
        ("images_2", (12, 8), {"factor": 4}, (6, 4)),
        ("images", SIZE, {"max_side": 12}, (12, 8)),
        ("", SIZE, {}, SIZE),
    ],
)
def test_images_may_be_fractions_of_the_model(
    tmp_path, folder, size, options, expected
):
    make(tmp_path, folder=folder, size=size, ending="jpg")  # found under another ending
    capture = colmap.read(tmp_path, **options)
    assert capture.size == expected
    np.testing.assert_allclose(
        capture.cameras.focal_px, 30 * expected[0] / 24, rtol=1e-6
    )
    center = np.array([12.5, 7.75]) * expected[0] / 24
    np.testing.assert_allclose(capture.cameras.principal_point_px[0], center, rtol=1e-6)


def test_the_largest_of_several_models_is_read(tmp_path):
    make(tmp_path / "small", count=3)
    make(tmp_path / "large")
    (tmp_path / "large/sparse/0").rename(tmp_path / "large/sparse/1")
    (tmp_path / "small/sparse/0").rename(tmp_path / "large/sparse/0")
    capture = room.load(tmp_path / "large")
    assert len(capture.ids) == 9
    assert any("0: 3, 1: 9" in note for note in capture.notes)


def test_times_follow_the_numbers_when_frames_are_missing(tmp_path):
    make(tmp_path)
    (tmp_path / "images/f_002.png").unlink()
    with pytest.raises(CaptureError, match=r"1 of 9 .*f_002"):
        colmap.read(tmp_path)
    capture = colmap.read(tmp_path, missing="skip")
    np.testing.assert_allclose(capture.times, np.delete(np.arange(9), 2) / 8, atol=1e-7)


@pytest.mark.parametrize(
    ("folders", "lenses", "expected"),
    [
        (("", ""), range(1, 10), [0] * 9),
        (("left/", "right/"), range(1, 10), [0] * 4 + [1] * 5),
        # Two images share a lens: COLMAP's cameras are those of the user.
        (("left/", "right/"), (1, 1, *range(2, 9)), [0, *range(8)]),
    ],
)
def test_a_lens_for_each_image_is_no_physical_camera(
    tmp_path, folders, lenses, expected
):
    make(tmp_path)
    model = tmp_path / "sparse/0"
    (model / "cameras.txt").write_text(
        "".join(f"{lens} {PINHOLE}\n" for lens in sorted(set(lenses)))
    )
    text = (model / "images.txt").read_text()
    for row, lens in enumerate(lenses):
        name = f"f_{row:03d}.png"
        place = f"{folders[row >= 4]}{name}"
        text = text.replace(f" 1 {name}", f" {lens} {place}")
        (tmp_path / "images" / place).parent.mkdir(exist_ok=True)
        (tmp_path / "images" / name).rename(tmp_path / "images" / place)
    (model / "images.txt").write_text(text)
    capture = colmap.read(tmp_path)
    assert capture.camera_ids.tolist() == expected
    notes = [note for note in capture.notes if "a COLMAP camera of its own" in note]
    assert len(notes) == (len(set(lenses)) == 9)


def test_black_wedges_at_the_rim_are_not_observed():
    images = np.full((4, 40, 50, 3), 90, np.uint8)
    images[1, :6, 10:40] = 0  # touches the rim
    images[1, 20:24, 20:24] = 0  # a dark thing inside
    images[2] = 0  # a dark scene
    images[3, :6, 10:40] = np.random.default_rng(0).integers(0, 3, (6, 30, 3))  # cloth
    valid, (note,) = without_black_borders(images, None)
    assert note.startswith("1 frames have black borders")
    expected = np.ones(valid.shape, bool)
    expected[1, :8, 8:42] = False  # and two pixels around
    np.testing.assert_array_equal(valid, expected)
    assert without_black_borders(images[:1], None) == (None, ())


def spoil_text(name, old, new):
    def spoil(root):
        file = root / "sparse/0" / name
        file.write_text(file.read_text().replace(old, new, 1))

    return spoil


BAD = {
    "unknown lens": (spoil_text("cameras.txt", "PINHOLE", "PERISCOPE"), "sparse/0"),
    "cut short": (spoil_text("cameras.txt", " 12.5 7.75", ""), "sparse/0"),
    "no lens": (
        lambda root: (root / "sparse/0/cameras.txt").write_text(""),
        "sparse/0",
    ),
    "absent file": (lambda root: (root / "sparse/0/points3D.txt").unlink(), "sparse/0"),
    "no points": (
        lambda root: [
            (root / "sparse/0/points3D.txt").write_text(""),
            (root / "sparse/0/images.txt").write_text(
                "\n".join(
                    line if number % 2 == 0 else ""
                    for number, line in enumerate(
                        (root / "sparse/0/images.txt").read_text().splitlines()
                    )
                )
                + "\n"
            ),
        ],
        "0 points observed",
    ),
    "climbs": (spoil_text("images.txt", "f_000.png", "../../x.png"), "leads outside"),
    "no images": (
        lambda root: [file.unlink() for file in (root / "images").iterdir()],
        "none of its images (f_000.png",
    ),
    "image of another shape": (
        lambda root: PIL.Image.fromarray(image(0, (16, 24))).save(
            root / "images/f_000.png"
        ),
        "f_000.png: 16x24",
    ),
    "image cut short": (
        lambda root: (root / "images/f_001.png").write_bytes(
            (root / "images/f_001.png").read_bytes()[:300]
        ),
        "f_001.png",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_broken_models_are_refused_in_one_line(tmp_path, case):
    make(tmp_path)
    spoil, refusal = BAD[case]
    spoil(tmp_path)
    refused(colmap.read, tmp_path, refusal)


def test_a_named_split_and_a_single_pose_are_refused(tmp_path):
    make(tmp_path / "good")
    with pytest.raises(CaptureError, match="no split 'val'"):
        colmap.read(tmp_path / "good", heldout="val")
    make(tmp_path / "single", count=1)
    with pytest.raises(CaptureError, match="1 images have a pose"):
        colmap.read(tmp_path / "single")


@pytest.mark.full
def test_pycolmap_leaves_zlib_whole():
    """In a fresh process: `import pycolmap, zlib; zlib.compress(...)` would abort."""
    code = (
        "import nerfies_jax.capture.colmap_library\n"
        "from nerfies_jax.capture.colmap_library import library\n"
        "library()\n"
        "import gzip, zlib\n"
        "assert zlib.decompress(zlib.compress(b'a' * 1000)) == b'a' * 1000\n"
        "assert gzip.decompress(gzip.compress(b'b' * 1000)) == b'b' * 1000\n"
        "print('whole')"
    )
    # Where zlib is broken the process aborts, or hangs for ever.
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout.strip()) == (0, "whole"), done.stderr


def test_nobody_else_imports_pycolmap():
    root = frames.pathlib.Path(colmap.__file__).parents[2]
    users = [
        path.name
        for path in (root / "nerfies_jax").rglob("*.py")
        if re.search(r"import pycolmap|library\(.pycolmap", path.read_text())
    ]
    assert users == ["colmap_library.py"]


def test_every_camera_is_held_against_the_images(tmp_path):
    make(tmp_path)
    model = tmp_path / "sparse/0"
    (model / "cameras.txt").write_text(f"1 {PINHOLE}\n2 PINHOLE 20 20 30 33 10 10\n")
    text = (model / "images.txt").read_text()
    (model / "images.txt").write_text(text.replace(" 1 f_008", " 2 f_008"))
    with pytest.raises(CaptureError, match="camera 2 is for 20x20 pixels"):
        room.load(tmp_path)


def test_names_with_backslashes_and_equal_numbers_are_of_two_cameras(tmp_path):
    make(tmp_path, count=8)
    (tmp_path / "Images/left").mkdir(parents=True)
    (tmp_path / "Images/right").mkdir()
    model = tmp_path / "sparse/0/images.txt"
    text = model.read_text()
    for row in range(8):
        side, number = ("left", row) if row < 4 else ("right", row - 4)
        text = text.replace(f"f_{row:03d}.png", f"{side}\\{number}.png")
        image = tmp_path / f"images/f_{row:03d}.png"
        image.rename(tmp_path / f"Images/{side}/{number}.png")
    (tmp_path / "images").rmdir()
    model.write_text(text)
    capture = room.load(tmp_path)
    assert capture.ids[:2] == ("left_0", "left_1")
    assert capture.warp_ids.tolist() == [0, 1, 2, 3] * 2
    np.testing.assert_allclose(capture.times, [0, 1 / 3, 2 / 3, 1] * 2, atol=1e-6)
    assert capture.camera_ids.tolist() == [0] * 4 + [1] * 4
    assert any("equal times" in note for note in capture.notes)
