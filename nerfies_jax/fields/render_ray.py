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
    """Compute the sum of the displacements of all warps, applied in order.

    Args:
      bound: The field with its parameters.
      point: Observed point in units of the field, [3].
      condition: Conditioning of the frame.

    Returns:
      Template point minus observed point in units of the field, [3].
    """
    return _displacement(bound, point, _with_point_codes(bound, point, condition))


def _with_point_codes(bound, point, condition):
    """Add the codes of an observed point to those of the frame."""
    codes = {}
    for effect in bound.effects:
        if effect.point_codes is not None:
            codes |= effect.point_codes(bound.own(effect), point, condition)
    return condition._replace(codes=condition.codes | codes) if codes else condition


def _displacement(bound, point, condition):
    total = jnp.zeros_like(point)
    for effect in bound.effects:
        if effect.displace is not None:
            params = bound.own(effect)
            total = total + effect.displace(params, point + total, condition)
    return total


def mean_flow(
    bound: Bound, point: Vector, condition: FrameCondition
) -> Float[Array, "2 3"]:
    """Compute the scene flow at a point over the next and the previous interval.

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
    effects = [effect for effect in bound.effects if effect.name == scene_flow.NAME]
    media = _media(bound, effects, ray, condition, samples, radiance)
    (medium,) = media.values()
    assert medium.share is not None  # a scene flow has a blending weight
    dynamic = (jax.nn.sigmoid(medium.share) * medium.density)[0]
    static = (jax.nn.sigmoid(-medium.share) * radiance.density)[0]
    is_occupied = dynamic + static > 0
    weight = jnp.where(
        is_occupied, dynamic / jnp.where(is_occupied, dynamic + static, 1), 0
    )
    names = ("flow_forward", "flow_backward")
    return weight * jnp.stack([medium.extras[name][0] for name in names])


class _Samples(NamedTuple):
    """Samples of one ray before the template is evaluated."""

    distance: Float[Array, " samples"]
    point: Float[Array, "samples 3"]
    warped: Float[Array, "samples 3"]
    trunk_features: tuple[Float[Array, "samples features"], ...]


def is_moved(effects: tuple[FieldRecord, ...]) -> bool:
    """Return whether the template is evaluated at displaced or ambient coordinates.

    Args:
      effects: The effects of a field.

    Returns:
      True if any effect displaces points or adds coordinates.
    """
    return any(
        effect.displace is not None or effect.trunk_features is not None
        for effect in effects
    )


def template_coordinates(
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
    canonical_point, condition = point, _with_point_codes(bound, point, condition)
    if any(effect.displace is not None for effect in bound.effects):
        canonical_point = point + _displacement(bound, point, condition)
    features = tuple(
        effect.trunk_features(bound.own(effect), point, condition)
        for effect in bound.effects
        if effect.trunk_features is not None
    )
    return canonical_point, features


def _samples(bound, ray, condition, distance):
    def one(distance):
        point = rays.point_at(ray.origin, ray.direction, distance)
        return _Samples(distance, point, *template_coordinates(bound, point, condition))

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
    those of the coarse samples. The published code evaluates them again, which is a
    third of its warps.

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
            normal = jax.random.normal(
                jax.random.fold_in(noise_key, number),
                samples.distance.shape,
                samples.distance.dtype,
            )
            noise = spec.density_noise * normal
        radiance, surfaces = _radiance(bound, name, ray, condition, samples, noise)
        media = _media(bound, media_of, ray, condition, samples, radiance)
        output = _composite(bound, ray, samples, radiance, media)
        return output._replace(surfaces=surfaces)

    # The coarse level only guides the samples, for which the static field suffices.
    with_media = [effect for effect in bound.effects if effect.medium is not None]
    if plan.fine == 0:
        return (level("fine", samples, with_media, 0),)
    first = "fine" if plan.shared else "coarse"
    coarse = level(first, samples, (), 0)
    new = sampling.refine(
        fine_key if plan.jitter else None, distance, coarse.weight, plan.fine
    )
    if not (plan.union and is_moved(bound.effects)):
        fine_distance = fine_distances(spec, bound.metadata, distance, new)
        fine_samples = _samples(bound, ray, condition, fine_distance)
    else:
        new_samples = _samples(bound, ray, condition, new)
        position = sampling.merged_places(distance, new)

        def merge(coarse_leaf, new_leaf):
            leaf = jnp.concatenate([coarse_leaf, new_leaf])
            return jnp.zeros_like(leaf).at[position].set(leaf)

        fine_samples = jax.tree.map(merge, samples, new_samples)
    return coarse, level("fine", fine_samples, with_media, 1)


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
    spec, params = template_of(bound.spec, name), bound.params["template"][name]
    inputs = []
    if isinstance(spec, TemplateSpec) and spec.direction is not None:
        inputs.append(encoding.encode(spec.direction, direction, None))
    inputs += [
        effect.condition(bound.own(effect), condition)
        for effect in bound.effects
        if effect.condition is not None
    ]
    features = jnp.concatenate([*inputs, jnp.zeros(0, direction.dtype)])
    if not isinstance(spec, TemplateSpec):
        return jnp.concatenate([direction, features])
    return template.color_offset(spec, params, features)


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
      place: Coordinates from `template_coordinates`.
      offset: `color_offset` of the ray.
      condition: Conditioning of the frame.
      noise: Noise added to the raw density, or None.

    Returns:
      Density and color.
    """
    canonical_point, extra = place
    spec, params = template_of(bound.spec, name), bound.params["template"][name]
    if not isinstance(spec, TemplateSpec):
        features = jnp.concatenate([*extra, jnp.zeros(0, canonical_point.dtype)])
        inputs = TemplateInputs(
            canonical_point, offset[:3], features, offset[3:], condition.step
        )
        density, color = spec.apply(params, inputs)
        return template.Radiance(density, color, jnp.zeros(0, canonical_point.dtype))
    point_features = template.encode(spec, params, canonical_point, condition.step)
    features = jnp.concatenate([point_features, *extra])
    raw, hidden = template.raw_density(spec, params, features)
    raw = raw if noise is None else raw + noise
    return template.add_color(spec, params, raw, hidden, offset)


