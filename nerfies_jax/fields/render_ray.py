"""Rendering of one ray of a radiance field: sample, warp, evaluate, composite."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from nerfies_jax.capture.scene_metadata import SceneMetadata
from nerfies_jax.fields import compositing, occupancy, sampling, template
from nerfies_jax.fields.effects import scene_flow, transient
from nerfies_jax.fields.effects.effect import Medium, RayOutput, Sample, Surface
from nerfies_jax.fields.effects.protocols import TemplateInputs
from nerfies_jax.fields.effects.records import FieldRecord
from nerfies_jax.fields.field_ray import Ray, fine_distances, first_distances
from nerfies_jax.fields.spec import RadianceScene, template_of
from nerfies_jax.fields.template import TemplateSpec
from nerfies_jax.geometry import rays
from nerfies_jax.nn import encoding
from nerfies_jax.training.effects import FrameCondition

PyTree = Any
Vector = Float[Array, "3"]
Scalar = Float[Array, ""]
Features = Float[Array, " _"]


@dataclasses.dataclass(frozen=True)
class Bound:
    """A field with its parameters, shared by all rays."""

    spec: RadianceScene
    metadata: SceneMetadata
    effects: tuple[FieldRecord, ...]
    params: PyTree

    def own(self, effect: FieldRecord) -> PyTree:
        """Return the parameters of one effect.

        Args:
          effect: The effect.

        Returns:
          Its parameters, None without any.
        """
        return self.params.get(effect.name)


def displacement(bound: Bound, point: Vector, condition: FrameCondition) -> Vector:
    """Compute template point minus observed point, the sum of all warps in order.

    Args:
      bound: The field with its parameters.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      The displacement in units of the field, [3].
    """
    return _displaced(bound, point, _marked(bound, point, condition))


def _marked(bound, point, condition):
    """Add the codes of an observed point to those of the frame."""
    marks = {}
    for effect in bound.effects:
        if effect.mark is not None:
            marks |= effect.mark(bound.own(effect), point, condition)
    return condition._replace(codes=condition.codes | marks) if marks else condition


def _displaced(bound, point, condition):
    total = jnp.zeros_like(point)
    for effect in bound.effects:
        if effect.displace is not None:
            moved = effect.displace(bound.own(effect), point + total, condition)
            total = total + moved
    return total


def mean_flow(
    bound: Bound, point: Vector, condition: FrameCondition
) -> Float[Array, "2 3"]:
    """Compute the scene flow at a point, to the next and the previous interval.

    It is the mean of the flow of the medium and of the static scene, weighted by their
    opacity at the point.

    Args:
      bound: The field with its parameters.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      Displacements in units of the field [2, 3], zero in empty space.
    """
    ray = Ray(point, jnp.asarray((0, 0, 1), point.dtype), *jnp.zeros(2, point.dtype))
    samples = _samples(bound, ray, condition, jnp.zeros(1, point.dtype))
    radiance, _ = _radiance(bound, "fine", ray, condition, samples, None)
    flowing = [effect for effect in bound.effects if effect.name == scene_flow.NAME]
    media = _media(bound, flowing, ray, condition, samples, radiance)
    (medium,) = media.values()
    assert medium.share is not None  # as that of a scene flow has
    moving = (jax.nn.sigmoid(medium.share) * medium.density)[0]
    static = (jax.nn.sigmoid(-medium.share) * radiance.density)[0]
    there = moving + static > 0
    share = jnp.where(there, moving / jnp.where(there, moving + static, 1), 0)
    names = ("flow_forward", "flow_backward")
    return share * jnp.stack([medium.extras[name][0] for name in names])


class _Samples(NamedTuple):
    """Samples of one ray before the template is evaluated."""

    distance: Float[Array, " samples"]
    point: Float[Array, "samples 3"]
    warped: Float[Array, "samples 3"]
    lifted: tuple[Float[Array, "samples features"], ...]


def is_moved(effects: tuple[FieldRecord, ...]) -> bool:
    """Return whether the template is evaluated at displaced or ambient coordinates.

    Args:
      effects: The effects of a field.

    Returns:
      True if any effect displaces points or adds coordinates.
    """
    return any(e.displace is not None or e.lift is not None for e in effects)


def asked_at(
    bound: Bound, point: Vector, condition: FrameCondition
) -> tuple[Vector, tuple[Features, ...]]:
    """Return the coordinates at which the template is evaluated for an observed point.

    Args:
      bound: The field with its parameters.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      The displaced point [3], and the features of each effect that adds coordinates.
    """
    warped, condition = point, _marked(bound, point, condition)
    if any(effect.displace is not None for effect in bound.effects):
        warped = point + _displaced(bound, point, condition)
    lifted = tuple(
        effect.lift(bound.own(effect), point, condition)
        for effect in bound.effects
        if effect.lift is not None
    )
    return warped, lifted


def _samples(bound, ray, condition, distance):
    def one(distance):
        point = rays.point_at(ray.origin, ray.direction, distance)
        return _Samples(distance, point, *asked_at(bound, point, condition))

    return jax.vmap(one)(distance)


def render_ray(
    bound: Bound,
    ray: Ray,
    condition: FrameCondition,
    key: Key[Array, ""] | None,
    guide: occupancy.Cells | None = None,
) -> tuple[RayOutput, ...]:
    """Render all levels of one ray.

    Warps and ambient coordinates are evaluated once per sample. The fine level reuses
    those of the coarse samples, which the published code computes again (a third of its
    warps).

    Args:
      bound: The field with its parameters.
      ray: The ray in units of the field.
      condition: Conditioning of the frame.
      key: PRNG key. Without a key nothing is random.
      guide: Occupied cells (`OccupancySpec`), or None.

    Returns:
      The output of each level, coarse to fine.
    """
    spec, plan = bound.spec, bound.spec.sampling
    coarse_key, fine_key, noise_key = (
        (None,) * 3 if key is None else tuple(jax.random.split(key, 3))
    )
    distance = first_distances(spec, ray, coarse_key if plan.jitter else None, guide)
    samples = _samples(bound, ray, condition, distance)

    def level(name, samples, media_of, number):
        noise = None
        if noise_key is not None and spec.density_noise > 0:
            drawn = jax.random.normal(
                jax.random.fold_in(noise_key, number),
                samples.distance.shape,
                samples.distance.dtype,
            )
            noise = spec.density_noise * drawn
        radiance, looks = _radiance(bound, name, ray, condition, samples, noise)
        media = _media(bound, media_of, ray, condition, samples, radiance)
        seen = _composite(bound, ray, samples, radiance, media)
        return seen._replace(looks=looks)

    # Media are on the last level only: one that guides the samples needs no more.
    last = [effect for effect in bound.effects if effect.medium is not None]
    if plan.fine == 0:
        return (level("fine", samples, last, 0),)
    first = "fine" if plan.shared else "coarse"
    coarse = level(first, samples, (), 0)
    drawn = sampling.refine(
        fine_key if plan.jitter else None, distance, coarse.weight, plan.fine
    )
    if not (plan.union and is_moved(bound.effects)):
        every = fine_distances(spec, bound.metadata, distance, drawn)
        both = _samples(bound, ray, condition, every)
    else:
        more = _samples(bound, ray, condition, drawn)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), samples, more)
        place = sampling.merged_places(distance, drawn)
        both = jax.tree.map(lambda x: jnp.zeros_like(x).at[place].set(x), both)
    return coarse, level("fine", both, last, 1)


def color_offset(
    bound: Bound, name: str, direction: Vector, condition: FrameCondition
) -> Features:
    """Compute the contribution of a ray to the color branch of one level.

    Args:
      bound: The field with its parameters.
      name: Name of the level.
      direction: Unit direction of the ray, [3].
      condition: Conditioning of the frame.

    Returns:
      The contribution, as of `template.color_offset`. With a template of another
      package, the direction and the features of the ray.
    """
    one, net = template_of(bound.spec, name), bound.params["template"][name]
    inputs = []
    if isinstance(one, TemplateSpec) and one.direction is not None:
        inputs.append(encoding.encode(one.direction, direction, None))
    inputs += [
        effect.condition(bound.own(effect), condition)
        for effect in bound.effects
        if effect.condition is not None
    ]
    read = jnp.concatenate([*inputs, jnp.zeros(0, direction.dtype)])
    if not isinstance(one, TemplateSpec):
        return jnp.concatenate([direction, read])
    return template.color_offset(one, net, read)


def radiance_at(
    bound: Bound,
    name: str,
    place: tuple[Vector, tuple[Features, ...]],
    offset: Features,
    condition: FrameCondition,
    noise: Scalar | None = None,
) -> template.Radiance:
    """Evaluate the template of one level.

    Args:
      bound: The field with its parameters.
      name: Name of the level.
      place: Coordinates from `asked_at`.
      offset: `color_offset` of the ray.
      condition: Conditioning of the frame.
      noise: Noise added to the raw density, or None.

    Returns:
      Density and color.
    """
    warped, lifted = place
    one, net = template_of(bound.spec, name), bound.params["template"][name]
    if not isinstance(one, TemplateSpec):
        features = jnp.concatenate([*lifted, jnp.zeros(0, warped.dtype)])
        given = warped, offset[:3], features, offset[3:], condition.step
        density, color = one.apply(net, TemplateInputs(*given))
        return template.Radiance(density, color, jnp.zeros(0, warped.dtype))
    encoded = template.encode(one, net, warped, condition.step)
    features = jnp.concatenate([encoded, *lifted])
    raw, hidden = template.raw_density(one, net, features)
    raw = raw if noise is None else raw + noise
    return template.colored(one, net, raw, hidden, offset)


def _radiance(bound, name, ray, condition, samples, noise):
    """Template of one level at the samples of a ray, and surface features."""
    offset = color_offset(bound, name, ray.direction, condition)
    surfaces = [effect for effect in bound.effects if effect.surface is not None]

    def ask(point, warped, lifted, noise):
        place = warped, lifted
        if surfaces:
            seen = point, place, offset
            return _surface_at(bound, name, surfaces, seen, condition, noise)
        return radiance_at(bound, name, place, offset, condition, noise), {}

    return jax.vmap(ask, (0, 0, 0, None if noise is None else 0))(
        samples.point, samples.warped, samples.lifted, noise
    )


def _surface_at(bound, name, surfaces, seen, condition, noise):
    """Same as `radiance_at`, with the surface features of these effects."""
    point, (warped, lifted), offset = seen
    one, net = template_of(bound.spec, name), bound.params["template"][name]

    def density(net, warped, lifted):
        encoded = template.encode(one, net, warped, condition.step)
        return template.raw_density(one, net, jnp.concatenate([encoded, *lifted]))

    raw, hidden = density(net, warped, lifted)
    fixed = dataclasses.replace(bound, params=jax.lax.stop_gradient(bound.params))
    still = jax.lax.stop_gradient((net, warped, lifted))

    def turned(normal):
        def moved(point):
            return point + displacement(fixed, point, jax.lax.stop_gradient(condition))

        # The density in the observation is f(x) = F(x + d(x)), with the gradient JᵀF'.
        return jax.vjp(moved, still_point)[1](normal)[0]

    def outward():
        return -jax.grad(lambda place: density(still[0], place, still[2])[0])(still[1])

    still_point = jax.lax.stop_gradient(point)
    surface = Surface(point, hidden, turned, outward)
    looks = {
        effect.name: effect.surface(bound.own(effect), name, surface, condition)
        for effect in surfaces
    }
    more = jnp.concatenate([look.features for look in looks.values()])
    raw = raw if noise is None else raw + noise
    radiance = template.colored(one, net, raw, hidden, offset, more)
    return radiance, {name: look.found for name, look in looks.items()}


def _media(bound, effects, ray, condition, samples, radiance) -> dict[str, Medium]:
    """Media that these effects put on the ray, by name."""
    media = {}
    for effect in effects:

        def at(point, features, effect=effect):
            sample = Sample(point, ray.direction, features)
            return effect.medium(bound.own(effect), sample, condition)

        media[effect.name] = jax.vmap(at)(samples.point, radiance.features)
    return media


def _composite(bound, ray, samples, radiance, media):
    distance = samples.distance
    behind = bound.metadata.background
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
        colors = [radiance.color, *(medium.color for medium in media.values())]
        weights = compositing.media_weights(depths)
        whole = compositing.composite_media(depths, jnp.stack(colors), distance, behind)
    else:
        weights = compositing.weights(static)[None]
        whole = compositing.composite(weights[0], radiance.color, distance, behind)
    media_weight = dict(zip(media, weights[1:], strict=True))
    return RayOutput(
        distances=distance,
        point=samples.point,
        warped=samples.warped,
        static_weight=weights[0],
        media=media,
        media_weight=media_weight,
        color=whole.color,
        alpha=whole.alpha,
        distance=whole.distance,
        median_distance=whole.median_distance,
        beta=_uncertainty(bound, media, media_weight),
        spacing=spacing,
        background=behind,
    )


def says_beta(
    effects: tuple[FieldRecord, ...], media: Mapping[str, Medium]
) -> FieldRecord | None:
    """Find the effect whose medium provides the uncertainty of a ray's color.

    Args:
      effects: The effects of a field.
      media: Media by the name of their effect.

    Returns:
      The effect, or None.

    Raises:
      ValueError: If two media provide it, or the effect has no `beta_min`.
    """
    said_by = None
    for effect in effects:
        medium = media.get(effect.name)
        if medium is None or medium.beta is None:
            continue
        if effect.beta_min is None:
            raise ValueError(
                f"the medium of the effect {effect.name!r} has a beta, and the effect "
                "no beta_min: without a least uncertainty the loss is unbounded below; "
                "give the effect one, as 0.03"
            )
        if said_by is not None:
            raise ValueError(
                f"both {said_by.name!r} and {effect.name!r} say how uncertain a ray's "
                "color is; leave the beta of one medium None"
            )
        said_by = effect
    return said_by


def _uncertainty(bound, media, media_weight):
    """Uncertainty of the ray's color, or None if no medium provides it."""
    effect = says_beta(bound.effects, media)
    if effect is None:
        return None
    weight, beta = media_weight[effect.name], media[effect.name].beta
    return transient.uncertainty(effect.beta_min, weight, beta)
