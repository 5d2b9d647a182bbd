"""Cameras, schedule and rendering of a synthetic scene."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.capture.synthetic import collection, texture, trace
from nerfies_jax.capture.synthetic.collection import Photo
from nerfies_jax.capture.synthetic.spec import SceneSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry import lens, rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_product

TILE = 16  # pixels
SHAKE_HARMONICS = 6  # the fastest component has six periods per capture


class Schedule(NamedTuple):
    """Times, cameras and exposure of all frames, in NumPy."""

    time_index: np.ndarray  # int32
    camera_id: np.ndarray  # int32: 0 for the hand-held camera, 1 for the second
    time: np.ndarray  # float32 in [0, 1]
    learn: np.ndarray  # bool: True for training frames
    cameras: Camera
    light_gain: np.ndarray  # [frames, 3] float32 gain of linear light
    transient_shown: np.ndarray  # bool
    photo: Photo | None = None  # of a collection, one row per frame


class Frame(NamedTuple):
    """One rendered frame. Depth and hits are those of the pixel centers."""

    image: Float[Array, "height width 3"]  # sRGB in [0, 1], not rounded
    depth: Float[Array, "height width"]  # z-depth, scene units; 0 for the background
    hit: trace.Hit  # [height, width], along directions of z-depth one


def schedule(spec: SceneSpec, seed: int) -> Schedule:
    """Plan all frames: first those of the hand-held camera, then those of the second.

    The frames of each camera are in order of time.

    Args:
      spec: The scene.
      seed: Seed of the hand-held motion and the exposure.

    Returns:
      The schedule.
    """
    if spec.collection is not None:
        return _collection_schedule(spec, seed)
    if spec.snapshots is not None:
        return _snapshot_schedule(spec, seed)
    indices = np.arange(spec.frames)
    second_indices = indices[spec.heldout_every // 2 :: spec.heldout_every]
    time_index = np.concatenate([indices, second_indices])
    camera_id = np.repeat([0, 1], [len(indices), len(second_indices)])
    times = indices / (spec.frames - 1)
    learn = camera_id == 0
    if spec.skip_every is not None:
        learn &= time_index % spec.skip_every != spec.skip_every // 2
    arcs = [_arc(spec, times, seed, is_second) for is_second in (False, True)]
    views = cameras.stack(
        [arcs[c][i] for c, i in zip(camera_id, time_index, strict=True)]
    )
    views = _through_lens(spec, views)
    frame_times = times[time_index]
    transient_shown = np.zeros(len(time_index), bool)
    if spec.transient is not None:
        for start, stop in spec.transient.windows:
            in_window = (start <= frame_times) & (frame_times <= stop)
            transient_shown |= (camera_id == 0) & in_window
    return Schedule(
        time_index.astype(np.int32),
        camera_id.astype(np.int32),
        frame_times.astype(np.float32),
        learn,
        views,
        _light_gain(spec, times, seed)[time_index],
        transient_shown,
    )


def _collection_schedule(spec, seed):
    """Photographs, and views for evaluation with the appearance of some of them."""
    indices = np.arange(spec.frames)
    heldout = indices[spec.heldout_every // 2 :: spec.heldout_every]
    time_index = np.concatenate([indices, heldout]).astype(np.int32)
    photographs = collection.photographs(spec, time_index, seed)
    return Schedule(
        time_index=time_index,
        camera_id=np.arange(len(time_index), dtype=np.int32),
        time=(time_index / (spec.frames - 1)).astype(np.float32),
        learn=np.arange(len(time_index)) < spec.frames,
        cameras=photographs.cameras,
        light_gain=photographs.light_gain,
        transient_shown=np.asarray(photographs.photo.board_shown),
        photo=photographs.photo,
    )


def _snapshot_schedule(spec, seed):
    """Photographs with one camera, of which every n-th is held out."""
    indices = np.arange(spec.frames, dtype=np.int32)
    times = indices / (spec.frames - 1)
    return Schedule(
        time_index=indices,
        camera_id=np.zeros(spec.frames, np.int32),
        time=times.astype(np.float32),
        learn=indices % spec.heldout_every != 0,
        cameras=_through_lens(spec, _snapshot_views(spec, seed)),
        light_gain=_light_gain(spec, times, seed),
        transient_shown=np.zeros(spec.frames, bool),
    )


def _snapshot_views(spec, seed):
    """Cameras in the cells of a grid over azimuth and elevation, in random order."""
    setting = spec.snapshots
    rng = np.random.default_rng([seed, 8])
    grid = (setting.columns, setting.rows)
    cell = np.indices(grid).reshape(2, -1).T
    place = (cell + rng.uniform(size=cell.shape)) / grid
    azimuth = setting.arc_rad * (2 * place[:, 0] - 1)
    low, high = setting.elevation_rad
    elevation = low + (high - low) * place[:, 1]
    distance = rng.uniform(*setting.distance, len(cell))
    back = collection.spherical_direction(azimuth, elevation)
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


def render(
    spec: SceneSpec,
    camera: Camera,
    time: Float[Array, ""],
    light_gain: Float[Array, "3"],
    transient_shown: Bool[Array, ""],
    photo: Photo | None = None,
) -> Frame:
    """Render one frame in square tiles.

    The iterative intersection with sheets then runs only in tiles that may show one.

    Args:
      spec: The scene.
      camera: The camera.
      time: Time in [0, 1].
      light_gain: Gain of linear light for each channel, [3].
      transient_shown: True if the transient object is present.
      photo: Appearance of the frame, if it is a photograph of a collection.

    Returns:
      The frame.
    """

    def hit(direction):
        first = trace.cast(spec, camera.position, direction, time, transient_shown)
        if photo is None:
            return first
        return collection.in_front(spec, photo, camera, direction, first)

    def color(hit, direction):
        light = trace.shade(spec, hit, direction, light_gain)
        if photo is not None:
            light = collection.shade(spec, photo, direction, hit, light, light_gain)
        # Clipping each sample keeps saturated highlights from bleeding over edges.
        return jnp.clip(light, 0, 1)

    # The center is the last sample, so that a single program suffices.
    offsets = _sub_pixels(spec.supersampling, time.dtype)

    def tile(pixels):
        samples = pixels[:, None, :] + offsets
        directions = jax.vmap(
            jax.vmap(lambda pixel: view_direction(spec, camera, pixel))
        )(samples)
        hits = jax.vmap(jax.vmap(hit))(directions)
        color_hits = jax.tree.map(lambda leaf: leaf[:, :-1], hits)
        light = jax.vmap(jax.vmap(color))(color_hits, directions[:, :-1])
        center = jax.tree.map(lambda leaf: leaf[:, -1], hits)
        image = texture.srgb(jnp.mean(light, axis=1))
        if photo is not None:
            image = collection.develop(photo, image)
        return image, center

    tiles = jax.lax.map(tile, _tiles(spec.size, time.dtype))
    image, center = _untile(tiles, spec.size)
    # Directions have z-depth one, so the distance is the z-depth.
    depth = jnp.where(center.thing == trace.NOTHING, 0, center.distance)
    return Frame(image, depth, center)


def view_direction(
    spec: SceneSpec, camera: Camera, pixel: Float[Array, "2"]
) -> Float[Array, "3"]:
    """Return the world direction of a pixel, scaled to z-depth one.

    Without a lens there is no distortion, and no iterative undistortion is needed.

    Args:
      spec: The scene.
      camera: The camera.
      pixel: Pixel position (x, y) with centers at +0.5, [2].

    Returns:
      The direction, [3].
    """
    plane = (pixel - camera.principal_point_px) / camera.focal_px
    if spec.lens is not None:
        plane, _ = lens.undistort(camera, plane)
    in_camera = jnp.concatenate([plane, jnp.ones_like(plane[:1])])
    return exact_product(in_camera, camera.camera_from_world)


def _through_lens(spec, views):
    """Cameras with the lens distortion of the scene."""
    if spec.lens is None:
        return views
    terms = np.zeros((len(views.focal_px), 5), np.float32)
    terms[:, : len(spec.lens.coefficients)] = spec.lens.coefficients
    if spec.lens.model == "fisheye":
        return views._replace(fisheye=terms[:, :4])
    return views._replace(radial=terms[:, [0, 1, 4]], tangential=terms[:, 2:4])


def recorded_cameras(spec: SceneSpec, plan: Schedule, seed: int) -> Camera:
    """Return the cameras of the capture, with the pose error of the first camera.

    Args:
      spec: The scene.
      plan: The schedule with the true cameras.
      seed: Seed of the error.

    Returns:
      Cameras, [frames].
    """
    if spec.pose_error is None:
        return plan.cameras
    rng = np.random.default_rng([seed, 5])
    rotation, shift = rng.normal(size=(2, len(plan.time), 3)).astype(np.float32)
    focal_px = plan.cameras.focal_px[:, None]
    is_first = (plan.camera_id == 0)[:, None]
    rotation = is_first * spec.pose_error.turn_px / focal_px * rotation
    depth = spec.cameras.distance
    shift = is_first * depth * spec.pose_error.shift_px / focal_px * shift

    noisy_cameras = jax.jit(jax.vmap(cameras.move))(plan.cameras, rotation, shift)
    return jax.tree.map(
        lambda true, new: np.where(
            is_first.reshape(-1, *(1,) * (true.ndim - 1)),
            np.asarray(new, true.dtype),
            true,
        ),
        plan.cameras,
        noisy_cameras,
    )


def _sub_pixels(count, dtype):
    """Offsets of count x count equal cells from the pixel center, and a zero offset."""
    offsets = (np.arange(count) + 0.5) / count - 0.5
    grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    return jnp.asarray(np.concatenate([grid, np.zeros((1, 2))]), dtype)


def _tiles(size, dtype):
    """Pixel centers [tiles, TILE², 2] that cover an image, padded to whole tiles."""
    rows, columns = (-(-length // TILE) for length in size[::-1])
    centers = rays.pixel_centers((columns * TILE, rows * TILE), dtype)
    tiles = centers.reshape(rows, TILE, columns, TILE, 2).swapaxes(1, 2)
    return tiles.reshape(rows * columns, TILE**2, 2)


def _untile(tree, size):
    """Arrays [tiles, TILE², ...] as [height, width, ...], without the padding."""
    width, height = size
    rows, columns = (-(-length // TILE) for length in (height, width))

    def untile(leaf):
        channels = leaf.shape[2:]
        leaf = leaf.reshape(rows, columns, TILE, TILE, *channels).swapaxes(1, 2)
        return leaf.reshape(rows * TILE, columns * TILE, *channels)[:height, :width]

    return jax.tree.map(untile, tree)


def _arc(spec, times, seed, is_second):
    """The first or second camera at each time."""
    setting = spec.cameras
    rng = np.random.default_rng([seed, 1])
    shake = setting.shake * _smooth_noise(rng, times, 6)
    sweep = 2 * np.pi * setting.sweeps * times
    angle = setting.arc_rad * np.sin(sweep)
    distance = setting.distance - setting.forward * np.sin(sweep / 2) ** 2
    if spec.rig is not None:
        shake = np.zeros_like(shake)
        angle = np.array(spec.rig.angles(len(times)))
        distance = np.full(len(times), setting.distance)
    target = np.asarray(setting.target) + shake[:, 3:]
    right = np.stack([np.cos(angle), 0 * angle, -np.sin(angle)], -1)
    back = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    up = np.array([0.0, 1.0, 0.0])
    rise = (setting.height + 0.2 * setting.height * np.cos(sweep))[:, None] * up
    if spec.rig is not None:
        parity = np.array(spec.rig.turns(len(times))) % 2
        rise = (setting.height + spec.rig.rise * parity)[:, None] * up
    position = setting.target + distance[:, None] * back + rise + shake[:, :3]
    if is_second:
        offset_right, offset_up, offset_back = setting.beside
        position = position + offset_right * right + offset_up * up + offset_back * back
    if setting.pan_rad:
        target = position + _rotate(target - position, setting.pan_rad * np.sin(sweep))
    focal_px = spec.size[0] / 2 / np.tan(setting.field_of_view_rad / 2)
    focals_px = focal_px * setting.zoom ** np.sin(np.pi * times) ** 2
    return [
        cameras.look_at(eye, aim, up, focal, spec.size)
        for eye, aim, focal in zip(position, target, focals_px, strict=True)
    ]


def _rotate(vectors, angles):
    """Rotate vectors [n, 3] about the vertical by angles [n], in radians."""
    x, y, z = vectors.T
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=-1)


def _light_gain(spec, times, seed):
    gain = np.ones((len(times), 3), np.float32)
    if spec.exposure is None:
        return gain
    drift = _smooth_noise(np.random.default_rng([seed, 2]), times, 3)
    tint = spec.exposure.tint * drift[:, 1:]
    channels = np.stack([1 + tint[:, 0], np.ones(len(times)), 1 + tint[:, 1]], -1)
    return (gain * np.exp2(spec.exposure.stops * drift[:, :1]) * channels).astype(
        np.float32
    )


def _smooth_noise(rng, times, columns):
    """Random sums of sines [times, columns] with a mean square of one."""
    harmonics = np.arange(1, SHAKE_HARMONICS + 1)
    phase = rng.uniform(0, 2 * np.pi, (len(harmonics), columns))
    weight = np.sqrt(2 / np.sum(1.0 / harmonics**2)) / harmonics
    waves = np.sin(2 * np.pi * harmonics[:, None] * times[:, None, None] + phase)
    return np.einsum("h,thc->tc", weight, waves)
