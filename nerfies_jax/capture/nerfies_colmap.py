"""Points of the COLMAP model that a Nerfies directory was made from."""

import pathlib

import numpy as np

from nerfies_jax.capture.capture import CaptureError, PointCloud
from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.capture.nerfies_views import NerfiesViews

PLACES = ("colmap/sparse/0", "colmap/sparse", "colmap", "sparse/0", "sparse")
# A model of another world, or of cameras that were refined since, would put its points
# elsewhere: centers may differ by this share of their spread.
SAME_PLACE = 1e-3


def points_beside(
    path: pathlib.Path, views: NerfiesViews
) -> tuple[PointCloud | None, tuple[str, ...]]:
    """Find the model's points, if its cameras are those of the directory.

    Args:
      path: The directory.
      views: Its cameras.

    Returns:
      The points in scene units or None, and a note with the reason if a model was
      rejected.
    """
    folders = [
        path / place
        for place in PLACES
        if any((path / place / f"points3D.{kind}").is_file() for kind in ("bin", "txt"))
    ]
    if not folders:
        return None, ()
    from nerfies_jax.capture import colmap  # slow to load, and seldom needed

    try:
        model = colmap.read_model(folders[0])
    except (CaptureError, MissingExtra) as error:
        return None, (f"no points: {error}",)
    row_of = {name: row for row, name in enumerate(views.ids)}
    pairs = [
        (place, row_of[colmap.name_of(name)])
        for place, name in enumerate(model.names)
        if colmap.name_of(name) in row_of
    ]
    scene, rows = views.scene, np.array(pairs, int).reshape(-1, 2)
    place = views.cameras.position[rows[:, 1]].astype(np.float64)
    centers = (model.positions[rows[:, 0]] - np.array(scene.center)) * scene.scale
    off = np.linalg.norm(centers - place, axis=1)
    if not len(rows) or off.max() > SAME_PLACE * np.linalg.norm(np.ptp(place, axis=0)):
        note = f"{folders[0]} has other cameras: its points are left out"
        return None, (note,)
    position = (model.points - np.array(scene.center)) * scene.scale
    note = f"{len(position)} points taken from {folders[0]}"
    return PointCloud(position.astype(np.float32), model.colors), (note,)
