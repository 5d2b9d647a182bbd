"""Camera parameters from intrinsic and pose matrices, on the host in float64."""

from typing import Any

import numpy as np

from nerfies_jax.geometry.lens import CAMERA_MODELS, COEFFICIENTS

# Poses printed with four digits are orthonormal to 2e-4.
RIGID_WITHIN = 1e-3


def camera_fields(
    K: Any, camera_from_world: Any, distortion: Any, camera_model: str = "pinhole"
) -> dict[str, np.ndarray]:
    """Split matrices into the fields of a `Camera`.

    Args:
      K: Intrinsic matrices in pixels, [..., 3, 3].
      camera_from_world: World-to-camera transforms, [..., 4, 4] or [..., 3, 4].
      distortion: OpenCV's (k1, k2, p1, p2[, k3]), [..., 4] or [..., 5], of a fisheye
        (k1, k2, k3, k4), or None.
      camera_model: One of `lens.CAMERA_MODELS`.

    Returns:
      The fields by name, in float64, with the broadcast leading axes. Only a fisheye
      has the field "fisheye".

    Raises:
      ValueError: Where a shape is wrong, K is not an intrinsic matrix, the pose is not
        rigid or there is no such model.
    """
    if camera_model not in CAMERA_MODELS:
        raise ValueError(
            f"camera_model must be one of {CAMERA_MODELS}, got {camera_model!r}"
        )
    K = _numbers("K", K, ((3, 3),))
    pose = _numbers("camera_from_world", camera_from_world, ((4, 4), (3, 4)))
    lens = np.zeros(4)
    if distortion is not None:
        endings = tuple((count,) for count in COEFFICIENTS[camera_model])
        lens = _numbers("distortion", distortion, endings)
    try:
        batch = np.broadcast_shapes(K.shape[:-2], pose.shape[:-2], lens.shape[:-1])
    except ValueError:
        raise ValueError(
            f"leading axes of K {list(K.shape)}, camera_from_world {list(pose.shape)} "
            f"and distortion {list(lens.shape)} do not broadcast"
        ) from None
    _check_intrinsics(K)
    _check_pose(pose)
    rotation, translation = pose[..., :3, :3], pose[..., :3, 3]
    fisheye = {"fisheye": (lens, 1)} if camera_model == "fisheye" else {}
    lens = np.zeros(4) if fisheye else lens
    k3 = lens[..., 4:] if lens.shape[-1] == 5 else np.zeros_like(lens[..., :1])
    fields = {
        "camera_from_world": (rotation, 2),
        "position": (-np.einsum("...ji,...j->...i", rotation, translation), 1),
        "focal_px": (K[..., 0, 0], 0),
        "principal_point_px": (K[..., :2, 2], 1),
        "skew_px": (K[..., 0, 1], 0),
        "pixel_aspect": (K[..., 1, 1] / K[..., 0, 0], 0),
        "radial": (np.concatenate([lens[..., :2], k3], axis=-1), 1),
        "tangential": (lens[..., 2:4], 1),
        **fisheye,
    }
    return {
        name: np.broadcast_to(
            value, batch + value.shape[value.ndim - base_rank :]
        ).copy()
        for name, (value, base_rank) in fields.items()
    }


def _numbers(name, value, endings):
    array = np.asarray(value)
    if not any(array.shape[max(array.ndim - len(end), 0) :] == end for end in endings):
        expected_shape = " or ".join(
            f"[..., {', '.join(map(str, end))}]" for end in endings
        )
        raise ValueError(
            f"{name} has shape {list(array.shape)}, expected {expected_shape}"
        )
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be real numbers, got {array.dtype}")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} is not finite")
    return array


def _check_intrinsics(K):
    below = np.stack([K[..., 1, 0], K[..., 2, 0], K[..., 2, 1], K[..., 2, 2] - 1])
    if (below != 0).any():
        raise ValueError(
            "K must be upper triangular with last row (0, 0, 1); divide it by its last "
            f"entry, got {K.reshape(-1, 3, 3)[0].tolist()}"
        )
    if (K[..., 0, 0] <= 0).any() or (K[..., 1, 1] <= 0).any():
        raise ValueError(
            "the focal lengths K[0, 0] and K[1, 1] must be positive, got "
            f"{K[..., 0, 0].min():g} and {K[..., 1, 1].min():g}; axes are x right, y "
            "down, z forward"
        )


def _check_pose(pose):
    if pose.shape[-2] == 4 and (pose[..., 3, :] != (0, 0, 0, 1)).any():
        raise ValueError(
            "the last row of camera_from_world must be (0, 0, 0, 1), got "
            f"{pose[..., 3, :].reshape(-1, 4)[0].tolist()}; transpose it if its "
            "translation is in the last row"
        )
    rotation = pose[..., :3, :3]
    product = rotation @ np.swapaxes(rotation, -1, -2)
    drift = np.abs(product - np.eye(3)).max(initial=0)
    if drift > RIGID_WITHIN:
        raise ValueError(
            f"camera_from_world is not rigid: |R Rᵀ - 1| = {drift:.2g} > "
            f"{RIGID_WITHIN:g}; take scale and shear out of the pose"
        )
    if (np.linalg.det(rotation) < 0).any():
        raise ValueError(
            "camera_from_world is a reflection (determinant -1); axes are x right, y "
            "down, z forward"
        )
