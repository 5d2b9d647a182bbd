"""Ray tracing of a synthetic scene: first hits, true motion and shading.

Functions take a single ray or point, and callers vmap them. `spec` is static under jit.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nerfies_jax.capture.images import linear_from_srgb
from nerfies_jax.capture.synthetic import motion, texture
from nerfies_jax.capture.synthetic.spec import SceneSpec, Thing
from nerfies_jax.geometry import camera as cameras
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.geometry.precision import exact_product

NOTHING = -1  # thing id of a ray that leaves the scene
# A surface occludes a point if it is nearer to the camera by more than this, in scene
# units. The error of float32 intersections is 1e-6 at grazing incidence, and a pixel at
# distance 0.7 is 4e-3 wide.
OCCLUSION_DISTANCE = 2e-4


class Hit(NamedTuple):
    """First hit of a ray."""

    distance: Float[Array, ""]  # in lengths of the direction; infinite without a hit
    thing: Int[Array, ""]  # id, or NOTHING
    material: Float[Array, "3"]  # material point of the object
    normal: Float[Array, "3"]  # world unit normal that faces the viewer


def cast(
    spec: SceneSpec,
    origin: Float[Array, "3"],
    direction: Float[Array, "3"],
    time: Float[Array, ""],
    transient_shown: Bool[Array, ""],
) -> Hit:
    """Find the first object on a ray, in closed form except for sheets.

    Args:
      spec: The scene.
      origin: Origin of the ray in the world, [3].
      direction: Direction of any length, [3].
      time: Time in [0, 1].
      transient_shown: True if the transient object is present.

    Returns:
      The hit, at infinite distance for none.
    """
    zero = jnp.zeros_like(origin)
    best = Hit(
        jnp.full_like(time, jnp.inf), jnp.asarray(NOTHING, jnp.int32), zero, zero
    )
    for index, thing in enumerate(spec.all_things()):
        pose = motion.pose(thing.motion, thing.place, time)
        crossing = thing.shape.cross(
            motion.to_body(pose, origin),
            exact_product(pose.rotation.T, direction),
            time,
        )
        nearer = crossing.distance < best.distance
        if index == spec.transient_id:
            nearer = nearer & transient_shown
        normal = exact_product(pose.rotation, crossing.normal)
        hit = Hit(
            crossing.distance, jnp.asarray(index, jnp.int32), crossing.material, normal
        )
        best = jax.tree.map(
            lambda new, old, take=nearer: jnp.where(take, new, old), hit, best
        )
    facing = jnp.sum(best.normal * direction) <= 0
    return best._replace(normal=jnp.where(facing, best.normal, -best.normal))


def observe(
    spec: SceneSpec,
    thing: int,
    canonical_point: Float[Array, "3"],
    time: Float[Array, ""],
) -> Float[Array, "3"]:
    """Map a canonical point (its position at time 0) to its position at a time.

    Args:
      spec: The scene.
      thing: Id of the object.
      canonical_point: World point at time 0 on the object, or rigidly attached to it,
        [3].
      time: Time in [0, 1].

    Returns:
      World point at `time`, [3].
    """
    body = _thing(spec, thing)
    return _place(body, _material(body, canonical_point, jnp.zeros_like(time)), time)


def canonical(
    spec: SceneSpec,
    thing: int,
    observed_point: Float[Array, "3"],
    time: Float[Array, ""],
) -> Float[Array, "3"]:
    """Map a point observed at a time to its position at time 0.

    This is the exact inverse of `observe`.

    Args:
      spec: The scene.
      thing: Id of the object.
      observed_point: World point at `time`, [3].
      time: Time in [0, 1].

    Returns:
      World point at time 0, [3].
    """
    body = _thing(spec, thing)
    return _place(body, _material(body, observed_point, time), jnp.zeros_like(time))


def place(
    spec: SceneSpec,
    thing: Int[Array, ""],
    material: Float[Array, "3"],
    time: Float[Array, ""],
) -> Float[Array, "3"]:
    """Map a material point to the world.

    Args:
      spec: The scene.
      thing: Id of the object, traced.
      material: Material point, [3].
      time: Time in [0, 1].

    Returns:
      World point, [3].
    """
    world = jnp.zeros_like(material)
    for index, body in enumerate(spec.all_things()):
        world = jnp.where(thing == index, _place(body, material, time), world)
    return world


def shade(
    spec: SceneSpec,
    hit: Hit,
    direction: Float[Array, "3"],
    light_gain: Float[Array, "3"],
) -> Float[Array, "3"]:
    """Compute the linear light of a ray: Lambertian, ambient and specular.

    Args:
      spec: The scene.
      hit: First hit of the ray.
      direction: Direction of the ray, of any length, [3].
      light_gain: Gain of linear light for each channel, [3].

    Returns:
      Linear light, not clipped, [3].
    """
    dtype = direction.dtype
    toward_light = jnp.asarray(motion.unit_axis(spec.light), dtype)
    textures = [body.texture for body in spec.all_things()]
    base = texture.albedo(textures, jnp.maximum(hit.thing, 0), hit.material)
    lambert = jnp.maximum(jnp.sum(hit.normal * toward_light), 0)
    # Ambient light is stronger from above, which gives shaded surfaces some shading.
    sky = 0.75 + 0.25 * hit.normal[1]
    color = base * (spec.ambient * sky + (1 - spec.ambient) * lambert)
    if spec.specular is not None:
        is_specular = hit.thing == spec.id_of(spec.specular.thing)
        half = toward_light - direction / jnp.sqrt(jnp.sum(direction**2))
        cosine = jnp.sum(hit.normal * half) / jnp.sqrt(jnp.sum(half**2))
        lobe = jnp.maximum(cosine, 0) ** spec.specular.sharpness
        color = color + jnp.where(is_specular, spec.specular.strength * lobe, 0)
    background = jnp.asarray(linear_from_srgb(np.asarray(spec.background)), dtype)
    return light_gain * jnp.where(hit.thing == NOTHING, background, color)


def visible(
    spec: SceneSpec,
    camera: Camera,
    thing: Int[Array, ""],
    point: Float[Array, "3"],
    time: Float[Array, ""],
    transient_shown: Bool[Array, ""],
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:
    """Project a point of an object and test if the camera sees it.

    The test is exact: it casts a ray at the point instead of comparing depth images.

    Args:
      spec: The scene.
      camera: The camera.
      thing: Id of the object.
      point: World point of the object, [3].
      time: Time in [0, 1].
      transient_shown: True if the transient object is present.

    Returns:
      Pixel position [2], and True if the point is visible.
    """
    pixel, depth = cameras.project(camera, point)
    toward = point - camera.position
    hit = cast(spec, camera.position, toward, time, transient_shown)
    gap = (1 - hit.distance) * jnp.sqrt(jnp.sum(toward**2))
    width, height = spec.size
    bounds = jnp.asarray((width, height), pixel.dtype)
    inside = jnp.all((pixel >= 0) & (pixel <= bounds)) & (depth > 0)
    if spec.lens is not None:
        inside = inside & cameras.projectable(camera, point)
    return pixel, inside & (hit.thing == thing) & (jnp.abs(gap) < OCCLUSION_DISTANCE)


def _thing(spec: SceneSpec, index: int) -> Thing:
    things = spec.all_things()
    if not 0 <= index < len(things):
        raise ValueError(
            f"thing {index} is not in the scene; ids are 0 to {len(things) - 1}"
        )
    return things[index]


def _place(thing: Thing, material, time):
    pose = motion.pose(thing.motion, thing.place, time)
    return motion.to_world(pose, thing.shape.deform(material, time))


def _material(thing: Thing, world, time):
    pose = motion.pose(thing.motion, thing.place, time)
    return thing.shape.undeform(motion.to_body(pose, world), time)
