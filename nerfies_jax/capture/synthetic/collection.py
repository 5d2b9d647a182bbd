"""A photo collection: scattered cameras, and an appearance for each photograph."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from nerfies_jax.capture.images import linear_from_srgb
from nerfies_jax.capture.synthetic import trace
from nerfies_jax.capture.synthetic.spec import SceneSpec
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_product

# sRGB of skies at the horizon and at the zenith: clear, overcast, dusk, pale, evening.
SKIES = np.array(
    [
        [[0.75, 0.85, 0.95], [0.25, 0.45, 0.80]],
        [[0.80, 0.81, 0.82], [0.60, 0.62, 0.65]],
        [[0.95, 0.65, 0.40], [0.35, 0.35, 0.60]],
        [[0.95, 0.95, 0.92], [0.75, 0.83, 0.90]],
        [[0.55, 0.45, 0.55], [0.10, 0.13, 0.30]],
    ]
)
BASE_GAIN = 0.7  # of all light, so that the brightest photographs saturate little
STRIPES = 4.0  # of a board, per half height


class Photo(NamedTuple):
    """Appearance of one photograph beyond the gain of its light, and its board."""

    horizon: Float[Array, "3"]  # linear light
    zenith: Float[Array, "3"]  # linear light
    clouds: Float[Array, "4"]  # amount, and phases along three axes
    gamma: Float[Array, ""]  # exponent of sRGB values
    contrast: Float[Array, ""]  # weight of an S-shaped tone curve, in [0, 1]
    board_shown: Bool[Array, ""]
    board_center: Float[Array, "2"]  # slopes in camera coordinates
    board_half: Float[Array, "2"]  # half sides, in slopes
    board_depth: Float[Array, ""]  # z-depth, scene units
    board_light: Float[Array, "2 3"]  # linear light of its stripes


class Photographs(NamedTuple):
    """Cameras and appearances, in NumPy, with one row per photograph."""

    cameras: Camera
    light_gain: np.ndarray  # [photographs, 3] float32
    photo: Photo


def photographs(spec: SceneSpec, same_as: np.ndarray, seed: int) -> Photographs:
    """Draw the photographs of a collection.

    Args:
      spec: The scene, with a `collection`.
      same_as: For each photograph, the index of its appearance. The first
        `spec.frames` photographs have an appearance of their own. The others, for
        evaluation, have a known one and no board.
      seed: Seed of cameras and appearances.

    Returns:
      The photographs.
    """
    setting = spec.collection
    assert setting is not None
    rng = np.random.default_rng([seed, 7])
    views = cameras.stack([_camera(spec, setting, rng) for _ in same_as])
    gain, photo = _appearances(setting, spec.frames, rng)
    photo = Photo(*(leaf[same_as] for leaf in photo))
    photo = photo._replace(**_boards(spec, setting, views, rng))
    return Photographs(views, gain[same_as], photo)


def _camera(spec, setting, rng):
    low, high = setting.distance
    ratio = low * (high / low) ** rng.uniform()
    distance = ratio * setting.object_size
    azimuth = rng.uniform(-setting.arc_rad, setting.arc_rad)
    elevation = rng.uniform(*setting.elevation_rad)
    back = spherical_direction(azimuth, elevation)
    target = np.asarray(setting.target)
    aim = target + setting.object_size * rng.uniform(-0.15, 0.15, 3)
    # The object fills this share of the width, as far as lenses allow.
    fill = rng.uniform(*setting.fill)
    focal_px = spec.size[0] * np.clip(fill * ratio, *setting.focal_widths)
    up = np.array([0.0, 1.0, 0.0])
    return cameras.look_at(target + distance * back, aim, up, focal_px, spec.size)


def spherical_direction(azimuth, elevation) -> np.ndarray:
    """Return the direction from a target to a camera.

    Args:
      azimuth: Angle about the y axis in rad, zero along z, [...].
      elevation: Angle above the xz plane in rad, [...].

    Returns:
      Unit vectors, [..., 3].
    """
    x = np.sin(azimuth) * np.cos(elevation)
    z = np.cos(azimuth) * np.cos(elevation)
    return np.stack([x, np.sin(elevation), z], axis=-1)


def _appearances(setting, count, rng):
    stops = rng.uniform(-setting.stops, setting.stops, count)
    tint = np.exp2(rng.uniform(-setting.tint_stops, setting.tint_stops, (count, 2)))
    channels = np.stack([tint[:, 0], np.ones(count), tint[:, 1]], -1)
    gain = BASE_GAIN * np.exp2(stops)[:, None] * channels
    sky = SKIES[rng.integers(len(SKIES), size=count)]
    sky = np.clip(sky * rng.uniform(0.85, 1.1, (count, 1, 3)), 0, 1)
    horizon, zenith = np.moveaxis(linear_from_srgb(sky), 1, 0)
    amount = rng.uniform(0, 0.5, (count, 1))
    phase = rng.uniform(0, 2 * np.pi, (count, 3))
    photo = Photo(
        horizon=_single(horizon),
        zenith=_single(zenith),
        clouds=_single(np.concatenate([amount, phase], axis=1)),
        gamma=_single(np.exp2(rng.uniform(-setting.tone, setting.tone, count))),
        contrast=_single(rng.uniform(0, 2 * setting.tone, count)),
        board_shown=np.zeros(count, bool),
        board_center=np.zeros((count, 2), np.float32),
        board_half=np.zeros((count, 2), np.float32),
        board_depth=np.zeros(count, np.float32),
        board_light=np.zeros((count, 2, 3), np.float32),
    )
    return _single(gain), photo


def _boards(spec, setting, views, rng):
    """Upright boards in front of the object, which reach the lower border."""
    count = len(views.focal_px)
    width, height = (side / views.focal_px for side in spec.size)
    distance = np.linalg.norm(views.position - np.asarray(setting.target), axis=1)
    half_width = width * rng.uniform(0.06, 0.14, count)
    top = height * rng.uniform(-0.2, 0.15, count)  # of the board, below the center
    half_height = (height / 2 - top) / 2 + 0.01 * height
    center = np.stack([width * rng.uniform(-0.4, 0.4, count), top + half_height], -1)
    light = linear_from_srgb(rng.uniform(0.05, 0.95, (count, 2, 3)))
    order = rng.permutation(spec.frames)
    has_board = np.isin(np.arange(count), order[: round(setting.boards * spec.frames)])
    return {
        "board_shown": has_board,
        "board_center": _single(center),
        "board_half": _single(np.stack([half_width, half_height], -1)),
        "board_depth": _single(distance * rng.uniform(0.25, 0.6, count)),
        "board_light": _single(light),
    }


def _single(array):
    return np.asarray(array, np.float32)


def in_front(
    spec: SceneSpec, photo: Photo, camera: Camera, direction, hit: trace.Hit
) -> trace.Hit:
    """Let the board of a photograph hide what is behind it.

    Args:
      spec: The scene.
      photo: The photograph.
      camera: Its camera.
      direction: World direction of the ray, of z-depth one, [3].
      hit: First hit of the scene.

    Returns:
      The first hit. The material point of a board has its coordinates relative to its
      half sides.
    """
    slope = exact_product(camera.camera_from_world, direction)[:2]
    place = (slope - photo.board_center) / photo.board_half
    in_view = photo.board_shown & jnp.all(jnp.abs(place) < 1)
    in_view = in_view & (photo.board_depth < hit.distance)
    board = trace.Hit(
        photo.board_depth,
        jnp.asarray(spec.transient_id, jnp.int32),
        jnp.concatenate([place, jnp.zeros_like(place[:1])]),
        -direction,
    )
    return trace.Hit(
        *(jnp.where(in_view, new, old) for new, old in zip(board, hit, strict=True))
    )


def shade(
    spec: SceneSpec, photo: Photo, direction, hit: trace.Hit, light, light_gain
) -> Float[Array, "3"]:
    """Replace the light of the background and of boards by that of a photograph.

    Args:
      spec: The scene.
      photo: The photograph.
      direction: World direction of the ray, [3].
      hit: First hit of the ray.
      light: Linear light of the scene, [3].
      light_gain: Gain of linear light for each channel, [3].

    Returns:
      Linear light, [3].
    """
    stripe = jnp.floor(STRIPES * hit.material[1]) % 2 == 0
    board = jnp.where(stripe, photo.board_light[0], photo.board_light[1])
    light = jnp.where(hit.thing == spec.transient_id, light_gain * board, light)
    sky = light_gain * _sky(photo, direction)
    return jnp.where(hit.thing == trace.NOTHING, sky, light)


def _sky(photo, direction):
    unit = direction / jnp.sqrt(jnp.sum(direction**2))
    height = jnp.sqrt(jnp.clip(unit[1], 0, 1))
    clear = photo.horizon + height * (photo.zenith - photo.horizon)
    phase = photo.clouds[1:]
    waves = jnp.sin(7 * unit[0] + 11 * unit[1] + phase[0])
    waves = waves + jnp.sin(13 * unit[0] - 17 * unit[1] + 5 * unit[2] + phase[1])
    waves = waves + jnp.sin(23 * unit[1] + 19 * unit[2] + phase[2])
    cover = photo.clouds[0] * jnp.clip(0.5 + waves / 3, 0, 1)
    return clear + cover * (photo.horizon - clear)


def develop(photo: Photo, image: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """Apply the tone curve of a photograph to sRGB values.

    Args:
      photo: The photograph.
      image: sRGB values in [0, 1].

    Returns:
      sRGB values in [0, 1].
    """
    # The gradient of a power is infinite at zero.
    curve = jnp.maximum(image, 1e-6) ** photo.gamma
    steep = curve * curve * (3 - 2 * curve)
    return curve + photo.contrast * (steep - curve)


def observed(spec: SceneSpec, thing: np.ndarray) -> np.ndarray | None:
    """Return the masks of a collection, without skies and boards.

    Args:
      spec: The scene.
      thing: Ids of objects, [photographs, height, width].

    Returns:
      True for pixels of the scene, or None if the collection has no masks.
    """
    if spec.collection is None or not spec.collection.masked:
        return None
    return (thing != trace.NOTHING) & (thing != spec.transient_id)