def _radiance(bound, name, ray, condition, samples, noise):
    """Evaluate the template of one level and surface effects at samples of a ray."""
    offset = color_offset(bound, name, ray.direction, condition)
    surfaces = [effect for effect in bound.effects if effect.surface is not None]

    def evaluate(point, canonical_point, extra, noise):
        place = canonical_point, extra
        if surfaces:
            sample = point, place, offset
            return _surface_at(bound, name, surfaces, sample, condition, noise)
        return radiance_at(bound, name, place, offset, condition, noise), {}

    return jax.vmap(evaluate, (0, 0, 0, None if noise is None else 0))(
        samples.point, samples.warped, samples.trunk_features, noise
    )


def _surface_at(bound, name, surfaces, sample, condition, noise):
    """Evaluate `radiance_at` with the outputs of surface effects as inputs of color."""
    point, (canonical_point, extra), offset = sample
    spec, params = template_of(bound.spec, name), bound.params["template"][name]

    def density(params, canonical_point, extra):
        point_features = template.encode(spec, params, canonical_point, condition.step)
        return template.raw_density(
            spec, params, jnp.concatenate([point_features, *extra])
        )

    raw, hidden = density(params, canonical_point, extra)
    frozen = dataclasses.replace(bound, params=jax.lax.stop_gradient(bound.params))
    frozen_params, frozen_canonical, frozen_extra, frozen_point = jax.lax.stop_gradient(
        (params, canonical_point, extra, point)
    )

    def observed_normal(normal):
        def warp(point):
            return point + displacement(frozen, point, jax.lax.stop_gradient(condition))

        # The density in the observation is f(x) = F(x + d(x)), with the gradient JᵀF'.
        return jax.vjp(warp, frozen_point)[1](normal)[0]

    def template_normal():
        def raw_at(position):
            return density(frozen_params, position, frozen_extra)[0]

        return -jax.grad(raw_at)(frozen_canonical)

    surface = Surface(point, hidden, observed_normal, template_normal)
    outputs = {
        effect.name: effect.surface(bound.own(effect), name, surface, condition)
        for effect in surfaces
    }
    surface_features = jnp.concatenate([output.features for output in outputs.values()])
    raw = raw if noise is None else raw + noise
    radiance = template.add_color(spec, params, raw, hidden, offset, surface_features)
    return radiance, {name: output.values for name, output in outputs.items()}


