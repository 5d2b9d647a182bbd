"""Nerfies-like directories: what is read, what is refused, and the round trip."""

import dataclasses

import jax
import numpy as np
import PIL.Image
import pytest

from nerfies_jax.capture import nerfies_format, nerfies_views, world_points
from nerfies_jax.capture.capture import CaptureError, PointCloud
from nerfies_jax.geometry import camera
from tests.capture.broken import dump, edited, refused

SIZE = (12, 8)
SCENE = {"scale": 0.5, "center": [1.0, -2.0, 3.0], "near": 0.2, "far": 1.5}


def save_image(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    PIL.Image.fromarray(pixels).save(path, format=path.suffix[1:])


def orientation(angle):
    c, s = np.cos(angle), np.sin(angle)
    return [[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]


def image(row, size=SIZE, channels=3):
    rng = np.random.default_rng(row)
    return rng.integers(0, 256, (size[1], size[0], channels), np.uint8)


def make(folder, count=6, factors=(1,), channels=3):
    """A directory written by hand: ids 000 to 005, raw warp ids 10, 12, 14, ..."""
    ids = [f"{row:03d}" for row in range(count)]
    dump(folder / "scene.json", SCENE)
    dump(
        folder / "dataset.json",
        {"count": count, "ids": ids, "train_ids": ids[::2], "val_ids": ids[1::2]},
    )
    entries = {
        name: {"warp_id": 10 + 2 * row, "appearance_id": row, "camera_id": row % 2}
        for row, name in enumerate(ids)
    }
    dump(folder / "metadata.json", entries)
    for row, name in enumerate(ids):
        entry = {
            "orientation": orientation(0.1 * row),
            "position": [1.0 + row, -2.0, 3.5],
            "focal_length": 20.0,
            "principal_point": [6.5, 4.25],
            "skew": 0.5,
            "pixel_aspect_ratio": 1.25,
            "radial_distortion": [0.1, 0.01, 0.001],
            "tangential": [0.02, 0.03],
            "image_size": list(SIZE),
        }
        dump(folder / "camera" / f"{name}.json", entry)
        for factor in factors:
            size = (SIZE[0] // factor, SIZE[1] // factor)
            save_image(
                folder / "rgb" / f"{factor}x" / f"{name}.png",
                image(row, size, channels),
            )
    return folder


def test_everything_in_the_files_arrives(tmp_path):
    capture = nerfies_format.read(make(tmp_path / "scene"))
    assert capture.name == "scene"
    assert capture.ids == ("000", "001", "002", "003", "004", "005")
    for row in range(6):
        np.testing.assert_array_equal(capture.images[row], image(row))
    assert capture.train.tolist() == [0, 2, 4]
    assert capture.heldout.tolist() == [1, 3, 5]
    assert capture.warp_ids.tolist() == [*range(6)]  # re-indexed from 10, 12, ...
    assert capture.camera_ids.tolist() == [0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(capture.times, [0, 0.2, 0.4, 0.6, 0.8, 1], atol=1e-7)
    cameras = capture.cameras
    # (position - center) * scale, by hand
    np.testing.assert_allclose(
        cameras.position, [[row * 0.5, 0, 0.25] for row in range(6)], atol=1e-7
    )
    np.testing.assert_allclose(
        cameras.camera_from_world[3], orientation(0.3), atol=1e-7
    )
    assert (capture.near, capture.far) == (0.2, 1.5)  # already in scene units
    np.testing.assert_array_equal(cameras.focal_px, np.float32([20] * 6))
    np.testing.assert_array_equal(cameras.pixel_aspect, np.float32([1.25] * 6))
    np.testing.assert_array_equal(cameras.skew_px, np.float32([0.5] * 6))
    np.testing.assert_array_equal(cameras.radial[2], np.float32([0.1, 0.01, 0.001]))
    np.testing.assert_array_equal(cameras.tangential[2], np.float32([0.02, 0.03]))
    assert all(leaf.dtype == np.float32 for leaf in jax.tree.leaves(cameras))
    np.testing.assert_allclose(capture.up, [0, -1, 0], atol=1e-7)  # rows: right, down


@pytest.mark.parametrize(
    ("stored", "options", "size"),
    [
        ((2, 4), {}, (6, 4)),
        ((1, 2), {"factor": 2}, (6, 4)),
        ((1,), {"factor": 4}, (3, 2)),
        ((2,), {"factor": 4}, (3, 2)),
        ((1,), {"max_side": 7}, (6, 4)),
        ((2,), {"max_side": 100}, (6, 4)),
        ((2,), {"max_side": 4}, (3, 2)),  # a third would do, and cannot be made
    ],
)
def test_a_factor_is_read_or_made_and_points_keep_their_place(
    tmp_path, stored, options, size
):
    capture = nerfies_format.read(make(tmp_path, factors=stored), **options)
    assert capture.size == size
    full = nerfies_format.read_cameras(tmp_path)
    ratio = size[0] / SIZE[0]
    point = np.float32([[0.1, 0.2, 2.0]])
    pixel, *_ = world_points.pixels_of(capture.cameras, 0, point, size)
    whole, *_ = world_points.pixels_of(full.cameras, 0, point, SIZE)
    np.testing.assert_allclose(pixel, whole * ratio, rtol=1e-6)
    if max(stored) == 1 and size != SIZE:
        step = SIZE[0] // size[0]
        block = image(0)[:step, :step].reshape(-1, 3).mean(0)
        assert (np.abs(capture.images[0, 0, 0] - block) <= 0.5).all()


def test_ids_written_as_numbers_are_names(tmp_path):
    make(tmp_path)
    dump(tmp_path / "dataset.json", {"ids": [0, 1], "train_ids": [0], "val_ids": [1]})
    for row in (0, 1):
        for folder, ending in (("camera", "json"), ("rgb/1x", "png")):
            file = tmp_path / folder / f"00{row}.{ending}"
            file.rename(file.with_name(f"{row}.{ending}"))
    dump(tmp_path / "metadata.json", {"0": {"warp_id": 0}, "1": {"warp_id": 1}})
    assert nerfies_format.read(tmp_path).ids == ("0", "1")


@pytest.mark.parametrize(
    ("dataset", "heldout", "train", "scored"),
    [
        ({"ids": 16}, None, 14, [4, 12]),  # the middle one of every eight
        ({"ids": 16}, 4, 12, [2, 6, 10, 14]),
        ({"ids": 16, "val_ids": []}, None, 14, [4, 12]),
        ({"val_ids": [3, 5], "ids": 16}, None, 14, [3, 5]),
        ({"ids": 16, "train_ids": [0, 1, 2], "val_ids": [15]}, None, 3, [3]),
        # HyperNeRF: every fourth is learned from, those half-way are scored.
        ({"ids": 16}, "interp", 4, [1, 3, 5, 7]),
        (None, None, 14, [4, 12]),
    ],
)
def test_splits(tmp_path, dataset, heldout, train, scored):
    make(tmp_path, count=16)
    if dataset is None:
        (tmp_path / "dataset.json").unlink()
    else:
        names = {
            key: [f"{row:03d}" for row in (range(rows) if key == "ids" else rows)]
            for key, rows in dataset.items()
        }
        dump(tmp_path / "dataset.json", names)
    capture = nerfies_format.read(tmp_path, heldout=heldout)
    assert capture.train.size == train
    assert capture.heldout.tolist() == scored
    if heldout == "interp":
        assert capture.ids == tuple(f"{row:03d}" for row in range(0, 16, 2))


def test_dycheck_splits_come_in_pairs(tmp_path):
    make(tmp_path)
    for name, rows in {
        "train_intl": [0, 3],
        "val_intl": [4],
        "train": [1],
        "val": [2],
    }.items():
        dump(
            tmp_path / "splits" / f"{name}.json",
            {"frame_names": [f"00{r}" for r in rows]},
        )
    pairs = nerfies_format.read(tmp_path, heldout="val_intl")
    assert [pairs.ids[row] for row in pairs.train] == ["000", "003"]
    plain = nerfies_format.read(tmp_path, heldout="val")
    assert [plain.ids[row] for row in plain.heldout] == ["002"]
    with pytest.raises(CaptureError, match="no such split; there are"):
        nerfies_format.read(tmp_path, heldout="test")


def test_hypernerf_triples_and_time_ids(tmp_path):
    make(tmp_path)
    table = {f"00{row}": {"warp_id": row, "time_id": row**2} for row in range(6)}
    table["003"]["warp_id"] = [2, 4, 0.25]
    dump(tmp_path / "metadata.json", table)
    capture = nerfies_format.read(tmp_path)
    np.testing.assert_allclose(capture.times, np.arange(6) ** 2 / 25, atol=1e-7)
    assert capture.warp_ids.tolist() == [0, 1, 2, 3, 4, 5]
    assert any("interpolated warp ids" in note for note in capture.notes)


@pytest.mark.parametrize("ending", [".png.png", ".png"])
def test_nerf_ds_masks_are_black_where_it_moves(tmp_path, ending):
    make(tmp_path)
    for row in range(6):
        mask = np.full((8, 12), 255, np.uint8)
        mask[2:4, 3:7] = 0
        target = tmp_path / "resized_mask" / "1x" / f"00{row}{ending}"
        save_image(target, mask)
    capture = nerfies_format.read(tmp_path)
    expected = np.zeros((8, 12), bool)
    expected[2:4, 3:7] = True
    np.testing.assert_array_equal(capture.moving[5], expected)
    small = nerfies_format.read(tmp_path, factor=2)
    np.testing.assert_array_equal(
        small.moving[5], expected.reshape(4, 2, 6, 2).any((1, 3))
    )


def test_dycheck_alpha_marks_pixels_that_were_observed(tmp_path):
    make(tmp_path, channels=4)
    capture = nerfies_format.read(tmp_path)
    np.testing.assert_array_equal(capture.valid[2], image(2, channels=4)[..., 3] == 255)


def test_dycheck_depth_is_scaled_and_may_be_absent(tmp_path):
    make(tmp_path)
    depth = np.random.default_rng(9).uniform(1, 2, (8, 12, 1)).astype(np.float32)
    depth[0, 0], depth[0, 1], depth[0, 2] = 0, np.nan, -1
    (tmp_path / "depth/1x").mkdir(parents=True)
    np.save(tmp_path / "depth/1x/002.npy", depth)
    capture = nerfies_format.read(tmp_path)
    expected = depth[..., 0] * np.float32(0.5)
    expected[0, :3] = 0
    np.testing.assert_array_equal(capture.depths[2], expected)
    assert not capture.depths[[0, 1, 3, 4, 5]].any()
    half = nerfies_format.read(tmp_path, factor=2).depths[2]
    corner = expected[:2, :2]
    assert half[0, 0] == pytest.approx(corner[corner > 0].mean())


def test_points_are_scaled_and_colored_from_the_images(tmp_path):
    make(tmp_path)
    for row in range(6):
        save_image(
            tmp_path / "rgb/1x" / f"00{row}.png",
            np.full((8, 12, 3), 40 + row, np.uint8),
        )
    world = np.array([[1.0, -2.0, 5.0], [1.0, -2.0, -9.0], [np.nan, 0, 0]])
    np.save(tmp_path / "points.npy", world)
    capture = nerfies_format.read(tmp_path)
    np.testing.assert_allclose(
        capture.points.position, [[0, 0, 1], [0, 0, -6]], atol=1e-7
    )
    assert capture.points.color[0, 0] in range(40, 46)
    # Behind every camera.
    assert capture.points.color[1].tolist() == [world_points.UNSEEN] * 3
    assert any("1 points are not finite" in note for note in capture.notes)


def test_no_images_is_an_error_that_offers_the_cameras(tmp_path):
    make(tmp_path, factors=())
    with pytest.raises(CaptureError, match="read_cameras"):
        nerfies_format.read(tmp_path)
    views = nerfies_format.read_cameras(tmp_path)
    assert views.size == SIZE
    assert views.cameras.focal_px.shape == (6,)


def test_missing_images_are_listed_or_left_out(tmp_path):
    make(tmp_path)
    for name in ("001", "004"):
        (tmp_path / f"rgb/1x/{name}.png").unlink()
    with pytest.raises(CaptureError, match=r"2 of 6 images are missing \(001, 004\)"):
        nerfies_format.read(tmp_path)
    capture = nerfies_format.read(tmp_path, missing="skip")
    assert capture.ids == ("000", "002", "003", "005")
    assert capture.train.tolist() == [0, 1]
    assert capture.heldout.tolist() == [2, 3]
    assert any("001, 004" in note for note in capture.notes)


def truncate(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def written(name, value):
    return lambda folder: dump(folder / name, value)


def changed(name, **changes):
    def spoil(folder):
        with edited(folder / name) as table:
            table |= changes

    return spoil


def one_camera(**changes):
    return changed("camera/002.json", **changes)


def one_entry(row, **entry):
    return changed("metadata.json", **{row: entry})


def replaced(old, new):
    def spoil(folder):
        file = folder / "camera/002.json"
        file.write_text(file.read_text().replace(old, new))

    return spoil


def imaged(name, pixels):
    return lambda folder: save_image(folder / name, pixels)


def filled(name, text):
    return lambda folder: (folder / name).write_text(text)


def points(array, whole=True):
    def spoil(folder):
        np.save(folder / "points.npy", array, allow_pickle=True)
        if not whole:
            truncate(folder / "points.npy")

    return spoil


def without_ids(folder):
    dump(folder / "dataset.json", {})
    for file in (folder / "camera").iterdir():
        file.unlink()


def all_small(folder):
    for row in range(6):
        save_image(folder / f"rgb/1x/00{row}.png", SMALL)


SMALL = image(0, (6, 4))
LATE = {f"00{row}": {"warp_id": row, "time": 0.5 * row} for row in range(6)}
CLIMBS = {"train_ids": ["../../x"], "val_ids": ["001"]}
MIRRORED = np.diag([1.0, 1.0, -1.0]).tolist()
BAD = {
    "camera NaN": (replaced("20.0", "NaN"), "002.json: NaN on line 1"),
    "camera overflow": (replaced("20.0", "1e999"), "002.json"),
    "camera word": (one_camera(focal_length="twenty"), "$.focal_length"),
    "camera short row": (one_camera(position=[1.0, 2.0]), "$.position"),
    "camera mirrored": (
        one_camera(orientation=MIRRORED),
        "'002': orientation is a reflection",
    ),
    "camera absent": (lambda f: (f / "camera/002.json").unlink(), "002.json"),
    "camera size": (one_camera(image_size=[8, 12]), "002.json: image_size"),
    "image not its camera's": (imaged("rgb/1x/000.png", SMALL), "6x4"),
    "no image its camera's": (all_small, "000.png: 6x4 pixels, but 1/"),
    "image cut short": (lambda f: truncate(f / "rgb/1x/003.png"), "003.png"),
    "image empty": (filled("rgb/1x/003.png", ""), "003.png"),
    "id without metadata": (
        written("metadata.json", {"000": {"warp_id": 0}}),
        "no entry for frame '001'",
    ),
    "id negative": (one_entry("003", warp_id=-1), "frame '003' has warp_id -1"),
    "id huge": (one_entry("003", camera_id=2**40), "frame '003' has camera_id"),
    "time outside": (written("metadata.json", LATE), "frame '003' has time 1.5"),
    "id that climbs": (written("dataset.json", CLIMBS), "leads outside"),
    "absolute id": (
        written("dataset.json", CLIMBS | {"train_ids": ["/etc/x"]}),
        "leads outside",
    ),
    "no ids": (without_ids, "no frames; list"),
    "scene not JSON": (filled("scene.json", "{"), "scene.json"),
    "scene too deep": (filled("metadata.json", "[" * 100_000), "metadata.json"),
    "scene absent key": (written("scene.json", {"scale": 1.0}), "`center`"),
    "points pickled": (points(np.array([{"a": 1}])), "points.npy"),
    "points flat": (points(np.zeros(6)), "expected [points, 3]"),
    "points cut short": (points(np.zeros((100, 3)), whole=False), "points.npy"),
    "mask of another size": (
        imaged("resized_mask/1x/000.png.png", np.zeros((4, 4), np.uint8)),
        "000.png.png: a mask of 4x4",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_broken_directory_is_refused_in_one_line(tmp_path, case):
    make(tmp_path)
    spoil, refusal = BAD[case]
    spoil(tmp_path)
    refused(nerfies_format.read, tmp_path, refusal)


def full_capture(tmp_path):
    capture = nerfies_format.read(make(tmp_path / "made", channels=4))
    rng = np.random.default_rng(3)
    moving = rng.random(capture.valid.shape) < 0.3
    return dataclasses.replace(
        capture,
        times=np.sort(rng.random(6)).astype(np.float32),
        moving=moving,
        depths=np.where(moving, 0, rng.uniform(0.3, 1, moving.shape)).astype(
            np.float32
        ),
        points=PointCloud(
            rng.normal(size=(5, 3)).astype(np.float32),
            rng.integers(0, 256, (5, 3), np.uint8),
        ),
        background=(1.0, 0.5, 0.0),
        frames_per_second=29.97,
    )


def test_what_is_written_is_read_back(tmp_path):
    first = full_capture(tmp_path)
    nerfies_format.write(first, tmp_path / "copy")
    second = nerfies_format.read(tmp_path / "copy")
    assert second.ids == first.ids
    splits = ("train", "heldout", "warp_ids", "appearance_ids", "camera_ids")
    for name in ("images", "times", "valid", "moving", *splits):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name))
    leaves = map(jax.tree.leaves, (first.cameras, second.cameras))
    for one, other in zip(*leaves, strict=True):
        # Positions pass through float64 world units: half an ulp of the center, 3.
        np.testing.assert_allclose(one, other, atol=2e-7)
    np.testing.assert_allclose(second.depths, first.depths, rtol=3e-7)
    np.testing.assert_allclose(second.points.position, first.points.position, atol=3e-7)
    np.testing.assert_array_equal(second.points.color, first.points.color)
    for name in ("near", "far", "scale", "center", "background", "frames_per_second"):
        assert getattr(second, name) == getattr(first, name)
    np.testing.assert_allclose(second.up, first.up, atol=1e-7)


def test_colors_of_points_are_read_by_their_earlier_name(tmp_path):
    first = full_capture(tmp_path)
    nerfies_format.write(first, tmp_path / "copy")
    earlier = "points_color.npy".replace("color", "colo" + "ur")
    (tmp_path / "copy/points_color.npy").rename(tmp_path / "copy" / earlier)
    second = nerfies_format.read(tmp_path / "copy")
    np.testing.assert_array_equal(second.points.color, first.points.color)


def test_reductions_can_be_written_too(tmp_path):
    first = full_capture(tmp_path)
    first.valid[:, :4] = True  # whole blocks
    nerfies_format.write(first, tmp_path / "copy", factors=(1, 2))
    stored = nerfies_format.read(tmp_path / "copy", factor=2)
    reduced = nerfies_format.read(tmp_path / "made", factor=2)
    np.testing.assert_array_equal(stored.images, reduced.images)
    assert sorted(p.name for p in (tmp_path / "copy/resized_mask").iterdir()) == [
        "1x",
        "2x",
    ]


def test_writing_leaves_all_or_nothing(tmp_path, monkeypatch):
    first = full_capture(tmp_path)

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(nerfies_format.image_files, "write_png", fail)
    with pytest.raises(CaptureError, match="No space left"):
        nerfies_format.write(first, tmp_path / "copy")
    assert [p.name for p in tmp_path.iterdir()] == ["made"]


def test_writing_refuses_a_folder_in_use_and_names_that_climb(tmp_path):
    first = full_capture(tmp_path)
    with pytest.raises(CaptureError, match="already there"):
        nerfies_format.write(first, tmp_path / "made")
    climbing = dataclasses.replace(first, ids=("../x", *first.ids[1:]))
    with pytest.raises(CaptureError, match="cannot be a file name"):
        nerfies_format.write(climbing, tmp_path / "copy")
    assert [p.name for p in tmp_path.iterdir()] == ["made"]


@pytest.mark.full
def test_a_real_dycheck_capture_has_its_cameras_without_images(data_dir):
    scene = data_dir / "dycheck_windmill_cameras"
    views = nerfies_views.read_cameras(scene)
    assert (len(views.ids), views.train.size, views.heldout.size) == (696, 277, 419)
    assert views.camera_ids[views.train].max() == 0
    assert np.unique(views.warp_ids).size == 277
    assert (views.times.min(), views.times.max()) == (0, 1)
    assert views.size == (720, 960)
    lens = np.unique(views.cameras.focal_px)
    assert lens.size == 3
    # The card: scaled camera centers lie within [-0.06, 0.34].
    assert -0.07 < views.cameras.position.min() < views.cameras.position.max() < 0.35
    for fixed in (1, 2):
        rows = views.camera_ids == fixed
        assert np.ptp(camera.take(views.cameras, rows).position, axis=0).max() == 0
    with pytest.raises(CaptureError, match="read_cameras"):
        nerfies_format.read(scene)


def test_metadata_without_times_takes_those_of_the_names(tmp_path):
    """They were all 0, so that a moving scene was read as a static one."""
    make(tmp_path)
    file = tmp_path / "metadata.json"
    with edited(file) as table:
        for entry in table.values():
            del entry["warp_id"]
    views = nerfies_views.read_cameras(tmp_path)
    np.testing.assert_allclose(views.times, np.linspace(0, 1, 6), atol=1e-6)
    assert views.warp_ids.tolist() == list(range(6))
    assert views.camera_ids.tolist() == [0, 1] * 3
    assert any("no warp_id, time_id or time" in note for note in views.notes)
    table["002"]["warp_id"] = 3
    dump(file, table)
    with pytest.raises(CaptureError, match=r"5 of 6 frames have no warp_id \(000, "):
        nerfies_views.read_cameras(tmp_path)


def test_keys_that_are_not_read_are_named(tmp_path):
    make(tmp_path)
    dump(tmp_path / "extra.json", {})
    assert not any("not read" in note for note in nerfies_format.read(tmp_path).notes)
    for name, keys in (
        ("scene.json", {"rotation": 1}),
        ("extra.json", {"bbox": [], "mirror": True}),
        ("camera/000.json", {"shutter": 0.1}),
    ):
        with edited(tmp_path / name) as table:
            table |= keys
    with edited(tmp_path / "metadata.json") as entries:
        entries["003"]["exposure"] = 2.0
    notes = nerfies_format.read(tmp_path).notes
    for file, key in (
        ("scene.json", "rotation"),
        ("extra.json", "mirror"),
        ("000.json", "shutter"),
        ("metadata.json", "exposure"),
    ):
        assert f"keys of {file} that are not read: {key}" in notes
