"""Conversion of nerfbaselines' datasets and cameras, and storage of their cameras."""

import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from nerfies_jax.capture import points, world_points
from nerfies_jax.capture.capture import Capture, CaptureError, PointCloud
from nerfies_jax.capture.points import Placement
from nerfies_jax.geometry import camera
from nerfies_jax.geometry.camera import Camera

# In the order of nerfbaselines, whose arrays have the index of a model.
CAMERA_MODELS = ("pinhole", "opencv", "opencv_fisheye")
WHITE = (255, 255, 255)


def capture_of(dataset: Mapping[str, Any]) -> Capture:
    """Convert a dataset whose images are all used for training.

    Its scene is static: nerfbaselines has no timestamps.

    Args:
      dataset: A `nerfbaselines.Dataset` with loaded images.

    Returns:
      The capture, with the center and scale of its scene units.

    Raises:
      CaptureError: If images differ in size, are not sRGB, or cameras cannot be used.
    """
    about = dataset["metadata"]
    where = "nerfbaselines dataset"
    if about.get("color_space", "srgb") != "srgb":
        raise CaptureError(
            f"{where}: color space {about['color_space']!r}; only srgb is supported, "
            "so convert the images"
        )
    sizes = np.unique(np.reshape(dataset["cameras"].image_sizes, (-1, 2)), axis=0)
    if len(sizes) != 1:
        raise CaptureError(
            f"{where}: images of {len(sizes)} sizes, from {sizes[0].tolist()} to "
            f"{sizes[-1].tolist()}; all images of a capture have one size, so resize "
            "or crop them"
        )
    size = (int(sizes[0][0]), int(sizes[0][1]))
    background = about.get("background_color")
    background = WHITE if background is None else tuple(map(int, background))
    images = np.stack([_opaque(x, size, background) for x in dataset["images"]])
    world = world_cameras(dataset["cameras"])
    cloud = _cloud(dataset)
    placement = _place(world, cloud, dataset["cameras"].nears_fars, size)
    masks = dataset.get("masks")
    root = dataset["image_paths_root"]
    has_alpha = any(np.shape(image)[-1] == 4 for image in dataset["images"])
    count = len(images)
    return Capture(
        name=str(about.get("scene") or about.get("id") or "nerfbaselines"),
        source="nerfbaselines",
        ids=tuple(os.path.relpath(path, root) for path in dataset["image_paths"]),
        images=images,
        cameras=in_scene_units(world, placement),
        times=np.zeros(count, np.float32),
        train=np.arange(count),
        heldout=np.zeros(0, np.int64),
        near=placement.near,
        far=placement.far,
        warp_ids=np.zeros(count, np.int32),
        appearance_ids=np.zeros(count, np.int32),
        camera_ids=np.zeros(count, np.int32),
        valid=None
        if masks is None
        else np.stack([np.asarray(m)[: size[1], : size[0]] > 0 for m in masks]),
        points=None
        if cloud is None
        else cloud._replace(
            position=(
                (cloud.position - np.array(placement.center)) * placement.scale
            ).astype(np.float32)
        ),
        background=tuple(c / 255 for c in background) if has_alpha else None,
        scale=placement.scale,
        center=placement.center,
    )


def world_cameras(cameras: Any) -> Camera:
    """Convert cameras, without their scale.

    Args:
      cameras: `nerfbaselines.Cameras`, one or [frames].

    Returns:
      Cameras in world units with float64 positions, [frames].

    Raises:
      CaptureError: If some cameras are fisheyes and some are not, or a model is
        unknown.
    """
    poses = np.reshape(cameras.poses, (-1, *np.shape(cameras.poses)[-2:]))
    poses = poses.astype(np.float64)
    fx, fy, cx, cy = np.reshape(cameras.intrinsics, (-1, 4)).astype(np.float32).T
    count = len(poses)
    models = np.reshape(cameras.camera_models, -1).astype(int)
    if models.max() >= len(CAMERA_MODELS):
        raise CaptureError(
            f"nerfbaselines camera model {models.max()} is not supported; undistort "
            f"the images, or use one of {', '.join(CAMERA_MODELS)}"
        )
    is_fisheye = models == CAMERA_MODELS.index("opencv_fisheye")
    if is_fisheye.any() != is_fisheye.all():
        raise CaptureError(
            f"{is_fisheye.sum()} of {count} cameras are fisheyes; undistort the images "
            "of those"
        )
    parameters = np.reshape(cameras.distortion_parameters, (count, -1))
    lens = np.zeros((count, 6), np.float32)  # k1 k2 p1 p2 k3 k4
    lens[:, : min(parameters.shape[1], 6)] = parameters[:, :6]
    lens[models == 0] = 0
    radial = np.zeros((count, 3), np.float32)
    if not is_fisheye.any():
        radial[:, :2] = lens[:, :2]  # its opencv model ignores k3
    leaves: dict[str, Any] = {
        "camera_from_world": np.swapaxes(poses[:, :3, :3], 1, 2).astype(np.float32),
        "position": poses[:, :3, 3],
        "focal_px": fx,
        "principal_point_px": np.stack([cx, cy], axis=-1),
        "skew_px": np.zeros(count, np.float32),
        "pixel_aspect": fy / fx,
        "radial": radial,
        "tangential": lens[:, 2:4],
    }
    if is_fisheye.any():
        leaves["tangential"] = np.zeros((count, 2), np.float32)
        leaves["fisheye"] = lens[:, [0, 1, 4, 5]]
    return Camera(**leaves)


