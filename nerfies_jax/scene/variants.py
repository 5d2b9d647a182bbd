"""Variants of a trained field: effects left out, appearances blended."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from nerfies_jax.capture.capture import Capture
from nerfies_jax.evaluation.representation import Parts, check_there
from nerfies_jax.fields.field import feeds_networks
from nerfies_jax.scene import scene
from nerfies_jax.training.effects import APPEARANCE
from nerfies_jax.training.model import Model, View


class Between(NamedTuple):
    """A view whose appearance lies between those of two frames."""

    view: View  # with the appearance at share 0
    toward: Int[Array, ""]  # appearance id at share 1
    share: Float[Array, ""]  # in [0, 1]


def parts(spec, metadata) -> Parts:
    """Return the effects that can be left out: those that displace points, and media.

    Args:
      spec: The scene.
      metadata: Scene metadata.

    Returns:
      The removable effects, and whether the field has appearance codes.
    """
    whole = scene.field(spec, metadata)
    # Effects whose outputs are inputs of networks cannot be removed. Losses are not
    # rendered.
    removable = tuple(
        effect.name
        for effect in whole.effects
        if (effect.displace is not None or effect.medium is not None)
        and not feeds_networks(effect)
    )
    return Parts(removable, _has_appearance(whole))


def _has_appearance(field):
    tables = [table for effect in field.effects for table in effect.tables]
    return any(table.by == APPEARANCE for table in tables)


def without_effects(
    spec,
    metadata,
    without: tuple[str, ...],
    with_blending: bool,
) -> Model:
    """Return the model with some effects left out, or with blended appearances.

    Args:
      spec: The scene.
      metadata: Scene metadata.
      without: Names of the effects to leave out.
      with_blending: True for a model that renders a `Between` in place of a view.

    Returns:
      The model.

    Raises:
      ValueError: If an effect is not removable, or there are no appearance codes to
        blend.
    """
    check_there(without, parts(spec, metadata).removable)
    field = scene.field(spec, metadata, without)
    if with_blending and not _has_appearance(field):
        raise ValueError(
            "this field has no appearance codes to blend; reconstruct with a preset "
            "that has them, such as nerf-w or nerfies"
        )

    def plain(params, view):
        return view, field.codes_at(params, view)

    def blend(params, between):
        view, share = between.view, between.share
        start = field.codes_at(params, view)
        end = field.codes_at(params, view._replace(appearance=between.toward))
        # Codes of the timestamp are the same at both ends and do not change.
        codes = {name: (1 - share) * start[name] + share * end[name] for name in start}
        return view, codes

    model = scene.build(spec, metadata)
    return model._replace(**scene.drawing(field, blend if with_blending else plain))


def appearance_id(capture: Capture, name: str) -> int:
    """Return the appearance id of a frame.

    Args:
      capture: The capture.
      name: Name of the frame, or an appearance id.

    Returns:
      The id.

    Raises:
      ValueError: If there is no such frame or id.
    """
    if name in capture.ids:
        return int(capture.appearance_ids[capture.ids.index(name)])
    ids = np.unique(capture.appearance_ids)
    if name.isdigit() and int(name) in ids:
        return int(name)
    raise ValueError(
        f"appearance {name!r} is neither a frame of {capture.name}, such as "
        f"{capture.ids[0]!r}, nor one of its appearance ids, {ids[0]} to {ids[-1]}"
    )