def _media(bound, effects, ray, condition, samples, radiance) -> dict[str, Medium]:
    """Evaluate the media of effects at the samples of a ray, by name."""
    media = {}
    for effect in effects:

        def evaluate(point, features, effect=effect):
            sample = Sample(point, ray.direction, features)
            return effect.medium(bound.own(effect), sample, condition)

        media[effect.name] = jax.vmap(evaluate)(samples.point, radiance.features)
    return media


def _composite(bound, ray, samples, radiance, media):
    distance = samples.distance
    background = bound.metadata.background
    finite_spacing = compositing.intervals(
        distance, jnp.maximum(ray.far - distance[-1], 0)
    )
    spacing = finite_spacing
    if background is None:
        spacing = compositing.intervals(distance, compositing.AT_INFINITY)
    else:
        background = jnp.asarray(background, distance.dtype)
    static, of_media = radiance.density * spacing, []
    for medium in media.values():
        if medium.share is None:
            # It ends at the far plane. Over the interval behind it any density would be
            # opaque, at almost no price: transient objects would explain the sky.
            depth = medium.density * finite_spacing
        else:
            depth = compositing.scale_opacity(medium.density * spacing, medium.share)
            static = compositing.scale_opacity(static, -medium.share)
        of_media.append(depth)
    if media:
        depths = jnp.stack([static, *of_media])
        colors = [radiance.color, *(medium.color for medium in media.values())]
        weights = compositing.media_weights(depths)
        result = compositing.composite_media(
            depths, jnp.stack(colors), distance, background
        )
    else:
        weights = compositing.weights(static)[None]
        result = compositing.composite(weights[0], radiance.color, distance, background)
    media_weight = dict(zip(media, weights[1:], strict=True))
    return RayOutput(
        distances=distance,
        point=samples.point,
        warped=samples.warped,
        static_weight=weights[0],
        media=media,
        media_weight=media_weight,
        color=result.color,
        alpha=result.alpha,
        distance=result.distance,
        median_distance=result.median_distance,
        beta=_uncertainty(bound, media, media_weight),
        spacing=spacing,
        background=background,
    )


def uncertainty_effect(
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
    provider = None
    for effect in effects:
        medium = media.get(effect.name)
        if medium is None or medium.beta is None:
            continue
        if effect.beta_min is None:
            raise ValueError(
                f"the medium of the effect {effect.name!r} has a beta, so the effect "
                "needs a beta_min, without which the loss is unbounded below; set it "
                "to a positive number, such as 0.03"
            )
        if provider is not None:
            raise ValueError(
                f"{provider.name!r} and {effect.name!r} both provide the uncertainty "
                "of the color of rays; set the beta of one medium to None"
            )
        provider = effect
    return provider


def _uncertainty(bound, media, media_weight):
    """Compute the uncertainty of a ray's color, None if no medium provides it."""
    effect = uncertainty_effect(bound.effects, media)
    if effect is None:
        return None
    weight, beta = media_weight[effect.name], media[effect.name].beta
    return transient.uncertainty(effect.beta_min, weight, beta)
