"""One ray through a radiance field: sample, warp, ask the template, composite."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from nerfies_jax.effects import transient
from nerfies_jax.effects.effect import Effect, FrameCondition, Medium, RayOutput, Sample
from nerfies_jax.geometry import rays
from nerfies_jax.geometry.camera import Camera
from nerfies_jax.nets import encoding
from nerfies_jax.radiance import compositing, sampling, template
from nerfies_jax.scene_metadata import SceneMetadata
from nerfies_jax.spec import RadianceScene, template_of

PyTree = Any
Vector = Float[Array, "3"]
Scalar = Float[Array, ""]


class Ray(NamedTuple):
    """One ray in units of the field."""

    origin: Vector
    direction: Vector  # unit length
    near: Scalar  # distance
    far: Scalar


def field_ray(
    metadata: SceneMetadata, origin: Vector, direction: Vector, cosine: Scalar
) -> Ray:
    """A ray of the scene in the field's coordinates, between the near and far planes.

    The planes are z-depths, so a slanted ray is sampled further out.
    """
    centre = jnp.asarray(metadata.centre, origin.dtype)
    span = metadata.scale / cosine
    return Ray(
        (origin - centre) * metadata.scale,
        direction,
        metadata.near * span,
        metadata.far * span,
    )


def field_ray_through(
    metadata: SceneMetadata, camera: Camera, pixel: Float[Array, "2"]
) -> tuple[Ray, Scalar]:
    """The field's ray through one pixel position, and its z-depth per distance."""
    found = rays.pixel_ray(camera, pixel)
    cosine = rays.depth_per_distance(camera, found.direction)
    return field_ray(metadata, found.origin, found.direction, cosine), cosine


def displacement(
    effects: tuple[Effect, ...],
    params: PyTree,
    point: Vector,
    condition: FrameCondition,
) -> Vector:
    """Template point minus observed point: what all warps do, one after the other."""
    total = jnp.zeros_like(point)
    for effect in effects:
        if effect.displace is not None:
            own = params.get(effect.name)
            total = total + effect.displace(own, point + total, condition)
    return total


class _Samples(NamedTuple):
    """Samples of one ray before the template is asked."""

    distance: Float[Array, " samples"]
    point: Float[Array, "samples 3"]
    warped: Float[Array, "samples 3"]
    lifted: tuple[Float[Array, "samples features"], ...]


def _samples(effects, params, ray, condition, distance):
    def one(distance):
        point = rays.point_at(ray.origin, ray.direction, distance)
        warped = point
        if any(effect.displace is not None for effect in effects):
            warped = point + displacement(effects, params, point, condition)
        lifted = tuple(
            effect.lift(params.get(effect.name), point, condition)
            for effect in effects
            if effect.lift is not None
        )
        return _Samples(distance, point, warped, lifted)

    return jax.vmap(one)(distance)


def render_ray(
    spec: RadianceScene,
    metadata: SceneMetadata,
    effects: tuple[Effect, ...],
    params: PyTree,
    ray: Ray,
    condition: FrameCondition,
    key: Key[Array, ""] | None,
) -> tuple[RayOutput, ...]:
    """The levels of one ray, coarse to fine; without a key nothing is random.

    Warps and lifts are asked once per sample: the fine level takes those of the coarse
    samples over, which the published code computes again (a third of its warps).
    """
    plan = spec.sampling
    coarse_key, fine_key, noise_key = (
        (None,) * 3 if key is None else tuple(jax.random.split(key, 3))
    )
    distance = sampling.stratified(
        coarse_key if plan.jitter else None,
        ray.near,
        ray.far,
        plan.coarse,
        plan.spacing,
    )
    samples = _samples(effects, params, ray, condition, distance)

    def level(name, samples, last, number):
        noise = None
        if noise_key is not None and spec.density_noise > 0:
            drawn = jax.random.normal(
                jax.random.fold_in(noise_key, number),
                samples.distance.shape,
                samples.distance.dtype,
            )
            noise = spec.density_noise * drawn
        return _level(
            spec, metadata, effects, params, name, ray, condition, samples, last, noise
        )

    if plan.fine == 0:
        return (level("fine", samples, True, 0),)
    first = "fine" if plan.shared else "coarse"
    coarse = level(first, samples, False, 0)
    drawn = sampling.from_weights(
        fine_key if plan.jitter else None,
        (distance[1:] + distance[:-1]) / 2,
        coarse.weight[1:-1],
        plan.fine,
    )
    if all(effect.displace is None and effect.lift is None for effect in effects):
        both = _samples(
            effects, params, ray, condition, sampling.union(distance, drawn)
        )
    else:
        more = _samples(effects, params, ray, condition, drawn)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), samples, more)
        order = jnp.argsort(both.distance)
        both = jax.tree.map(lambda x: x[order], both)
    return coarse, level("fine", both, True, 1)


