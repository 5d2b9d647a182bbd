"""Cameras of photographs of a static scene, in no order."""

import numpy as np

from nerfies_jax.capture.synthetic.spec import SceneSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera


def views(spec: SceneSpec, seed: int) -> Camera:
    """Draw the cameras of all photographs.

    Args:
      spec: The scene, with `snapshots`.
      seed: Seed of the viewpoints and of their order.

    Returns:
      Cameras, [photographs].
    """
    setting = spec.snapshots
    assert setting is not None
    rng = np.random.default_rng([seed, 8])
    grid = (setting.columns, setting.rows)
    cell = np.indices(grid).reshape(2, -1).T
    place = (cell + rng.uniform(size=cell.shape)) / grid
    azimuth = setting.arc_rad * (2 * place[:, 0] - 1)
    low, high = setting.elevation_rad
    elevation = low + (high - low) * place[:, 1]
    distance = rng.uniform(*setting.distance, len(cell))
    back = np.stack(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
            np.cos(azimuth) * np.cos(elevation),
        ],
        axis=-1,
    )
    target = np.asarray(setting.target)
    aim = target + setting.aim * rng.uniform(-1, 1, back.shape)
    position = target + distance[:, None] * back
    order = rng.permutation(len(cell))
    focal_px = spec.size[0] / 2 / np.tan(setting.field_of_view_rad / 2)
    up = np.array([0.0, 1.0, 0.0])
    return cameras.stack(
        [
            cameras.look_at(position[row], aim[row], up, focal_px, spec.size)
            for row in order
        ]
    )