def in_scene_units(cameras: Camera, placement: Placement | Capture) -> Camera:
    """Move cameras from world to scene units.

    Args:
      cameras: Cameras in world units, [frames].
      placement: Center and scale of the scene units.

    Returns:
      The cameras in float32.
    """
    position = (cameras.position - np.array(placement.center)) * placement.scale
    return cameras._replace(position=position.astype(np.float32))


def _opaque(image, size, background):
    """Crop padding, and blend an image with alpha onto the background."""
    image = np.asarray(image)[: size[1], : size[0]]
    if image.dtype != np.uint8:
        image = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    if image.shape[-1] == 3:
        return image
    color, alpha = image[..., :3].astype(np.float32), image[..., 3:] / np.float32(255)
    return np.round(color * alpha + np.float32(background) * (1 - alpha)).astype("u1")


def _cloud(dataset):
    position = dataset.get("points3D_xyz")
    if position is None or len(position) < 3:
        return None
    color = dataset.get("points3D_rgb")
    if color is None:
        color = np.full(np.shape(position), world_points.UNSEEN, np.uint8)
    return PointCloud(np.asarray(position, np.float64), np.asarray(color, np.uint8))


def _place(cameras, cloud, nears_fars, size):
    if cloud is not None:
        local, position = world_points.near_origin(cameras, cloud.position)
        depths = []
        for row in range(len(cameras.focal_px)):
            _, depth, inside = world_points.pixels_of(local, row, position, size)
            depths.append(depth[inside])
        if sum(map(len, depths)):
            depth = np.concatenate(depths)
            return points.place_by_points(cloud.position, cameras.position, depth)
    placement = points.place_by_cameras(cameras)
    if nears_fars is None:
        return placement
    near, far = np.min(nears_fars), np.max(nears_fars)
    if not 0 < near < far:
        return placement
    return placement._replace(
        near=float(near * placement.scale), far=float(far * placement.scale)
    )


# Cameras in a checkpoint --------------------------------------------------------------


def save_cameras(path: pathlib.Path, capture: Capture) -> None:
    """Write what a model needs to know of its capture, without the images.

    Args:
      path: File to write (.npz).
      capture: The capture.
    """
    arrays = {f"camera.{k}": v for k, v in capture.cameras._asdict().items()}
    if capture.points is not None:
        arrays |= {f"points.{k}": v for k, v in capture.points._asdict().items()}
    arrays |= {"ids": np.array(capture.ids), "size": np.array(capture.size)}
    for name in ("near", "far", "scale", "center", "background"):
        arrays[name] = getattr(capture, name)
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


def load_cameras(path: pathlib.Path) -> Capture:
    """Read what `save_cameras` wrote.

    Args:
      path: The file.

    Returns:
      The capture, with black images.
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)

    def group(kind: Any, prefix: str) -> Any:
        names: Sequence[str] = kind._fields
        return kind(**{name: arrays.get(f"{prefix}.{name}") for name in names})

    width, height = arrays["size"].tolist()
    count = len(arrays["ids"])
    zeros = np.zeros(count, np.int32)
    background = arrays.get("background")
    return Capture(
        name=path.stem,
        source="nerfbaselines",
        ids=tuple(arrays["ids"].tolist()),
        images=np.zeros((count, height, width, 3), np.uint8),
        cameras=camera.take(group(Camera, "camera"), np.arange(count)),
        times=np.zeros(count, np.float32),
        train=np.arange(count),
        heldout=np.zeros(0, np.int64),
        near=float(arrays["near"]),
        far=float(arrays["far"]),
        warp_ids=zeros,
        appearance_ids=zeros,
        camera_ids=zeros,
        points=group(PointCloud, "points") if "points.position" in arrays else None,
        background=None if background is None else tuple(background.tolist()),
        scale=float(arrays["scale"]),
        center=tuple(arrays["center"].tolist()),
    )
