"""User-defined effects, named as MODULE:NAME. Loading them runs their code."""

import importlib
from typing import Any

from nerfies_jax.training.effects import Effect


def load(names: tuple[str, ...], metadata: Any) -> tuple[Effect, ...]:
    """Import user-defined effects.

    Args:
      names: Names MODULE:NAME. NAME is an `Effect` of MODULE, or a function that
        returns one from the scene's metadata. MODULE is found as by `import`.
      metadata: Scene metadata, `SceneMetadata` of either package.

    Returns:
      The effects, in the order of their names.

    Raises:
      ValueError: If a name cannot be found.
    """
    return tuple(_load(name, metadata) for name in names)


def _load(name, metadata):
    module_name, colon, attribute = name.partition(":")
    if not (module_name and colon and attribute):
        raise ValueError(f"effect {name}: expected MODULE:NAME, as my_effects:drift")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ValueError(
            f"effect {name}: {module_name} cannot be imported ({error}); run where "
            "its file is, or name the folder of the file in PYTHONPATH"
        ) from error
    named = getattr(module, attribute, None)
    if named is None:
        place = getattr(module, "__file__", None) or "built into Python"
        raise ValueError(f"effect {name}: {module_name} ({place}) has no {attribute!r}")
    # An effect is a tuple, which nobody can call.
    effect = named(metadata) if callable(named) else named
    if not isinstance(effect, Effect):
        raise ValueError(
            f"effect {name}: a {type(effect).__name__}, and neither an Effect nor a "
            "function that returns one (docs/own_effect.md)"
        )
    return effect
