"""The plugin for nerfbaselines keeps its protocol, and trains, saves and loads."""

import importlib.metadata
import inspect
import pathlib
import types

import jax
import numpy as np
import pytest

from experiments.plugins import nerfbaselines_capture as conversion
from experiments.plugins.nerfbaselines_method import NerfiesJax
from nerfies_jax.capture.capture import CaptureError
from nerfies_jax.geometry import camera
from tests import scenes

# Parameters of nerfbaselines 1.2 without `self`, a star before those by keyword.
DOCUMENTED = {
    "__init__": ["*checkpoint", "*train_dataset", "*config_overrides"],
    "get_method_info": [],
    "get_info": [],
    "get_train_embedding": ["index"],
    "optimize_embedding": ["dataset", "*embedding"],
    "render": ["camera", "*options"],
    "train_iteration": ["step"],
    "save": ["path"],
}


def parameters(kind, name):
    members = inspect.signature(getattr(kind, name)).parameters.values()
    return [
        ("*" if each.kind is each.KEYWORD_ONLY else "") + each.name
        for each in members
        if each.name != "self"
    ]


def test_the_method_has_the_documented_signatures():
    for name, expected in DOCUMENTED.items():
        assert parameters(NerfiesJax, name) == expected, name


def test_the_installed_protocol_is_the_documented_one():
    nerfbaselines = pytest.importorskip("nerfbaselines")
    assert isinstance(NerfiesJax.__new__(NerfiesJax), nerfbaselines.Method)
    for name in DOCUMENTED:
        expected = parameters(nerfbaselines.Method, name)
        assert parameters(NerfiesJax, name) == expected, name
    assert "nerfies-jax" in nerfbaselines.get_supported_methods()


def test_nerfbaselines_finds_the_method_by_its_entry_point():
    points = importlib.metadata.entry_points(group="nerfbaselines.specs")
    path = pathlib.Path(conversion.__file__).parents[1]
    values = [point.value for point in points if point.name == "nerfies-jax"]
    assert set(values) <= {"experiments.plugins.nerfbaselines_spec"}
    assert (path / "plugins/nerfbaselines_spec.py").is_file()


def cameras_of(capture, model=1, lens=(0.05, -0.01, 0.002, -0.003)):
    """Cameras as nerfbaselines has them, of another world than the capture's."""
    own = capture.cameras
    count = len(own.focal_px)
    poses = np.zeros((count, 3, 4), np.float32)
    poses[:, :, :3] = np.swapaxes(own.camera_from_world, 1, 2)
    poses[:, :, 3] = 3 * own.position + [5, 0, -2]
    intrinsics = np.stack(
        [
            own.focal_px,
            own.focal_px * own.pixel_aspect,
            *np.moveaxis(own.principal_point_px, -1, 0),
        ],
        axis=-1,
    )
    return types.SimpleNamespace(
        poses=poses,
        intrinsics=intrinsics,
        camera_models=np.full(count, model, np.uint8),
        distortion_parameters=np.tile(np.float32(lens), (count, 1)),
        image_sizes=np.tile(np.int32(capture.size), (count, 1)),
        nears_fars=None,
    )


def one(cameras, row):
    fields = {k: None if v is None else v[row] for k, v in vars(cameras).items()}
    return types.SimpleNamespace(**fields)


def dataset_of(capture, **changes):
    names = [f"/data/images/{name}.png" for name in capture.ids]
    dataset = {
        "cameras": cameras_of(capture, model=0),
        "images": list(capture.images),
        "image_paths": names,
        "image_paths_root": "/data/images",
        "masks": None,
        "points3D_xyz": 3 * capture.points.position + np.float32([5, 0, -2]),
        "points3D_rgb": capture.points.color,
        "metadata": {"color_space": "srgb"},
    }
    return dataset | changes


@pytest.mark.parametrize("model", conversion.CAMERA_MODELS)
def test_points_land_on_the_pixels_of_opencv(model):
    capture = scenes.tiny_capture()
    number = conversion.CAMERA_MODELS.index(model)
    lens = [0.05, -0.01, 0.002, -0.003, 0.001, -0.0005][: 6 if number == 2 else 4]
    inputs = cameras_of(capture, number, lens)
    world = conversion.world_cameras(inputs)
    place = conversion.in_scene_units(world, capture)._replace(
        position=world.position.astype(np.float32)
    )
    points = 3 * capture.points.position[:20] + np.float32([5, 0, -2])
    for row in range(2):
        pose = np.float64(inputs.poses[row])
        local = (points - pose[:, 3]) @ pose[:, :3]
        u, v = (local[:, :2] / local[:, 2:]).T
        r2 = u * u + v * v
        if model == "opencv":
            k1, k2, p1, p2 = lens
            bend = 1 + k1 * r2 + k2 * r2 * r2
            u, v = (
                u * bend + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
                v * bend + 2 * p2 * u * v + p1 * (r2 + 2 * v * v),
            )
        elif model == "opencv_fisheye":
            k1, k2, _, _, k3, k4 = lens
            t = np.arctan(np.sqrt(r2))
            bent = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
            u, v = u * bent / np.sqrt(r2), v * bent / np.sqrt(r2)
        fx, fy, cx, cy = inputs.intrinsics[row]
        expected = np.stack([fx * u + cx, fy * v + cy], axis=-1)
        pixel, _ = camera.project(camera.take(place, row), points)
        np.testing.assert_allclose(pixel, expected, atol=2e-3)


