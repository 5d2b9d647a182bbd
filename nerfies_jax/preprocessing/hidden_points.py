"""Extrapolated static points behind moving objects, which are visible in no image.

Regions occluded in every frame would be black holes from other viewpoints, or without
the object. The surrounding surfaces are continued behind it: inverse depth that is
linear in the pixels is a plane, which is fitted to known points around, except for
those in front of it, such as at an edge of the foreground.
"""

import numpy as np
from scipy.spatial import cKDTree

from nerfies_jax.capture.capture import PointCloud
from nerfies_jax.preprocessing import view_set
from nerfies_jax.preprocessing.view_set import Views

FRAMES = 12  # used frames, evenly spaced over the video
# In pixels of reduced images, more in larger images.
EVERY_PX = 2
# A pixel nearer to a known point shows this point. `dense_points` has one for every
# second pixel of each of twelve frames, fewer in regions with little texture.
KNOWN_PX = 6.0
AROUND = 32  # cells of that size with known points, around a pixel
BEFORE, ROUNDS = 0.03, 8  # relative depth by which points in front are excluded
# Ridge of the slopes relative to squared pixels, because points along one edge
# determine only one slope.
RIDGE_PX = 4.0


def behind(views: Views, static_cloud: PointCloud, moving: np.ndarray) -> PointCloud:
    """Place colored points on moving pixels far from any known point. Runs on the host.

    Each frame counts the points of the frames before as known. A frame in which points
    fill fewer than `AROUND` cells of `KNOWN_PX` adds none.

    Args:
      views: The frames.
      static_cloud: Known static points.
      moving: True for moving pixels, [frames, height, width].

    Returns:
      The additional points.
    """
    places, colors = np.asarray(static_cloud.position, np.float64), static_cloud.color
    first = len(places)
    frames = np.linspace(0, len(views.row) - 1, min(FRAMES, len(views.row)))
    for frame in np.unique(frames.round().astype(int)).tolist():
        place, color = _seen_from(views, frame, places, colors, moving[frame])
        places, colors = np.concatenate([places, place]), np.append(colors, color, 0)
    return PointCloud(places[first:].astype(np.float32), colors[first:])


def _seen_from(views, frame, places, colors, moving):
    larger = view_set.times_smaller(views)
    cell_px, every = KNOWN_PX * larger, EVERY_PX * larger
    row, column = np.nonzero((moving & views.valid[frame])[::every, ::every])
    row, column = every * row, every * column
    at = np.stack([column, row], -1) + 0.5
    pixel, depth = view_set.project(views, frame, places)
    inside = view_set.in_image(views, pixel, depth, 0)
    no_points = np.zeros((0, 3)), colors[:0]
    if not inside.any() or not len(at):
        return no_points
    pixel, inverse, color = pixel[inside], 1 / depth[inside], colors[inside]
    is_hidden = cKDTree(pixel).query(at)[0] > cell_px
    at, row, column = at[is_hidden], row[is_hidden], column[is_hidden]
    thin = _farthest_in_cells(pixel / cell_px, inverse)
    if len(thin) < AROUND or not len(at):
        return no_points
    pixel, inverse, color = pixel[thin], inverse[thin], color[thin]
    distance, near = cKDTree(pixel).query(at, AROUND)
    near_inverse, offset = inverse[near], pixel[near] - at[:, None]
    least, most = near_inverse.min(1), near_inverse.max(1)
    near_by = weight = 1 / distance**2
    for _ in range(ROUNDS):
        guess, slope = _plane(offset, near_inverse, weight)
        plane = guess[:, None] + np.einsum("nkc,nc->nk", offset, slope)
        before = np.maximum(near_inverse / np.maximum(plane, least[:, None]) - 1, 0)
        weight = near_by / (1 + (before / BEFORE) ** 2) ** 2
    ray = view_set.rays(views, frame)[row, column]
    place = views.position[frame] + ray / np.clip(guess, least, most)[:, None]
    shade = color[near].astype(float)
    shade = [_plane(offset, shade[..., channel], weight)[0] for channel in range(3)]
    return place, np.clip(np.stack(shade, -1).round(), 0, 255).astype(np.uint8)


def _farthest_in_cells(place, inverse):
    """Select the farthest point of every cell that contains one."""
    cell = np.floor(place).astype(int)
    order = np.argsort(inverse, kind="stable")
    return order[np.unique(cell[order], axis=0, return_index=True)[1]]


def _plane(offset, value, weight):
    """Fit planes over `offset` [n, k, 2]. Return values at zero and gradients."""
    weight = weight / weight.sum(1, keepdims=True)
    middle = np.einsum("nk,nkc->nc", weight, offset)
    mean = np.einsum("nk,nk->n", weight, value)
    apart, above = offset - middle[:, None], value - mean[:, None]
    normal = np.einsum("nk,nkc,nkd->ncd", weight, apart, apart)
    right = np.einsum("nk,nkc,nk->nc", weight, apart, above)
    ridge = RIDGE_PX**2 * np.eye(2)
    slope = np.linalg.solve(normal + ridge, right[..., None])[..., 0]
    return mean - np.einsum("nc,nc->n", slope, middle), slope
