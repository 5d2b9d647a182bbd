"""Pieces of a reconstruction that share images, and copies of its features."""

import numpy as np
import PIL.Image
import pytest

from nerfies_jax.capture import colmap_library, sfm_features, sfm_joining
from nerfies_jax.capture.sfm_features import CameraGroup

pytest.importorskip("pycolmap")
LENS = (1280.0, 512.0, 384.0, 0.0)


@pytest.fixture
def synthetic(tmp_path):
    """A reconstruction of twelve images with its database, made by COLMAP."""
    pycolmap = colmap_library.library()
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 1
    options.num_frames_per_rig, options.num_points3D = 12, 120
    options.camera_params = LENS
    pycolmap.set_random_seed(0)
    database = pycolmap.Database.open(tmp_path / "database.db")
    truth = pycolmap.synthesize_dataset(options, database)
    database.close()
    return truth, tmp_path / "database.db"


def piece(truth, numbers, scale):
    """A model of some of the images, in coordinates of its own."""
    pycolmap = colmap_library.library()
    model = pycolmap.Reconstruction(truth)
    for number in set(truth.reg_image_ids()) - set(numbers):
        model.deregister_frame(model.image(number).frame_id)
    model.tear_down()
    turn = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.6, 0.8]))
    model.transform(pycolmap.Sim3d(scale, turn, np.array([1.0, 2.0, 3.0]) * scale))
    return model


def options():
    options = colmap_library.library().IncrementalPipelineOptions()
    options.num_threads, options.random_seed = 1, 0
    return options


def test_pieces_that_share_images_are_joined(synthetic, tmp_path):
    pycolmap = colmap_library.library()
    truth, database = synthetic
    numbers = sorted(truth.reg_image_ids())
    # The last shares images with the second only.
    pieces = [
        piece(truth, numbers[:6], 1.0),
        piece(truth, numbers[4:9], 0.5),
        piece(truth, numbers[7:], 2.0),
    ]
    whole, left = sfm_joining.join(pieces, database, tmp_path, tmp_path, options())
    assert (whole.num_reg_images(), left) == (12, [12])
    assert pycolmap.align_reconstructions_via_proj_centers(whole, truth, 1e-3)
    assert whole.compute_mean_reprojection_error() < 1e-3


def test_pieces_that_share_nothing_stay_apart(synthetic, tmp_path):
    truth, database = synthetic
    numbers = sorted(truth.reg_image_ids())
    pieces = [piece(truth, numbers[:8], 1.0), piece(truth, numbers[8:], 0.5)]
    largest, left = sfm_joining.join(pieces, database, tmp_path, tmp_path, options())
    assert (largest.num_reg_images(), left) == (8, [8, 4])


def test_masked_and_fine_features_are_left_out_with_their_matches(tmp_path):
    pycolmap = colmap_library.library()
    images, masks = tmp_path / "images", tmp_path / "masks"
    images.mkdir()
    masks.mkdir()
    names = ("b.png", "a.png")
    for name in names:
        PIL.Image.new("RGB", (40, 30)).save(images / name)
    mask = np.full((30, 40), 255, np.uint8)
    mask[:10] = 0
    PIL.Image.fromarray(mask).save(masks / "a.png.png")
    PIL.Image.new("L", (40, 30), 255).save(masks / "b.png.png")
    source = tmp_path / "source.db"
    sfm_features._create(source, images, [CameraGroup(names, 1.2)], "PINHOLE")
    # Rows of features: x, y and an affine shape of scale 1 or 3.
    rng = np.random.default_rng(0)
    points = np.zeros((20, 6), np.float32)
    points[:, :2] = rng.uniform(0, (40, 30), (20, 2))
    points[:, 2] = points[:, 5] = np.where(np.arange(20) % 4, 3.0, 1.0)
    database = pycolmap.Database.open(source)
    first, second = sorted(image.image_id for image in database.read_all_images())
    for number in (first, second):
        database.write_keypoints(number, points)
    pairs = np.repeat(np.arange(20, dtype=np.uint32)[:, None], 2, axis=1)
    database.write_matches(first, second, pairs)
    database.close()

    groups = [CameraGroup(("b.png",), 0.8), CameraGroup(("a.png",), 1.5)]
    target = tmp_path / "target.db"
    sfm_features.derive(source, target, images, groups, "SIMPLE_RADIAL", masks, 2.0)
    database = pycolmap.Database.open(target)
    by_name = {image.name: image for image in database.read_all_images()}
    coarse = points[:, 2] > 2
    masked = {"b.png": coarse, "a.png": coarse & (points[:, 1] >= 10)}
    for name, rows in masked.items():
        image = by_name[name]
        np.testing.assert_array_equal(
            database.read_keypoints(image.image_id), points[rows]
        )
        camera = database.read_camera(image.camera_id)
        assert camera.model_name == "SIMPLE_RADIAL"
        assert camera.focal_length == pytest.approx(40 * (0.8, 1.5)[name == "a.png"])
    ids = [by_name[name].image_id for name in ("a.png", "b.png")]
    matches = database.read_matches(*ids)
    database.close()
    for (a, b), row in zip(matches, np.flatnonzero(masked["a.png"]), strict=True):
        np.testing.assert_array_equal(points[masked["a.png"]][a], points[row])
        np.testing.assert_array_equal(points[masked["b.png"]][b], points[row])