def test_datasets_that_no_capture_can_hold_are_refused():
    capture = scenes.tiny_capture()
    sizes = cameras_of(capture, model=0)
    sizes.image_sizes[0] += 1
    mixed = cameras_of(capture, model=0)
    mixed.camera_models[0] = 2
    for changes, message in (
        ({"cameras": sizes}, "images of 2 sizes"),
        ({"cameras": mixed}, "are fisheyes; undistort"),
        ({"metadata": {"color_space": "linear"}}, "only srgb is supported"),
    ):
        with pytest.raises(CaptureError, match=message):
            conversion.capture_of(dataset_of(capture, **changes))
    with pytest.raises(ValueError, match="preset sonata-small needs timestamps for mo"):
        NerfiesJax(
            train_dataset=dataset_of(capture),
            config_overrides={"preset": "sonata-small"},
        )


def test_alpha_is_blended_onto_the_background_and_masks_are_kept():
    capture = scenes.tiny_capture()
    alpha = np.full((*capture.images.shape[:3], 1), 51, np.uint8)  # a fifth
    images = np.concatenate([capture.images, alpha], axis=-1)
    masks = np.zeros(capture.images.shape[:3], bool)
    masks[:, 2:] = True
    about = {"background_color": np.uint8([0, 100, 200])}
    dataset = dataset_of(capture, images=images, masks=list(masks), metadata=about)
    read = conversion.capture_of(dataset)
    expected = 0.2 * capture.images + 0.8 * np.array([0, 100, 200])
    np.testing.assert_allclose(read.images, expected, atol=0.6)
    np.testing.assert_array_equal(read.valid, masks)
    np.testing.assert_allclose(read.background, np.array([0, 100, 200]) / 255)


@pytest.mark.full
def test_a_model_trains_saves_loads_and_continues(tmp_path):
    capture = scenes.tiny_capture()
    dataset = dataset_of(capture)
    settings = {"preset": "splats-static-small", "steps": "40"}
    first = NerfiesJax(train_dataset=dataset, config_overrides=settings)
    assert first.get_info()["num_iterations"] == 40
    metrics = [first.train_iteration(step) for step in range(40)]
    assert np.mean([m["psnr"] for m in metrics[-5:]]) > metrics[0]["psnr"] + 1
    with pytest.raises(ValueError, match="step 40 is due, got step=3"):
        first.train_iteration(3)
    view = one(dataset["cameras"], 0)
    image = first.render(view)
    width, height = capture.size
    assert image["color"].shape == (height, width, 3)
    opaque = image["accumulation"] > 0.9
    # In units of the dataset, where lengths are three times those of the capture.
    depth = np.median(image["depth"][opaque])
    assert 3 * capture.near < depth < 3 * capture.far
    assert first.render(view, options={"outputs": ("depth",)}).keys() == {"depth"}
    first.save(str(tmp_path / "one"))
    loaded = NerfiesJax(checkpoint=str(tmp_path / "one"))
    assert loaded.get_info()["loaded_step"] == 40
    same = loaded.render(view)
    for name, values in image.items():
        np.testing.assert_allclose(same[name], values, atol=1e-6)
    with pytest.raises(ValueError, match="was loaded to render"):
        loaded.train_iteration(40)
    loaded.save(str(tmp_path / "two"))
    copies = [
        {p.relative_to(root): p.read_bytes() for p in root.rglob("*") if p.is_file()}
        for root in (tmp_path / "one", tmp_path / "two")
    ]
    assert copies[0] == copies[1]
    resumed = NerfiesJax(checkpoint=str(tmp_path / "one"), train_dataset=dataset)
    assert resumed.train_iteration(40)["loss"] == first.train_iteration(40)["loss"]
    with pytest.raises(ValueError, match="was made with the settings"):
        NerfiesJax(checkpoint=str(tmp_path / "one"), config_overrides={"steps": 9})
    exported = first.export_gaussian_splats()
    count = len(exported["means"])
    assert exported["spherical_harmonics"].shape[:2] == (count, 3)
    assert jax.tree.all(jax.tree.map(lambda x: np.isfinite(x).all(), exported))
    center = np.median(exported["means"], axis=0)
    cloud = dataset["points3D_xyz"]
    assert np.linalg.norm(center - np.median(cloud, axis=0)) < np.ptp(cloud) / 2