def _level(spec, metadata, effects, params, name, ray, condition, samples, last, noise):
    """One level of one ray: ask the template, composite with other media."""
    one = template_of(spec, name)
    colour_inputs = []
    if one.direction is not None:
        colour_inputs.append(encoding.encode(one.direction, ray.direction, None))
    colour_inputs += [
        effect.condition(params.get(effect.name), condition)
        for effect in effects
        if effect.condition is not None
    ]
    colour_inputs = jnp.concatenate([*colour_inputs, jnp.zeros(0, ray.direction.dtype)])
    net = params["template"][name]

    def ask(warped, lifted, noise):
        encoded = encoding.encode(one.position, warped, None)
        features = jnp.concatenate([encoded, *lifted])
        return template.apply(one, net, features, colour_inputs, noise)

    radiance = jax.vmap(ask, (0, 0, None if noise is None else 0))(
        samples.warped, samples.lifted, noise
    )
    media = {}
    for effect in effects:
        if effect.medium is None or not last:
            continue

        def at(point, features, effect=effect):
            sample = Sample(point, ray.direction, features)
            return effect.medium(params.get(effect.name), sample, condition)

        media[effect.name] = jax.vmap(at)(samples.point, radiance.features)
    return _composite(spec, metadata, ray, samples, radiance, media)


def _composite(spec, metadata, ray, samples, radiance, media: dict[str, Medium]):
    distance = samples.distance
    behind = metadata.background
    end = compositing.AT_INFINITY
    if behind is not None:
        end = jnp.maximum(ray.far - distance[-1], 0)
        behind = jnp.asarray(behind, distance.dtype)
    spacing = compositing.intervals(distance, end)
    static, others = radiance.density * spacing, []
    for medium in media.values():
        depth = medium.density * spacing
        if medium.share is not None:
            depth = compositing.thinned(depth, medium.share)
            static = compositing.thinned(static, -medium.share)
        others.append(depth)
    if media:
        depths = jnp.stack([static, *others])
        colours = [radiance.colour, *(medium.colour for medium in media.values())]
        weights = compositing.media_weights(depths)
        whole = compositing.composite_media(
            depths, jnp.stack(colours), distance, behind
        )
    else:
        weights = compositing.weights(static)[None]
        whole = compositing.composite(weights[0], radiance.colour, distance, behind)
    beta = None
    for medium, weight in zip(media.values(), weights[1:], strict=True):
        if medium.beta is not None:
            beta = transient.uncertainty(spec.transient.beta_min, weight, medium.beta)
    return RayOutput(
        distances=distance,
        point=samples.point,
        warped=samples.warped,
        static_weight=weights[0],
        media=media,
        media_weight=dict(zip(media, weights[1:], strict=True)),
        colour=whole.colour,
        alpha=whole.alpha,
        distance=whole.distance,
        median_distance=whole.median_distance,
        beta=beta,
    )
