"""Points of the COLMAP model that a Nerfies directory was made from."""

import pathlib

import numpy as np

from nerfies_jax.capture.capture import CaptureError, PointCloud
from nerfies_jax.capture.extras import MissingExtra
from nerfies_jax.capture.nerfies_views import NerfiesViews

PLACES = ("colmap/sparse/0", "colmap/sparse", "colmap", "sparse/0", "sparse")
# Largest distance between camera centers as a share of their spread. The points of a
# model in other coordinates, or with cameras that were refined later, would not fit.
SAME_PLACE = 1e-3


def points_beside(
    path: pathlib.Path, views: NerfiesViews
) -> tuple[PointCloud | None, tuple[str, ...]]:
    """Read the points of the COLMAP model, if its cameras are those of the directory.

    Args:
      path: The directory.
      views: Its cameras.

    Returns:
      The points in scene units or None, and a note with the reason if a model was
      rejected.
    """
    folders = [
        path / name
        for name in PLACES
        if any((path / name / f"points3D.{kind}").is_file() for kind in ("bin", "txt"))
    ]
    if not folders:
        return None, ()
    from nerfies_jax.capture import colmap  # slow to import and rarely needed

    try:
        model = colmap.read_model(folders[0])
    except (CaptureError, MissingExtra) as error:
        return None, (f"no points: {error}",)
    row_of = {name: row for row, name in enumerate(views.ids)}
    pairs = [
        (model_row, row_of[colmap.name_of(name)])
        for model_row, name in enumerate(model.names)
        if colmap.name_of(name) in row_of
    ]
    scene, rows = views.scene, np.array(pairs, int).reshape(-1, 2)
    expected_centers = views.cameras.position[rows[:, 1]].astype(np.float64)
    centers = (model.positions[rows[:, 0]] - np.array(scene.center)) * scene.scale
    distance = np.linalg.norm(centers - expected_centers, axis=1)
    spread = np.linalg.norm(np.ptp(expected_centers, axis=0))
    if not len(rows) or distance.max() > SAME_PLACE * spread:
        note = f"{folders[0]} has other cameras: its points are not used"
        return None, (note,)
    position = (model.points - np.array(scene.center)) * scene.scale
    note = f"{len(position)} points taken from {folders[0]}"
    return PointCloud(position.astype(np.float32), model.colors), (note,)
